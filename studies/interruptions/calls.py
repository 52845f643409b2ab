"""The calls that are interrupted: one of each command, on a small simulated campaign, and what they leave."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

ROOT = Path(__file__).parents[2]
GEOMETRY = ROOT / "configs" / "one-dof.yaml"
RUNS = ("static-bare", "static-trim", "sweep-Fz", "check-1", "wind-1")
"""Of the short plan: one of each kind."""
PROGRAM = (sys.executable, "-m", "balance_cli")
LONGEST_CALL = 300.0
"""[s]. A call that takes longer hangs."""
MADE_AT = re.compile(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00")
"""Time of an artefact on the page."""
PROGRESS = re.compile(r"balance: .*(\d+ % after|at work for) ")
OLD = b"old"
"""What an output contains before the call."""


@dataclass(frozen=True)
class Call:
    """A call of a command: its arguments, with OUT for the folder of its outputs, and whether it wants a new folder."""

    command: str
    arguments: Sequence[str | Path]
    outputs: Sequence[str]
    new_folder: bool = False

    def words(self, folder: Path) -> list[str]:
        """Return the command line with the outputs in this folder."""
        return [*PROGRAM, self.command, *(str(word).replace("OUT", str(folder)) for word in self.arguments)]


def run_command(*words: str | Path) -> None:
    """Run `balance` with these words. Raises CalledProcessError where it fails."""
    subprocess.run([*PROGRAM, *map(str, words)], cwd=ROOT, check=True, capture_output=True, timeout=LONGEST_CALL)


def start(words: Sequence[str], temporary: Path, before: Callable[[], None] | None = None) -> subprocess.Popen[str]:
    """Start a command line with a folder of its own for temporary files."""
    temporary.mkdir(exist_ok=True)
    environment = os.environ | {"TMPDIR": str(temporary), "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        words,
        cwd=ROOT,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=before,
    )


def small_campaign(folder: Path, seed: int = 0) -> Path:
    """Simulate one run of each kind, with the geometry beside them, and return the folder."""
    chosen = [word for run in RUNS for word in ("--only", run)]
    run_command("simulate", "-g", GEOMETRY, "--plan", "short", *chosen, "--seed", str(seed), "-o", folder)
    (folder / "geometry.yaml").write_bytes(GEOMETRY.read_bytes())
    return folder


def all_calls(campaign: Path, folder: Path) -> list[Call]:
    """Return one call of each command; what they read is made in `folder`."""
    geometry, calibration, transfer = campaign / "geometry.yaml", folder / "calibration.h5", folder / "transfer.h5"
    static, sweep = campaign / "static-bare.h5", campaign / "sweep-Fz.h5"
    runs = (campaign / "check-1.h5", campaign / "wind-1.h5")
    known = ("--calibration", calibration, "--transfer", transfer)
    made = folder / "loads.h5"
    run_command("calibrate", "-g", geometry, static, "-o", calibration)
    run_command("sweep-tf", "-g", geometry, sweep, "-o", transfer)
    run_command("reduce", *runs, *known, "-o", made)
    shards = [folder / f"shard-{number}.h5" for number in (1, 2)]
    for run, shard in zip(runs, shards, strict=True):
        run_command("reduce", run, *known, "-o", shard)
    maps = [import_map(folder, scale) for scale in (1, 2)]
    return [
        Call("check", ("-g", geometry, static, sweep, *runs, "--json", "OUT/check.json"), ("check.json",)),
        Call("calibrate", ("-g", geometry, static, "-o", "OUT/c.h5", "--json", "OUT/c.json"), ("c.h5", "c.json")),
        Call("sweep-tf", ("-g", geometry, sweep, "-o", "OUT/t.h5"), ("t.h5",)),
        Call("identify", ("-g", geometry, "--method", "ls", sweep, "-o", "OUT/m.h5"), ("m.h5",)),
        Call("reduce", (*runs, *known, "-j", "2", "-o", "OUT/l.h5"), ("l.h5",)),
        Call("simulate", ("-g", geometry, "--plan", "short", "--only", "wind-1", "-o", "OUT/new"), (), True),
        Call("report", (calibration, transfer, made, "-o", "OUT/r.html"), ("r.html",)),
        Call("import", (maps[0], folder / "hover-1.csv", "-o", "OUT"), ("wind-1.h5",)),
        Call("export", (made, "-o", "OUT/l.csv"), ("l.csv",)),
        Call("merge", (*shards, "-o", "OUT/a.h5"), ("a.h5",)),
        Call("apply", (calibration, point_table(folder), "-o", "OUT/p.csv"), ("p.csv",)),
    ]


def point_table(folder: Path) -> Path:
    """Write a table of readings of the channel, and return it."""
    path = folder / "points.csv"
    path.write_text("\n".join(["z.strain [V]", *(f"{0.01 * i:.2f}" for i in range(200))]) + "\n")
    return path


def import_map(folder: Path, scale: int) -> Path:
    """Write a record as CSV, a map of it with this scale, and return the map."""
    record = folder / "hover-1.csv"
    times = np.arange(20000) / 2000
    columns = np.column_stack([times, np.sin(100 * times), np.sin(2 * np.pi * 17.5 * times) > 0.99])
    np.savetxt(record, columns, delimiter=",", header="t [s],force [V],tacho [V]", comments="", fmt="%.6f")
    path = folder / f"map-{scale}.yaml"
    path.write_text(
        f"format: balance-import/1\nrig: BENCH-1\ntime: t\nchannels: {{force: {{name: z.strain, scale: {scale}}}}}\n"
        "rotor: {channel: tacho}\nruns: [{file: 'hover-{n}.csv', kind: wind, run: 'wind-{n}'}]\n"
    )
    return path


def fingerprints(folder: Path) -> dict[str, str]:
    """Return what identifies each file below a folder: artefacts by their content, other files by their bytes."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(path.relative_to(folder)): fingerprint(path, folder) for path in files}


def fingerprint(path: Path, folder: Path) -> str:
    """Return the content digest of an artefact that can be read whole, else the digest of the bytes.

    Pages state when each of their artefacts was made, which no two chains share. Summaries in JSON name their output,
    which lies in another folder in each trial.
    """
    if path.suffix == ".html":
        return hashlib.sha256(MADE_AT.sub(b"", path.read_bytes())).hexdigest()[:16]
    if path.suffix == ".json":
        return hashlib.sha256(path.read_bytes().replace(str(folder).encode(), b"OUT")).hexdigest()[:16]
    if h5py.is_hdf5(path):
        with suppress(KeyError), h5py.File(path, "r") as file:
            file.visititems(lambda _name, item: item[()] if isinstance(item, h5py.Dataset) else None)
            return str(file.attrs["digest"])
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def leftovers(folder: Path) -> list[str]:
    """Return the names of staged and other temporary files below a folder."""
    return [path.name for path in folder.rglob(".*") if path.is_file()]


def messages(text: str) -> list[str]:
    """Return the lines on stderr that are neither warnings nor progress, which a slow machine reports, nor empty."""
    lines = [line for line in text.splitlines() if line and not line.startswith("balance: warning:")]
    return [line for line in lines if not PROGRESS.match(line)]


def is_whole(found: Mapping[str, str], old: Mapping[str, str], new: Mapping[str, str]) -> bool:
    """Whether the outputs are all as before, or all as after an undisturbed call."""
    return found in (dict(old), dict(new))


def wait_until_staged(folder: Path, process: subprocess.Popen[str]) -> None:
    """Return when a file is staged below a folder, or the process has ended."""
    while process.poll() is None and not any(folder.rglob(".part-*")):
        time.sleep(2e-4)
