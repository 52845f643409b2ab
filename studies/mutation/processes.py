"""One call of the program in a process of its own: forked from one that has imported everything, or fresh."""

from __future__ import annotations

import importlib
import os
import pkgutil
import resource
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
MOST_CPU_TIME = 20
"""[s] of processor time, from which a call counts as one that does not end: a busy machine takes longer."""
MOST_WALL_TIME = 120.0
"""[s]. A call that waits uses no processor time; one that is ready and gets none, on a busy machine, goes on."""
MOST_MEMORY = 2**30
"""Bytes of resident memory of a call, from which it counts as one that uses too much."""
MOST_ADDRESSES = 2**33
"""Bytes that a call may reserve: far beyond MOST_MEMORY, as libraries reserve more than they use."""
LARGEST_FILE = 2**30
"""Bytes of a file that a call may write."""
PROGRAM_MEMORY = 180 * 2**20
"""Bytes of a process with all modules of the program. What the forking process holds besides is not the call's."""


@dataclass(frozen=True)
class Ended:
    """A process that has ended: its exit status (negative: the signal), its resident memory [bytes], what it wrote."""

    status: int
    memory: int
    late: bool
    """Whether it waited for so long that it had to be ended."""
    stdout: str
    stderr: str


def import_program() -> None:
    """Import all modules once, so that each call is a fork of this process."""
    import balance_cli

    for module in pkgutil.walk_packages(balance_cli.__path__, "balance_cli."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    importlib.import_module("balance_cli.__main__")


def run_forked(words: Sequence[str], work: Path) -> Ended:
    """Run a call in a fork of this process, through the entry of the program and with its way to end."""
    sys.stdout.flush()
    sys.stderr.flush()
    not_of_the_call = max(0, _resident_memory() - PROGRAM_MEMORY)
    pid = os.fork()
    if pid == 0:
        _become_the_call(words, work)
    late = _wait(pid)
    _, status, usage = os.wait4(pid, 0)
    return Ended(os.waitstatus_to_exitcode(status), usage.ru_maxrss * 1024 - not_of_the_call, late, *_written(work))


def run_fresh(words: Sequence[str], work: Path) -> Ended:
    """Run the same call as a program of its own, as users do. Its memory is not measured."""
    with (work / "stdout").open("wb") as out, (work / "stderr").open("wb") as err:
        done = subprocess.run(
            [sys.executable, "-m", "balance_cli", *words],
            cwd=work,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdout=out,
            stderr=err,
            preexec_fn=_limit_resources,
            check=False,
        )
    return Ended(done.returncode, 0, False, *_written(work))


def _become_the_call(words: Sequence[str], work: Path) -> None:
    """Let a forked process make the call, and end it."""
    status = 1
    try:
        # Never appended to: an empty file each, as a shell makes them.
        for name, number in (("stdout", 1), ("stderr", 2)):
            os.dup2(os.open(work / name, os.O_CREAT | os.O_TRUNC | os.O_WRONLY), number)
            setattr(sys, name, os.fdopen(number, "w", closefd=False))  # pytest replaces these
        _limit_resources()
        os.chdir(work)
        sys.argv = ["balance", *words]
        status = _exit_status()
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        # What this process would clean up at its end belongs to the one that it is a fork of.
        os._exit(status)


def _exit_status() -> int:
    from balance_cli.__main__ import main

    try:
        main()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


def _limit_resources() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_CPU_TIME, MOST_CPU_TIME + 5))
    resource.setrlimit(resource.RLIMIT_AS, (MOST_ADDRESSES, MOST_ADDRESSES))
    resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST_FILE, LARGEST_FILE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _wait(pid: int) -> bool:
    """Wait until a process has ended, without collecting it, and return whether it had to be ended."""
    deadline = time.monotonic() + MOST_WALL_TIME
    descriptor = os.pidfd_open(pid)
    try:
        while not select.select([descriptor], [], [], 1.0)[0]:
            if time.monotonic() > deadline and not _is_ready(pid):
                os.kill(pid, signal.SIGKILL)
                return True
    finally:
        os.close(descriptor)
    return False


def _is_ready(pid: int) -> bool:
    """Whether a process or one that it started computes, or would if it got a processor; false where nobody tells."""
    try:
        process = Path(f"/proc/{pid}")
        state = (process / "stat").read_text(encoding="ascii").rpartition(")")[2].split()[0]
        children = (process / "task" / str(pid) / "children").read_text(encoding="ascii").split()
    except OSError:
        return False
    return state == "R" or any(_is_ready(int(child)) for child in children)


def _resident_memory() -> int:
    """Bytes of this process; zero where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return 0
    return pages * resource.getpagesize()


def _written(work: Path) -> tuple[str, str]:
    out, err = ((work / name).read_text(encoding="utf-8", errors="replace") for name in ("stdout", "stderr"))
    return out, err


def empty_folder(folder: Path) -> Path:
    """Make a folder anew, whatever was there."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder
