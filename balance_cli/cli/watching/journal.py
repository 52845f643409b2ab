"""The journal of a watched folder: one line of JSON for each run file, appended when the file is done."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from balance_cli.cli.pipeline.state import FileStamp
from balance_cli.cli.summary import to_json_value
from balance_cli.io.atomic import os_errors_as_user_error

REDUCED, LEFT_OUT, SKIPPED = "reduced", "left out", "skipped"
"""What became of a file: loads; a run without rotor loads, or no run file; a run that cannot be used."""


@dataclass(frozen=True)
class JournalEntry:
    """A line of the journal.

    `file` is the name of the file within the folder, `result` one of the constants above, `reason` says why a file has
    no loads. `inputs` is the digest of the response and the options by which it was reduced. `seconds` went from the
    last change of the file to its loads on the page. `loads` {component: {`mean`, `mean_sigma`, `harmonic`,
    `amplitude`, `amplitude_sigma`}}. `zero` is the zero run that the mean loads count from, empty for
    none; None: unknown.
    """

    time: str
    file: str
    size: int
    modified: int
    inputs: str
    result: str
    run: str = ""
    kind: str = ""
    reason: str = ""
    verdict: str = ""
    flags: dict[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    seconds: float | None = None
    loads: dict[str, dict[str, Any]] = field(default_factory=dict)
    zero: str | None = None

    @property
    def stamp(self) -> FileStamp:
        """The file as it was."""
        return FileStamp(self.size, self.modified)


def append_entry(path: Path, entry: JournalEntry) -> None:
    """Append a line to the journal and hand it to the disk. UserError where it cannot be written."""
    line = json.dumps(to_json_value(asdict(entry)), ensure_ascii=False, allow_nan=False) + "\n"
    with os_errors_as_user_error(path), path.open("ab+") as file:
        if file.tell() and not _ends_with_line_break(path):
            line = "\n" + line  # the end of a line that an interruption cut off
        file.write(line.encode("utf-8", "backslashreplace"))
        file.flush()
        os.fsync(file.fileno())


def read_entries(path: Path) -> Iterator[JournalEntry]:
    """Yield the entries of a journal, none where there is none; lines that are not whole are passed over."""
    if not path.is_file():
        return
    with os_errors_as_user_error(path):
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    for line in lines:
        # A line that cannot be read costs the repetition of its run, nothing else.
        with suppress(ValueError, TypeError):
            entry = JournalEntry(**json.loads(line))
            if isinstance(entry.size, int) and isinstance(entry.modified, int):
                yield entry


def _ends_with_line_break(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"
