"""Trials: a call that a signal ends, two calls with one output, a chain that is resumed, and no room for the output."""

from __future__ import annotations

import ctypes
import resource
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from studies.interruptions.calls import (
    LONGEST_CALL,
    OLD,
    PROGRAM,
    ROOT,
    Call,
    fingerprints,
    import_map,
    is_whole,
    leftovers,
    messages,
    start,
    wait_until_staged,
)

SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGKILL")
LONGEST_WRITING = 0.02
"""[s] after the first staged file, within which a signal comes that is to find the call writing."""
START_OF_PYTHON = 0.15
"""[s]. Before, Python has not reached the program: the signal itself ends the process, or Python reports it."""
AFTERMATH = 1.0
"""[s] in which the processes of a call that was killed end themselves."""
PR_CAPBSET_DROP, WRITE_ANYWHERE = 24, (1, 2)
"""Of Linux's <linux/prctl.h> and <linux/capability.h>: CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH."""
Row = dict[str, object]


def undisturbed(call: Call, folder: Path) -> tuple[dict[str, str], int, float]:
    """Return the outputs, the status and the duration [s] of a call that nothing disturbs."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    begin = time.monotonic()
    process = start(call.words(folder), folder.with_name("tmp"))
    process.communicate(timeout=LONGEST_CALL)
    return fingerprints(folder), process.returncode, time.monotonic() - begin


def interrupted_call(
    call: Call,
    name: str,
    writing: bool,
    reference: tuple[dict[str, str], int, float],
    rng: np.random.Generator,
    folder: Path,
) -> Row:
    """Interrupt a call, judge what it said and left, and what is there after the next call."""
    new, regular, duration = reference
    output, temporary = folder / "out", folder / "tmp"
    shutil.rmtree(folder, ignore_errors=True)
    output.mkdir(parents=True)
    for item in call.outputs:
        (output / item).write_bytes(OLD)
    old = fingerprints(output)
    number = getattr(signal, name)
    process = start(call.words(output), temporary)
    if writing:
        wait_until_staged(output, process)
        time.sleep(rng.uniform(0, LONGEST_WRITING))
    else:
        time.sleep(rng.uniform(START_OF_PYTHON, duration))
    process.send_signal(number)
    said = messages(process.communicate(timeout=LONGEST_CALL)[1])
    expected = -number if name == "SIGKILL" else 128 + number
    ended = process.returncode == regular
    time.sleep(AFTERMATH)
    found = {key: value for key, value in fingerprints(output).items() if ".part-" not in key}
    row: Row = {
        "command": call.command,
        "signal": name,
        "moment": "writing" if writing else "any",
        "ended before": ended,
        "status": process.returncode,
        "status right": ended or process.returncode == expected,
        "one line": ended or len(said) == (name != "SIGKILL"),
        "whole": is_whole(found, old, new),
        "said": " | ".join(said),
        "left": " ".join([*leftovers(output), *(path.name for path in temporary.rglob("*"))]),
    }
    if call.new_folder and found:
        shutil.rmtree(output)
        output.mkdir()
    after = start(call.words(output), temporary)
    after.communicate(timeout=LONGEST_CALL)
    row["next call right"] = after.returncode == regular and fingerprints(output) == new
    row["left after"] = " ".join([*leftovers(output), *(path.name for path in temporary.rglob("*"))])
    return row


def shared_output(first: Call, second: Call, rng: np.random.Generator, folder: Path) -> Row:
    """Start two calls with one output; at the end all files are those of one of them."""
    wanted = [undisturbed(call, folder / "alone" / "out")[0] for call in (first, second)]
    output = folder / "out"
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir(parents=True)
    processes = [start(first.words(output), folder / "tmp")]
    time.sleep(rng.uniform(0, 0.5))
    processes.append(start(second.words(output), folder / "tmp"))
    said = [messages(process.communicate(timeout=LONGEST_CALL)[1]) for process in processes]
    found = fingerprints(output)
    return {
        "command": first.command,
        "statuses": " ".join(str(process.returncode) for process in processes),
        "outputs of one": found in wanted,
        "whose": "first" if found == wanted[0] else "second" if found == wanted[1] else "mixed",
        "said": " | ".join(line for lines in said for line in lines),
        "left": " ".join(leftovers(output)),
    }


def killed_batch(
    call: Call, reference: tuple[dict[str, str], int, float], rng: np.random.Generator, folder: Path
) -> Row:
    """Kill a batch at a random moment, and resume it: the result is that of a batch that nothing disturbs."""
    new, regular, duration = reference
    output = folder / "out"
    shutil.rmtree(folder, ignore_errors=True)
    output.mkdir(parents=True)
    process = start(call.words(output), folder / "tmp")
    moment = rng.uniform(START_OF_PYTHON, duration)
    time.sleep(moment)
    process.kill()
    process.communicate(timeout=LONGEST_CALL)
    time.sleep(AFTERMATH)
    kept = sum(max(0, len(path.read_bytes().splitlines()) - 1) for path in output.glob(".*.unfinished"))
    after = start(call.words(output), folder / "tmp")
    after.communicate(timeout=LONGEST_CALL)
    return {
        "moment [s]": round(moment, 2),
        "undisturbed [s]": round(duration, 2),
        "killed": process.returncode == -signal.SIGKILL,
        "runs kept": kept,
        "resumed": after.returncode == regular,
        "same digest": fingerprints(output) == new,
        "left after": " ".join([*leftovers(output), *(path.name for path in (folder / "tmp").rglob("*"))]),
    }


def results_of(folder: Path) -> dict[str, str]:
    """Return what identifies the results of a chain: without the logs, the state and the summaries of its steps."""
    return {
        name: value
        for name, value in fingerprints(folder).items()
        if not name.startswith("logs") and Path(name).suffix != ".json"
    }


def interrupted_chain(
    words: Sequence[str], output: Path, duration: float, moments: int, rng: np.random.Generator
) -> Row:
    """Interrupt a chain at random moments, resume it each time, and return whether the steps ended as they should."""
    statuses = []
    for _ in range(moments):
        name = str(rng.choice(SIGNALS))
        process = start(words, output.with_name("tmp"))
        time.sleep(rng.uniform(START_OF_PYTHON, duration / 3))
        process.send_signal(getattr(signal, name))
        process.communicate(timeout=LONGEST_CALL)
        statuses.append(f"{name} {process.returncode}")
        if process.returncode == 0:  # it was over before the signal came: the next one begins anew
            shutil.rmtree(output)
    last = start(words, output.with_name("tmp"))
    said = messages(last.communicate(timeout=LONGEST_CALL)[1])
    return {
        "statuses": " ".join(statuses),
        "last": last.returncode,
        "said": " | ".join(said),
        "left": leftovers(output),
    }


def without_room(call: Call, folder: Path, before: Callable[[], None] | None, named: str) -> Row:
    """Run a call that cannot write its output: status 2, one message, and the folder is as before."""
    output = folder / "out"
    then = fingerprints(output)
    process = start(call.words(output), folder / "tmp", before)
    said = messages(process.communicate(timeout=LONGEST_CALL)[1])
    return {
        "command": call.command,
        "fault": named,
        "status": process.returncode,
        "one message": process.returncode == 2 and len(said) == 1,
        "nothing left": fingerprints(output) == then and not leftovers(output),
        "said": " | ".join(said),
    }


def limit_files(largest: int) -> Callable[[], None]:
    """Return what lets a process write no file beyond this size [bytes]."""
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))


def lose_rights() -> None:
    """Give up the right of root to write to read-only folders: the next program of this process does not have it."""
    for right in WRITE_ANYWHERE:
        ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, right, 0, 0, 0)


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[bool]:
    """Mount a file system of this size [bytes] there, and yield whether that was permitted."""
    folder.mkdir(parents=True, exist_ok=True)
    words = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    mounted = subprocess.run(words, capture_output=True, check=False).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", str(folder)], check=False)


def chain_words(campaign: Path, output: Path) -> list[str]:
    """Return the call of the whole chain by `make`, as the Makefile of the project does it."""
    balance = " ".join(PROGRAM)
    return [
        "make", "-s", "-f", str(ROOT / "pipeline.mk"), f"CAMPAIGN={campaign}", f"RESULTS={output}", f"BALANCE={balance}"
    ]  # fmt: skip


def shared_calls(campaign: Path, folder: Path) -> list[tuple[Call, Call]]:
    """Return pairs of calls with different results and the same outputs."""
    geometry = campaign / "geometry.yaml"
    calibrations = [
        Call("calibrate", ("-g", geometry, campaign / f"{run}.h5", "-o", "OUT/c.h5"), ("c.h5",))
        for run in ("static-bare", "static-trim")
    ]
    known = ("--calibration", folder / "calibration.h5")
    smoothed = ("--model", folder / "model.h5", "--method", "smoother", "--history", "OUT/h", "-o", "OUT/l.h5")
    reductions = [
        Call(
            "reduce", (campaign / "check-1.h5", campaign / "wind-1.h5", *known, *smoothed, "--harmonics", n), ("l.h5",)
        )
        for n in ("2", "3")
    ]
    imports = [
        Call("import", (import_map(folder, scale), folder / "hover-1.csv", "-o", "OUT"), ("wind-1.h5",))
        for scale in (1, 2)
    ]
    return [(a, b) for a, b in (calibrations, reductions, imports)]
