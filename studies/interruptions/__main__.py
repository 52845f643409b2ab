"""`python -m studies.interruptions`: commands and chains that are ended, share an output, or find no room."""

from __future__ import annotations

import tempfile
from pathlib import Path

import click
import numpy as np
import pandas as pd

from studies.interruptions.calls import Call, all_calls, run_command, small_campaign, start
from studies.interruptions.trials import (
    SIGNALS,
    Row,
    chain_words,
    interrupted_call,
    interrupted_chain,
    limit_files,
    lose_rights,
    results_of,
    shared_calls,
    shared_output,
    small_disk,
    undisturbed,
    without_room,
)

TABLES = Path(__file__).parents[1] / "tables"
SMALL_DISK = 4096
"""Bytes of the full disk: one page, which a file fills."""
PARTS = ("calls", "shared", "room", "chain")


@click.command()
@click.option("--part", "parts", multiple=True, type=click.Choice(PARTS), help="Only these parts.")
@click.option("--moments", default=8, show_default=True, help="Of each command; every second one while it writes.")
@click.option("--interruptions", default=10, show_default=True, help="Of the chain.")
@click.option("--seed", default=1, show_default=True)
def interruptions(parts: tuple[str, ...], moments: int, interruptions: int, seed: int) -> None:
    """What commands leave that signals end at random moments, that share an output, or that find no room."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        campaign = small_campaign(folder / "campaign")
        calls = {call.command: call for call in all_calls(campaign, folder)}
        for part in parts or PARTS:
            rng = np.random.default_rng(seed)
            if part == "calls":
                rows = _calls(calls, moments, rng, folder)
            elif part == "shared":
                rows = _shared(campaign, rng, folder)
            elif part == "room":
                rows = _room(calls, folder)
            else:
                rows = _chain(campaign, interruptions, rng, folder)
            table = pd.DataFrame(rows)
            for column in table.columns:
                table[column] = table[column].astype(str).str.replace(str(folder), "WORK")
            table.to_csv(TABLES / f"interruptions_{part}.csv", index=False)
            click.echo(table.to_string(index=False))


def _calls(calls: dict[str, Call], moments: int, rng: np.random.Generator, folder: Path) -> list[Row]:
    """Interrupt each command `moments` times, by one signal after the other, every second time while it writes."""
    rows = []
    for place, call in enumerate(calls.values()):
        reference = undisturbed(call, folder / "reference" / "out")
        for count in range(moments):
            name = SIGNALS[(place + count + count // len(SIGNALS)) % len(SIGNALS)]
            row = interrupted_call(call, name, count % 2 == 1, reference, rng, folder / "trial")
            rows.append(_shown(row))
    return rows


def _shown(row: Row) -> Row:
    """Print a row at once: the study takes long, and may be stopped."""
    click.echo(" ".join(f"{key}: {value};" for key, value in row.items()), err=True)
    return row


def _shared(campaign: Path, rng: np.random.Generator, folder: Path) -> list[Row]:
    run_command("identify", "-g", campaign / "geometry.yaml", campaign / "sweep-Fz.h5", "-o", folder / "model.h5")
    pairs = shared_calls(campaign, folder)
    other = small_campaign(folder / "other", seed=2)
    chains = [Call("run", (path, "-o", "OUT/results"), ()) for path in (campaign, other)]
    rows = [_shown(shared_output(*pair, rng, folder / "shared")) for pair in pairs]
    return [*rows, _shared_chain(*chains, folder / "chains")]


def _shared_chain(first: Call, second: Call, folder: Path) -> Row:
    """Start two chains with one folder of results: one is refused."""
    folder.mkdir()
    processes = [start(call.words(folder), folder.with_name("tmp")) for call in (first, second)]
    said = [process.communicate()[1] for process in processes]
    lines = [line for text in said for line in text.splitlines() if "another" in line]
    statuses = [process.returncode for process in processes]
    inputs = (folder / "results" / "inputs.txt").read_text().splitlines()
    one = len({Path(line).parent for line in inputs}) == 1 and len(lines) == 1
    return {
        "command": "run",
        "statuses": " ".join(map(str, statuses)),
        "outputs of one": one,
        "whose": Path(inputs[0]).parent.name,
        "said": " | ".join(lines),
        "left": "",
    }


def _room(calls: dict[str, Call], folder: Path) -> list[Row]:
    rows = []
    for call in calls.values():
        place = folder / "room" / call.command
        (place / "out").mkdir(parents=True)
        rows.append(_shown(without_room(call, place, limit_files(100), "limit of file sizes")))
        with small_disk(place / "out", SMALL_DISK) as mounted:
            if mounted:
                (place / "out" / "filling").write_bytes(bytes(SMALL_DISK))
                rows.append(_shown(without_room(call, place, None, "disk full")))
        (place / "out").chmod(0o555)
        rows.append(_shown(without_room(call, place, lose_rights, "read-only folder")))
    return rows


def _chain(campaign: Path, interruptions: int, rng: np.random.Generator, folder: Path) -> list[Row]:
    """Interrupt `balance run` directly, and by `make`; a signal to `make` alone ends its command, too."""
    straight = Call("run", (campaign, "-o", "OUT/results"), ())
    _, status, duration = undisturbed(straight, folder / "straight" / "out")
    wanted = results_of(folder / "straight" / "out" / "results")
    rows = []
    for name in ("balance run", "make"):
        output = folder / f"chain-{name[:4]}" / "results"
        output.parent.mkdir()
        words = straight.words(output.parent) if name == "balance run" else chain_words(campaign, output)
        row = interrupted_chain(words, output, duration, interruptions // 2, rng)
        found = results_of(output)
        row |= {"chain": name, "undisturbed": status, "same digests": found == wanted}
        row["different"] = " ".join(key for key in {**found, **wanted} if found.get(key) != wanted.get(key))
        rows.append(_shown(row))
    return rows


if __name__ == "__main__":
    interruptions()
