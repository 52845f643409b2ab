"""Execution of the steps: each in a process of its own, several at a time, repeated only where something changed."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

from balance_cli.cli.errors import EXIT_RUNS_SKIPPED
from balance_cli.cli.pipeline.folder import log_path
from balance_cli.cli.pipeline.state import RememberedOutput, RememberedStep, State, signature
from balance_cli.cli.pipeline.steps import Plan, Step
from balance_cli.io.sniff import is_hdf5
from balance_cli.io.text_output import write_text

START_COMMAND = """
import _thread, os, signal, sys

def end_with_parent():
    os.read(0, 1)
    os.kill(os.getpid(), signal.SIGTERM)

_thread.start_new_thread(end_with_parent, ())
sys.path[:] = sys.argv.pop(1).split(chr(10))
from balance_cli.__main__ import main
main()
"""
"""Program of a step. It finds the same packages as this process, whatever files lie in the working folder.

It ends when this process does, even if this was killed: a step that went on alone would later replace what another call
has written. Standard input is a pipe for this, to which nothing is written.
"""
ERROR_PREFIX = "balance: error: "
WARNING_PREFIX = "balance: warning: "
TERMINATION_WAIT = 5.0
"""[s]. A command that is terminated removes its staged files within milliseconds."""
EXIT_REFUSED = 2

DONE, CURRENT, REFUSED, FAILED, NOT_DONE, TO_DO = (
    "done",
    "up to date",
    "not possible",
    "failed",
    "not done",
    "to do",
)


@dataclass(frozen=True)
class Outcome:
    """What became of a step: `result` is one of the constants above, `detail` says why or how, in words."""

    step: str
    result: str
    seconds: float = 0.0
    warnings: int = 0
    detail: str = ""
    status: int = 0


@dataclass
class Execution:
    """The execution of a plan. `made` are the outputs that are there; `show` prints each outcome.

    `working` shows that steps are at work while they do nothing that could be shown.
    """

    plan: Plan
    results: Path
    state: State
    digests: dict[Path, str]
    jobs: int
    show: Callable[[Outcome], None]
    working: Callable[[str], AbstractContextManager[None]] = lambda task: nullcontext()
    made: list[Path] = field(default_factory=list)
    outcomes: dict[str, Outcome] = field(default_factory=dict)

    def run(self) -> dict[str, Outcome]:
        """Do all steps that are not up to date, and return {name: outcome} in the order of the plan."""
        self.state.save(self.results)
        processes: list[subprocess.Popen[str]] = []
        with _terminate_on_signal(processes), ThreadPoolExecutor(self.jobs) as pool:
            running: dict[Future[tuple[int, str, float]], Step] = {}
            while len(self.outcomes) < len(self.plan.steps):
                for step in self._ready(running):
                    if not self._settle_without_running(step):
                        log_path(self.results, step.name).touch()
                        words = step.arguments(self.made)
                        running[pool.submit(_run_command, words, processes)] = step
                    if len(running) >= self.jobs:
                        break
                if running and (len(running) >= self.jobs or not any(self._ready(running))):
                    with self.working(", ".join(step.name for step in running.values())):
                        done = wait(running, return_when=FIRST_COMPLETED).done
                    for future in done:
                        self._record_outcome(running.pop(future), *future.result())
        return {step.name: self.outcomes[step.name] for step in self.plan.steps}

    def preview(self) -> dict[str, Outcome]:
        """Return what `run` would do, without doing it: a step after one that would run is said to run, too."""
        pending: set[Path] = set()
        for step in self.plan.steps:
            inputs = {*step.reads, *step.reads_if_there, *step.reads_first_of}
            current = not inputs & pending and self._is_current(step)
            if current and self.state.steps[step.name].refusal:
                outcome = Outcome(step.name, REFUSED, detail=self.state.steps[step.name].refusal)
            elif current:
                outcome = Outcome(step.name, CURRENT)
                self.made.extend(step.writes)
            else:
                words = step.arguments([*self.made, *pending])
                outcome = Outcome(step.name, TO_DO, detail=describe(words))
                pending.update(step.writes)
            self._record(outcome)
        return dict(self.outcomes)

    def _ready(self, running: dict[Future[tuple[int, str, float]], Step]) -> Iterator[Step]:
        """Yield the steps that are neither settled nor running, and whose inputs are settled."""
        busy = {step.name for step in running.values()}
        open_files = {path for step in self.plan.steps if step.name not in self.outcomes for path in step.writes}
        for step in self.plan.steps:
            if step.name in self.outcomes or step.name in busy:
                continue
            if not open_files & {*step.reads, *step.reads_if_there, *step.reads_first_of}:
                yield step

    def _settle_without_running(self, step: Step) -> bool:
        """Return whether a step need not run, or cannot, and record so."""
        missing = [path for path in step.reads if path not in self.digests and path not in self.made]
        alternatives = step.reads_first_of or step.reads_if_there
        if missing or (alternatives and not set(alternatives) & set(self.made)):
            needed = missing[:1] or alternatives
            lacking = needed[0].name if len(needed) == 1 else "none of its inputs"
            self._record(Outcome(step.name, NOT_DONE, detail=f"{lacking} was {'not ' * (len(needed) == 1)}made"))
            return True
        if not self._is_current(step):
            return False
        remembered = self.state.steps[step.name]
        if remembered.refusal:
            self._record(Outcome(step.name, REFUSED, detail=remembered.refusal))
        else:
            self.made.extend(step.writes)
            self._record(Outcome(step.name, CURRENT, warnings=remembered.warnings))
        return True

    def _record_outcome(self, step: Step, status: int, text: str, seconds: float) -> None:
        """Record the end of a command, and remember it."""
        write_text(log_path(self.results, step.name), text)
        warnings = sum(line.startswith(WARNING_PREFIX) for line in text.splitlines())
        sign, outputs = self._signature(step), {}
        if status in (0, EXIT_RUNS_SKIPPED):
            self.made.extend(step.writes)
            outputs = {str(path.relative_to(self.results)): RememberedOutput.of(path) for path in step.writes}
            outcome = Outcome(step.name, DONE, seconds, warnings, status=status)
        else:
            result = REFUSED if step.optional and status == EXIT_REFUSED else FAILED
            outcome = Outcome(step.name, result, seconds, warnings, _error_text(text), status)
        if outcome.result in (DONE, REFUSED):
            self.state.steps[step.name] = RememberedStep(sign, outputs, warnings, outcome.detail)
            self.state.save(self.results)
        self._record(outcome)

    def _record(self, outcome: Outcome) -> None:
        self.outcomes[outcome.step] = outcome
        self.show(outcome)

    def _is_current(self, step: Step) -> bool:
        remembered = self.state.steps.get(step.name)
        return remembered is not None and self.state.is_current(step.name, self._signature(step), self.results)

    def _signature(self, step: Step) -> str:
        """Return the digest of the options and of the content of the inputs; names of folders do not matter."""
        words = [word.name if isinstance(word, Path) else word for word in step.words]
        words = [word.replace(str(self.results), "") for word in words]
        return signature(words, [f"{path.name} {self._digest(path)}" for path in step.inputs(self.made)])

    def _digest(self, path: Path) -> str:
        return self.digests.get(path) or content_digest(path)


def content_digest(path: Path) -> str:
    """Return the digest of an artefact as it states it, of another file that of its bytes."""
    if is_hdf5(path):
        import h5py

        with suppress(OSError, KeyError), h5py.File(path, "r") as file:
            return str(file.attrs["digest"])
    return RememberedOutput.of(path).sha256


def _run_command(words: list[str], processes: list[subprocess.Popen[str]]) -> tuple[int, str, float]:
    """Run one command and return its status, its text (output and messages) and its duration [s]."""
    begin = time.monotonic()
    program = [sys.executable, "-c", START_COMMAND, "\n".join(sys.path), *words]
    read_end, write_end = os.pipe()  # the write end is not inherited: it is closed with this process
    process = subprocess.Popen(
        program,
        stdin=read_end,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        errors="replace",
        env=os.environ | {"PYTHONIOENCODING": "utf-8"},
    )
    processes.append(process)
    os.close(read_end)
    text, _ = process.communicate()
    processes.remove(process)
    os.close(write_end)
    return process.returncode, text, time.monotonic() - begin


def _error_text(text: str) -> str:
    """Return the message with which a command ended, without its prefix."""
    errors = [line.removeprefix(ERROR_PREFIX) for line in text.splitlines() if line.startswith(ERROR_PREFIX)]
    return errors[-1] if errors else (text.strip().splitlines() or ["it ended without a message"])[-1]


@contextmanager
def _terminate_on_signal(processes: list[subprocess.Popen[str]]) -> Iterator[None]:
    """Terminate the running commands before a signal ends this process: they then remove their staged files."""
    before = {}

    def terminate(number: int, frame: FrameType | None) -> None:
        running = list(processes)
        for process in running:
            process.terminate()
        for process in running:
            with suppress(subprocess.TimeoutExpired):
                process.wait(TERMINATION_WAIT)
        message = "balance: interrupted; finished steps are kept, and the same call resumes from there\n"
        with suppress(OSError):
            os.write(2, message.encode())
        os._exit(128 + number)

    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            with suppress(ValueError):  # not in the main thread
                before[number] = signal.signal(number, terminate)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def describe(words: list[str]) -> str:
    """Return a command as a line that a shell understands."""
    return shlex.join(["balance", *words])


def summary(outcomes: dict[str, Outcome]) -> dict[str, dict[str, object]]:
    """Return {step: what became of it} for the JSON summary."""
    return {
        name: {"result": item.result, "seconds": round(item.seconds, 2), "warnings": item.warnings}
        | ({"detail": item.detail} if item.detail else {})
        for name, item in outcomes.items()
    }
