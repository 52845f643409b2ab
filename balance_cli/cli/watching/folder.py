"""A folder that is polled: its run files, as soon as they are whole."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from balance_cli.cli.pipeline.inventory import RUN_SUFFIXES
from balance_cli.cli.pipeline.state import FileStamp


@dataclass
class WatchedFolder:
    """A folder of run files. `known` {path: stamp}: files that are done, as they were then."""

    path: Path
    known: dict[Path, FileStamp] = field(default_factory=dict)
    _last: dict[Path, FileStamp] = field(default_factory=dict)
    _seen: dict[tuple[Path, FileStamp], float] = field(default_factory=dict)

    def poll(self) -> tuple[Path, ...]:
        """Return the files that are new or changed and did not change since the last poll, the oldest first.

        A file that is still being written changes its size or its time from poll to poll.
        """
        stamps = self._stamps()
        ready = [path for path, stamp in stamps.items() if self._last.get(path) == stamp and self._is_new(path, stamp)]
        self._last = stamps
        now = time.monotonic()
        self._seen = {item: self._seen.get(item, now) for item in stamps.items()}
        return tuple(sorted(ready, key=lambda path: (stamps[path].modified, path.name)))

    def has_changing_files(self) -> bool:
        """Return whether the last poll saw a file that is new or changed and not yet done."""
        return any(self._is_new(path, stamp) for path, stamp in self._last.items())

    def mark_done(self, path: Path) -> FileStamp:
        """Remember a file as it was at the last poll: `poll` returns it again only if it has changed since then."""
        self.known[path] = self._last[path]
        return self._last[path]

    def seconds_unchanged(self, path: Path) -> float:
        """Return for how long a file has been as it was at the last poll; its own time may be that of another clock."""
        return time.monotonic() - self._seen[path, self._last[path]]

    def mark_not_done(self, path: Path) -> None:
        """Let `poll` return a file again."""
        self.known.pop(path, None)

    def _is_new(self, path: Path, stamp: FileStamp) -> bool:
        return self.known.get(path) != stamp

    def _stamps(self) -> dict[Path, FileStamp]:
        stamps = {}
        for path in self.path.iterdir():
            # A file can disappear between its listing and its examination: laboratories move files.
            with suppress(OSError):
                if path.suffix.lower() in RUN_SUFFIXES and not path.name.startswith(".") and path.is_file():
                    stamps[path] = FileStamp.of(path)
        return stamps
