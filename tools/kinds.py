"""Make variables STATIC, SWEEP, CHECK, WIND and ZERO from the summary of `balance check --json`."""

import json
import sys
from collections import defaultdict
from pathlib import Path

KINDS = ("static", "sweep", "check", "wind", "zero")


def main(summary: Path) -> None:
    """Print one line for each kind of run."""
    files = json.loads(summary.read_text(encoding="utf-8"))["files"]
    by_kind = defaultdict(list)
    for path, about in files.items():
        by_kind[about.get("run_kind", "")].append(path)
    for kind in KINDS:
        sys.stdout.write(f"{kind.upper()} := {' '.join(by_kind[kind])}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
