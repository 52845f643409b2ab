"""What `balance run` remembers in its results folder, so that only what changed is repeated.

A step is up to date if its command, the content of its inputs and the version of the package are those of its last
success, and its outputs are as it wrote them. Modification times only save reading: a file whose size and time did not
change is not read again, and one whose time alone changed is compared by content.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from balance_cli.cli.file_check import FileFinding
from balance_cli.io.atomic import atomic_write
from balance_cli.io.errors import UserError
from balance_cli.io.version import __version__

STATE_NAME = "run-state.json"
STATE_FORMAT = "balance-run-state/1"


@dataclass(frozen=True)
class FileStamp:
    """Size [bytes] and modification time [ns] of a file, by which a change is noticed without reading it."""

    size: int
    modified: int

    @classmethod
    def of(cls, path: Path) -> FileStamp:
        """Return the stamp of a file."""
        status = path.stat()
        return cls(status.st_size, status.st_mtime_ns)


@dataclass(frozen=True)
class RememberedFinding:
    """What a file was when it had this stamp, against the geometry of this digest."""

    stamp: FileStamp
    geometry: str
    finding: FileFinding


@dataclass(frozen=True)
class RememberedOutput:
    """An output as its step left it."""

    stamp: FileStamp
    sha256: str

    @classmethod
    def of(cls, path: Path) -> RememberedOutput:
        """Return what identifies a file."""
        return cls(FileStamp.of(path), _sha256(path))

    def matches_file(self, path: Path) -> bool:
        """Return whether the file is as it was left."""
        if not path.is_file():
            return False
        stamp = FileStamp.of(path)
        return stamp == self.stamp or (stamp.size == self.stamp.size and _sha256(path) == self.sha256)


@dataclass(frozen=True)
class RememberedStep:
    """The last success of a step: its signature, its outputs {path within the results: output}, its warnings.

    `refusal` is the reason why the step is not possible, "" where it was done.
    """

    signature: str
    outputs: dict[str, RememberedOutput]
    warnings: int = 0
    refusal: str = ""


@dataclass
class State:
    """What is remembered of files and steps. `steps` and `findings` have the names of steps and the paths as keys."""

    findings: dict[str, RememberedFinding] = field(default_factory=dict)
    steps: dict[str, RememberedStep] = field(default_factory=dict)

    def remember_finding(self, path: Path, stamp: FileStamp, geometry: str, finding: FileFinding) -> None:
        """Remember what a file is."""
        without_content = replace(finding, run=None, geometry=None)
        self.findings[str(path)] = RememberedFinding(stamp, geometry, without_content)

    def is_current(self, name: str, signature: str, results: Path) -> bool:
        """Return whether a step of this signature was done and its outputs are as it left them."""
        step = self.steps.get(name)
        if step is None or step.signature != signature:
            return False
        return all(output.matches_file(results / path) for path, output in step.outputs.items())

    def save(self, results: Path) -> None:
        """Write the state into the results folder, whole or not at all."""
        content = {"format": STATE_FORMAT, "findings": self.findings, "steps": self.steps}
        with atomic_write(results / STATE_NAME) as part:
            part.write_text(json.dumps(content, default=asdict, indent=1), encoding="utf-8")


def load_state(results: Path) -> State:
    """Return the state in a results folder; an empty one where there is none or it cannot be read."""
    # A damaged state costs a repetition of the steps, nothing else.
    with suppress(OSError, ValueError, LookupError, TypeError, AttributeError):
        content = json.loads((results / STATE_NAME).read_text(encoding="utf-8"))
        if content["format"] == STATE_FORMAT:
            findings = {path: _read_finding(item) for path, item in content["findings"].items()}
            return State(findings, {name: _read_step(item) for name, item in content["steps"].items()})
    return State()


def signature(words: Iterable[str], digests: Iterable[str]) -> str:
    """Return the digest of a command, the content of its inputs and the version of the package."""
    return hashlib.sha256(json.dumps([__version__, list(words), list(digests)]).encode()).hexdigest()


def _read_finding(item: dict[str, Any]) -> RememberedFinding:
    finding = dict(item["finding"])
    finding["faults"] = tuple(UserError(**fault) for fault in finding["faults"])
    return RememberedFinding(FileStamp(**item["stamp"]), item["geometry"], FileFinding(**finding))


def _read_step(item: dict[str, Any]) -> RememberedStep:
    outputs = {
        path: RememberedOutput(FileStamp(**output["stamp"]), output["sha256"])
        for path, output in item["outputs"].items()
    }
    return RememberedStep(item["signature"], outputs, item["warnings"], item["refusal"])


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
