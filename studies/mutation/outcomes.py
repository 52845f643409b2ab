"""One changed file through one call, and what came of it."""

from __future__ import annotations

import random
import signal
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from studies.interruptions.calls import PROGRESS, fingerprints
from studies.mutation.processes import MOST_MEMORY, Ended, empty_folder, run_forked, run_fresh
from studies.mutation.readers import READERS, Reader

READ, REFUSED = "read", "refused"
INTERNAL, CRASHED, ENDLESS, MEMORY, MESSAGE, LEFT = "internal error", "crashed", "endless", "memory", "message", "left"
FAULTS = (INTERNAL, CRASHED, ENDLESS, MEMORY, MESSAGE, LEFT)
BEYOND_LIMITS = ("not enough memory", "File too large")
"""Parts of messages of a call that met the limits of its process."""
SKIPPED = 4
"""Exit status of a batch from which runs were left out, each named in a warning."""


@dataclass(frozen=True)
class Outcome:
    """What a call made of a file: `kind` is READ, REFUSED or one of FAULTS; `text` is its message."""

    reader: str
    seed: int
    kind: str
    text: str
    words: str


def mutate(reader: Reader, base: Path, seed: int) -> bytes:
    """The example of the reader, changed in the way of this seed."""
    return reader.mutate((base / reader.example).read_bytes(), random.Random(seed))


def try_file(name: str, base: Path, work: Path, seed: int) -> Outcome:
    """Change the example of a reader, and make one of its calls on it in a fork of this process."""
    words = _prepare(name, base, work, seed)
    ended = run_forked(words, work)
    kind, text = _judge(ended, list((work / "out").iterdir()))
    return Outcome(name, seed, kind, text, " ".join(words))


def differences(name: str, base: Path, work: Path, seed: int) -> list[str]:
    """What a forked and a fresh process of one call do not share: status, messages, files left and their content."""
    first, second = (_traces(run, name, base, work, seed) for run in (run_forked, run_fresh))
    return [item for item, trace in first.items() if trace != second[item]]


def _traces(
    run: Callable[[Sequence[str], Path], Ended], name: str, base: Path, work: Path, seed: int
) -> dict[str, object]:
    ended = run(_prepare(name, base, work, seed), work)
    # How often progress is reported depends on how busy the machine is.
    said = [line for line in ended.stderr.splitlines() if line and not PROGRESS.match(line)]
    left = fingerprints(work / "out")
    return {"status": ended.status, "stdout": ended.stdout, "stderr": said, "files": left}


def _prepare(name: str, base: Path, work: Path, seed: int) -> list[str]:
    """Write the changed file, and return the words of the call."""
    reader = READERS[name]
    out = empty_folder(work) / "out"
    out.mkdir()
    bad = work / f"bad{Path(reader.example).suffix}"
    bad.write_bytes(mutate(reader, base, seed))
    # The call is chosen apart from the change, so that each change meets each call in the course of the seeds.
    call = random.Random(seed + 1).choice(reader.calls)
    return [str(word) for word in call(base, bad, out)]


def _judge(ended: Ended, written: Iterable[Path]) -> tuple[str, str]:
    errors = [line for line in ended.stderr.splitlines() if line.startswith("balance: error:")]
    faults = [line.strip() for line in ended.stdout.splitlines() if line.strip().startswith("fault:")]
    message = (errors or faults or [ended.stderr.strip()[-300:]])[0]
    if ended.late or ended.status == -signal.SIGXCPU:
        return ENDLESS, message
    if ended.status < 0:
        return CRASHED, f"signal {-ended.status}"
    if ended.memory > MOST_MEMORY or any(words in message for words in BEYOND_LIMITS):
        return MEMORY, f"{ended.memory / 2**20:.0f} MB, {message}"
    if ended.status not in (0, 2, SKIPPED) or "Traceback" in ended.stderr:
        return INTERNAL, message
    if ended.status == 2 and not (len(errors) == 1 or (not errors and faults)):
        return MESSAGE, ended.stderr[-300:]
    left = [path.name for path in written if ended.status == 2 or path.name.startswith(".part-")]
    if left:
        return LEFT, ", ".join(left)
    return (REFUSED, message) if ended.status == 2 else (READ, "")
