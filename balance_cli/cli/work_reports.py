"""How a command shows its long steps, and what it logs of them (`-v`)."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")

log = logging.getLogger(__name__)


class WorkReports:
    """The progress of the steps of one call."""

    def progress(
        self, items: Iterable[T], description: str, total: int | None = None, reads_files: bool = True
    ) -> Iterable[T]:
        """The same items, with a progress bar where stderr is a terminal, else a line every ten seconds.

        Unless the work on an item `reads_files`, the time of the bar runs on while an item takes long.
        """
        from balance_cli.cli.progress import track

        return track(items, description, total, reads_files)

    @contextmanager
    def working(self, task: str) -> Iterator[None]:
        """Show that a step is at work that cannot say how far it is, and reads no file."""
        from balance_cli.cli.progress import working

        with working(task):
            yield

    @contextmanager
    def log_duration(self, task: str) -> Iterator[None]:
        """Log a step with the time it took."""
        begin = time.monotonic()
        yield
        log.info("%s in %.2f s", task, time.monotonic() - begin)
