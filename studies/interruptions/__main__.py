"""`python -m studies.interruptions`: commands and chains that are ended, share an output, or find no room."""

from __future__ import annotations

import tempfile
from pathlib import Path

import click
import numpy as np
import pandas as pd

from balance_cli.campaign.rig.geometry_file import load_geometry
from studies.interruptions.calls import GEOMETRY, Call, all_calls, fingerprints, run_command, small_campaign, start
from studies.interruptions.trials import (
    SIGNALS,
    Row,
    chain_words,
    interrupted_call,
    interrupted_chain,
    killed_batch,
    limit_files,
    lose_rights,
    results_of,
    shared_calls,
    shared_output,
    small_disk,
    undisturbed,
    without_room,
)
from studies.wind_runs import write_wind_runs

TABLES = Path(__file__).parents[1] / "tables"
SMALL_DISK = 4096
"""Bytes of the full disk: one page, which a file fills."""
PARTS = ("calls", "shared", "room", "chain", "batch")
BATCH_RUNS = 40
"""Records of 30 s of a batch that is killed."""


@click.command()
@click.option("--part", "parts", multiple=True, type=click.Choice(PARTS), help="Only these parts.")
@click.option("--moments", default=8, show_default=True, help="Of each command; every second one while it writes.")
@click.option("--interruptions", default=10, show_default=True, help="Of the chain.")
@click.option("--kills", default=20, show_default=True, help="Of the batch.")
@click.option("--seed", default=1, show_default=True)
def interruptions(parts: tuple[str, ...], moments: int, interruptions: int, kills: int, seed: int) -> None:
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
            elif part == "batch":
                rows = _batch(folder, kills, rng)
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


def _batch(folder: Path, kills: int, rng: np.random.Generator) -> list[Row]:
    """Kill a reduction of many records at random moments, on one and on two processes in turn, and resume it."""
    records = folder / "records"
    records.mkdir()
    files = write_wind_runs(records, load_geometry(GEOMETRY), BATCH_RUNS)
    known = ("--calibration", folder / "calibration.h5", "--transfer", folder / "transfer.h5")
    calls = [Call("reduce", (*files, *known, "-j", jobs, "-o", "OUT/l.h5"), ("l.h5",)) for jobs in ("1", "2")]
    references = [undisturbed(call, folder / "undisturbed" / "out") for call in calls]
    rows = []
    for count in range(kills):
        row = killed_batch(calls[count % 2], references[count % 2], rng, folder / "killed")
        rows.append(_shown({"processes": 1 + count % 2, **row}))
    return rows


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
    for name in ("balance run", "make", "balance watch"):
        output = folder / f"chain-{name.replace(' ', '-')}" / "results"
        output.parent.mkdir()
        if name == "balance watch":
            straight = _watch(campaign, folder)
            _, status, duration = undisturbed(straight, folder / "watched" / "out")
            wanted = _loads_of(folder / "watched" / "out" / "results")
        words = chain_words(campaign, output) if name == "make" else straight.words(output.parent)
        row = interrupted_chain(words, output, duration, interruptions // 2, rng)
        found = _loads_of(output) if name == "balance watch" else results_of(output)
        row |= {"chain": name, "undisturbed": status, "same digests": found == wanted}
        row["different"] = " ".join(key for key in {**found, **wanted} if found.get(key) != wanted.get(key))
        rows.append(_shown(row))
    return rows


def _watch(campaign: Path, folder: Path) -> Call:
    known = ("--calibration", folder / "calibration.h5", "--transfer", folder / "transfer.h5")
    return Call("watch", (campaign, *known, "--once", "-o", "OUT/results"), ())


def _loads_of(folder: Path) -> dict[str, str]:
    """Return what identifies the table of loads; page and journal state when each file came."""
    return {name: value for name, value in fingerprints(folder).items() if name == "loads.h5"}


if __name__ == "__main__":
    interruptions()
