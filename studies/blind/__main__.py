"""`python -m studies.blind FOLDER SEED...`: blind campaigns, one row of a table each."""

from __future__ import annotations

import sys
from pathlib import Path

import pandas as pd

from studies.blind.judge import blind_case, causes_of


def main() -> None:
    """Run the campaigns of the seeds and append their rows to FOLDER/blind.csv."""
    folder = Path(sys.argv[1])
    for seed in map(int, sys.argv[2:]):
        row = blind_case(seed, causes_of(seed), folder / str(seed))
        pd.Series(row).to_json(folder / f"{seed}.json")
        print(pd.Series(row).to_string(), flush=True)


if __name__ == "__main__":
    main()
