"""`python -m studies.mutation`: changed files through every reader, and a table of what came of them."""

from __future__ import annotations

import json
import shutil
import tempfile
from dataclasses import asdict
from pathlib import Path

import click
import pandas as pd

from studies.mutation.outcomes import FAULTS, READ, REFUSED, Outcome, import_program, try_file
from studies.mutation.readers import READERS, make_examples

TABLE = Path(__file__).parents[1] / "tables" / "mutation.csv"


@click.command()
@click.option("--files", default=10_000, show_default=True, help="Changed files, spread over the readers.")
@click.option("--reader", "names", multiple=True, type=click.Choice(list(READERS)), help="Only this reader.")
@click.option("--first", default=0, show_default=True, help="First seed.")
@click.option("--keep", type=click.Path(path_type=Path), help="Folder for the files that made a fault.")
@click.option("--write/--no-write", default=True, help="Write the table.")
def main(files: int, names: tuple[str, ...], first: int, keep: Path | None, write: bool) -> None:
    """Changed files through every reader, and what came of them."""
    import_program()
    chosen = names or tuple(READERS)
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder) / "base"
        base.mkdir()
        make_examples(base)
        for seed in range(first, first + -(-files // len(chosen))):
            for name in chosen:
                outcome = try_file(name, base, Path(folder) / "work", seed)
                outcomes.append(outcome)
                if outcome.kind in FAULTS:
                    click.echo(json.dumps(asdict(outcome)))
                    if keep:
                        shutil.copytree(Path(folder) / "work", keep / f"{name}-{seed}", dirs_exist_ok=True)
    table = outcome_table(outcomes)
    click.echo(table.to_string(index=False))
    if write:
        table.to_csv(TABLE, index=False)


def outcome_table(outcomes: list[Outcome]) -> pd.DataFrame:
    """Counts of the outcomes, one row for each reader and one for all."""
    rows = pd.DataFrame([asdict(outcome) for outcome in outcomes])
    counts = pd.crosstab(rows["reader"], rows["kind"]).reindex(columns=[REFUSED, READ, *FAULTS], fill_value=0)
    counts = counts.reindex([name for name in READERS if name in counts.index])
    counts.loc["all"] = counts.sum()
    counts.insert(0, "files", counts.sum(axis=1))
    return counts.reset_index()


if __name__ == "__main__":
    main()
