"""`python -m studies.mutation`: changed files through every reader, and a table of what came of them."""

from __future__ import annotations

import json
import shutil
import tempfile
from dataclasses import asdict
from pathlib import Path

import click
import pandas as pd

from studies.mutation.outcomes import FAULTS, READ, REFUSED, Outcome, differences, try_file
from studies.mutation.processes import import_program
from studies.mutation.readers import READERS, make_examples

TABLE = Path(__file__).parents[1] / "tables" / "mutation.csv"
REPORTED = 500
"""Files from one line of progress to the next."""


@click.command()
@click.option("--files", default=10_000, show_default=True, help="Changed files, spread over the readers.")
@click.option("--reader", "names", multiple=True, type=click.Choice(list(READERS)), help="Only this reader.")
@click.option("--first", default=0, show_default=True, help="First seed.")
@click.option("--keep", type=click.Path(path_type=Path), help="Folder for the files that made a fault.")
@click.option("--compare", is_flag=True, help="Compare forked calls with those of fresh processes; no table.")
@click.option("--write/--no-write", default=True, help="Write the table.")
def main(files: int, names: tuple[str, ...], first: int, keep: Path | None, compare: bool, write: bool) -> None:
    """Changed files through every reader, and what came of them."""
    import_program()
    chosen = names or tuple(READERS)
    cases = [(seed, name) for seed in range(first, first + -(-files // len(chosen))) for name in chosen]
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder) / "base"
        base.mkdir()
        make_examples(base)
        if compare:
            _compare(cases, base, Path(folder) / "work")
            return
        outcomes = _try_files(cases, base, Path(folder) / "work", keep)
    table = outcome_table(outcomes)
    click.echo(table.to_string(index=False))
    if write:
        table.to_csv(TABLE, index=False)


def _try_files(cases: list[tuple[int, str]], base: Path, work: Path, keep: Path | None) -> list[Outcome]:
    """Try a file for each case; faults are printed at once, as are counts: the study takes long, and may be stopped."""
    outcomes: list[Outcome] = []
    for place, (seed, name) in enumerate(cases, start=1):
        outcome = try_file(name, base, work, seed)
        outcomes.append(outcome)
        if outcome.kind in FAULTS:
            click.echo(json.dumps(asdict(outcome)))
            if keep:
                shutil.copytree(work, keep / f"{name}-{seed}", dirs_exist_ok=True)
        if place % REPORTED == 0:
            faults = sum(item.kind in FAULTS for item in outcomes)
            click.echo(f"{place} of {len(cases)} files, up to seed {seed}, {faults} faults", err=True)
    return outcomes


def _compare(cases: list[tuple[int, str]], base: Path, work: Path) -> None:
    """Make each call in a forked and in a fresh process, and print where status, messages or files differ."""
    differing = 0
    for seed, name in cases:
        found = differences(name, base, work, seed)
        differing += bool(found)
        if found:
            click.echo(f"{name} {seed}: {', '.join(found)}")
    click.echo(f"{differing} of {len(cases)} calls differ between a forked and a fresh process")


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
