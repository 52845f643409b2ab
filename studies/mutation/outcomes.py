"""One changed file through one call, in a process that can be ended, and what came of it."""

from __future__ import annotations

import importlib
import os
import pkgutil
import random
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from studies.mutation.readers import READERS, Reader, Words

MOST_CPU_TIME = 20
"""[s] of processor time, from which a call counts as one that does not end."""
MOST_WALL_TIME = 120.0
"""[s]. A call that waits uses no processor time; one that is ready and gets none, on a busy machine, goes on."""
MOST_MEMORY = 2**30
"""Bytes of resident memory of a call, from which it counts as one that uses too much."""
PROGRAM_MEMORY = 180 * 2**20
"""Bytes of a process with all modules of the program. What the forking process holds besides is not the call's."""

READ, REFUSED = "read", "refused"
INTERNAL, CRASHED, ENDLESS, MEMORY, MESSAGE, LEFT = "internal error", "crashed", "endless", "memory", "message", "left"
FAULTS = (INTERNAL, CRASHED, ENDLESS, MEMORY, MESSAGE, LEFT)


@dataclass(frozen=True)
class Outcome:
    """What a call made of a file: `kind` is READ, REFUSED or one of FAULTS; `text` is its message."""

    reader: str
    seed: int
    kind: str
    text: str
    words: str


def import_program() -> None:
    """Import all modules once, so that each call is a fork of this process."""
    import balance_cli

    for module in pkgutil.walk_packages(balance_cli.__path__, "balance_cli."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)


def mutate(reader: Reader, base: Path, seed: int) -> bytes:
    """The example of the reader, changed in the way of this seed."""
    return reader.mutate((base / reader.example).read_bytes(), random.Random(seed))


def try_file(name: str, base: Path, work: Path, seed: int) -> Outcome:
    """Change the example of a reader, and make one of its calls on it."""
    reader = READERS[name]
    shutil.rmtree(work, ignore_errors=True)
    out = work / "out"
    out.mkdir(parents=True)
    bad = work / f"bad{Path(reader.example).suffix}"
    bad.write_bytes(mutate(reader, base, seed))
    # The call is chosen apart from the change, so that each change meets each call in the course of the seeds.
    words = random.Random(seed + 1).choice(reader.calls)(base, bad, out)
    return try_call(name, seed, words, work)


def try_call(name: str, seed: int, words: Words, work: Path) -> Outcome:
    status, memory, late = _run(lambda: _call(words), work)
    stderr = (work / "stderr").read_text(encoding="utf-8", errors="replace")
    stdout = (work / "stdout").read_text(encoding="utf-8", errors="replace")
    kind, text = _judge(status, memory, late, stdout, stderr, list((work / "out").iterdir()))
    return Outcome(name, seed, kind, text, " ".join(map(str, words)))


def _judge(status: int, memory: int, late: bool, stdout: str, stderr: str, written: Iterable[Path]) -> tuple[str, str]:
    errors = [line for line in stderr.splitlines() if line.startswith("balance: error:")]
    faults = [line.strip() for line in stdout.splitlines() if line.strip().startswith("fault:")]
    message = (errors or faults or [stderr.strip()[-300:]])[0]
    if late or status == -signal.SIGXCPU:
        return ENDLESS, message
    if status < 0:
        return CRASHED, f"signal {-status}"
    if memory > MOST_MEMORY:
        return MEMORY, f"{memory / 2**20:.0f} MB"
    if status not in (0, 2) or "Traceback" in stderr:
        return INTERNAL, message
    if status == 2 and not (len(errors) == 1 or (not errors and faults)):
        return MESSAGE, stderr[-300:]
    left = [path.name for path in written if status == 2 or path.name.startswith(".part-")]
    if left:
        return LEFT, ", ".join(left)
    return (REFUSED, message) if status else (READ, "")


def _call(words: Words) -> None:
    from balance_cli.cli import balance

    balance.main([str(word) for word in words], prog_name="balance")


def _run(action: Callable[[], None], work: Path) -> tuple[int, int, bool]:
    """Exit status (negative: the signal), resident memory [bytes], and whether the process had to be ended."""
    sys.stdout.flush()
    sys.stderr.flush()
    not_of_the_call = max(0, _resident_memory() - PROGRAM_MEMORY)
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            for name, number in (("stdout", 1), ("stderr", 2)):
                os.dup2(os.open(work / name, os.O_CREAT | os.O_WRONLY), number)
                setattr(sys, name, os.fdopen(number, "w", closefd=False))  # pytest replaces these
            resource.setrlimit(resource.RLIMIT_CPU, (MOST_CPU_TIME, MOST_CPU_TIME + 5))
            os.chdir(work)
            action()
            status = 0
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 0
        except BaseException:
            import traceback

            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
    deadline, pause, late = time.monotonic() + MOST_WALL_TIME, 0.001, False
    while True:
        ended, status, usage = os.wait4(pid, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status), usage.ru_maxrss * 1024 - not_of_the_call, late
        if time.monotonic() > deadline and not late and not _is_ready(pid):
            late = True
            os.kill(pid, signal.SIGKILL)
        time.sleep(pause)
        pause = min(0.02, pause * 1.5)


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
