"""Batches of many runs: processor time, memory and overhead of a run, on one and two processes and on a Dask cluster.

`python -m benchmarks.scale 1000 --seconds 3` writes the runs, reduces them in each way and prints a table. Processor
time is that of all processes of a call, which other programs on the machine lengthen less than its duration. In the way
`killed` one of the Dask workers is killed while the batch is in work. Every recording is another one up to
`--distinct`; further files are copies under names of their own.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import click
import h5py

from balance_cli.campaign.rig.geometry_file import load_geometry
from studies.wind_runs import write_wind_runs

ROOT = Path(__file__).parents[1]
GEOMETRY = ROOT / "configs" / "rts-6.yaml"
BALANCE = (sys.executable, "-m", "balance_cli")
POLL = 0.1
"""[s] between two looks at the processes of a call."""
PORT = 8796
TICKS = os.sysconf("SC_CLK_TCK")
PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class Usage:
    """What a call took: duration, processor time of all processes and of the main one [s], largest memory [bytes]."""

    status: int
    duration: float
    processor: float
    main_processor: float
    main_memory: int
    memory: int
    digest: str


@click.command()
@click.argument("counts", type=int, nargs=-1, required=True)
@click.option("--seconds", type=float, default=3.0, help="Length of a record.")
@click.option("--distinct", type=int, default=300, help="Recordings that are simulated; the others are copies.")
@click.option("--ways", default="1,2,dask,killed", help="Processes, Dask, and Dask with a killed worker.")
def main(counts: Sequence[int], seconds: float, distinct: int, ways: str) -> None:
    """Reduce batches of COUNTS runs, and print a row for each way."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        model = _model(folder)
        runs = _write_runs(folder, max(counts), distinct, seconds)
        click.echo("runs, way, status, duration s, CPU s, CPU ms a run, of the main process, main MB, all MB, digest")
        for count in counts:
            for way in ways.split(","):
                usage = _reduce(way, model, runs[:count], folder / f"loads-{count}-{way}.h5")
                cells = [count, way, usage.status, f"{usage.duration:.0f}", f"{usage.processor:.1f}"]
                cells += [f"{1e3 * time / count:.1f}" for time in (usage.processor, usage.main_processor)]
                cells += [usage.main_memory // 10**6, usage.memory // 10**6]
                click.echo(", ".join(map(str, [*cells, usage.digest[:8]])))


def _model(folder: Path) -> Path:
    sweeps = sorted(map(str, (ROOT / "sample_data").glob("sweep-*-low.h5")))
    words = ["identify", "-g", str(GEOMETRY), *sweeps, "--method", "computed", "-o", str(folder / "model.h5")]
    subprocess.run([*BALANCE, *words], check=True, capture_output=True)
    return folder / "model.h5"


def _write_runs(folder: Path, count: int, distinct: int, seconds: float) -> list[Path]:
    paths = write_wind_runs(folder, load_geometry(GEOMETRY), min(count, distinct), duration=seconds)
    for index in range(len(paths), count):
        path = folder / f"wind-{index:05d}.h5"
        shutil.copyfile(paths[index % distinct], path)
        with h5py.File(path, "r+") as file:
            file.attrs["run"] = path.stem
        paths.append(path)
    return paths


def _reduce(way: str, model: Path, runs: Sequence[Path], output: Path) -> Usage:
    words = [*BALANCE, "reduce", "--model", str(model), *map(str, runs), "-o", str(output)]
    if way.isdigit():
        return _meter([*words, "--jobs", way], output)
    with _dask_cluster(2) as workers:
        return _meter([*words, "--executor", f"dask://127.0.0.1:{PORT}"], output, workers, way == "killed")


@contextmanager
def _dask_cluster(workers: int) -> Iterator[list[subprocess.Popen[bytes]]]:
    """A scheduler and workers with a nanny each, which starts a killed worker again."""
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", str(PORT), "--no-dashboard"]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", f"tcp://127.0.0.1:{PORT}", "--nthreads", "1"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    processes = [subprocess.Popen([*dask], **quiet)]  # type: ignore[call-overload]
    try:
        processes += [
            subprocess.Popen([*worker, "--no-dashboard"], **quiet)  # type: ignore[call-overload]
            for _ in range(workers)
        ]
        yield processes[1:]
    finally:
        for process in processes:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def _meter(
    words: Sequence[str], output: Path, workers: Sequence[subprocess.Popen[bytes]] = (), kill: bool = False
) -> Usage:
    """Run a command in a session of its own, and add up what its processes and those of Dask workers have used.

    With `kill` the process of the first worker, a child of its nanny, is killed once the journal shows results.
    """
    begin = time.monotonic()
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    used: dict[int, float] = {}
    sessions = {process.pid, *(worker.pid for worker in workers)}
    main = total = 0
    journal = output.with_name(f".{output.name}.unfinished")
    while process.poll() is None:
        memory = _processes(used, sessions)
        main, total = max(main, memory.get(process.pid, 0)), max(total, sum(memory.values()))
        if kill and journal.exists() and journal.stat().st_size > 10**5:
            _kill_children(workers[0].pid)
            kill = False
        time.sleep(POLL)
    if kill:
        raise SystemExit("the batch was over before a worker could be killed: give more runs")
    with h5py.File(output) as file:
        digest = str(file.attrs["digest"])
    duration = time.monotonic() - begin
    return Usage(process.returncode, duration, sum(used.values()), used[process.pid], main, total, digest)


def _processes(used: dict[int, float], sessions: set[int]) -> dict[int, int]:
    """Note the processor time of each process of the sessions, and return the memory of each."""
    memory = {}
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, ValueError, IndexError):
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
            if int(fields[3]) in sessions:
                used[int(entry.name)] = (int(fields[11]) + int(fields[12])) / TICKS
                memory[int(entry.name)] = int(fields[21]) * PAGE
    return memory


def _kill_children(parent: int) -> None:
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, ValueError, IndexError):
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
            command = (entry / "cmdline").read_text()
            if int(fields[1]) == parent and "resource_tracker" not in command:
                os.kill(int(entry.name), signal.SIGKILL)


if __name__ == "__main__":
    main()
