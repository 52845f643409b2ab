"""Progress of a long step: a bar where stderr is a terminal, else a line from time to time."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import click

T = TypeVar("T")

BAR_FORMAT = "{desc} {percentage:3.0f} %|{bar}| {elapsed}<{remaining}"
LINE_INTERVAL = 10.0
"""[s] between the lines of a step: a log stays short, and nobody takes the step for dead."""


class ProgressLines:
    """Lines on stderr, at most one in LINE_INTERVAL, the first after as long: short steps are silent."""

    def __init__(self) -> None:
        self._begin = self._last = time.monotonic()

    def show(self, task: str, fraction: float) -> None:
        """Report the fraction of a task that is done, with the time that is left at the rate so far."""
        now = time.monotonic()
        if now - self._last < LINE_INTERVAL:
            return
        self._last, elapsed = now, now - self._begin
        left = f", about {elapsed * (1.0 / fraction - 1.0):.0f} s left" if 0.0 < fraction < 1.0 else ""
        click.echo(f"balance: {task}: {100 * fraction:.0f} % after {elapsed:.0f} s{left}", err=True)


def track(items: Iterable[T], description: str, total: int | None) -> Iterator[T]:
    """Yield the same items, with their progress as far as their number is known."""
    if sys.stderr.isatty():
        from tqdm import tqdm

        tqdm.monitor_interval = 0  # no thread, which would make the fork of the process that reads files unsafe
        yield from tqdm(items, desc=description, total=total, file=sys.stderr, leave=False)
        return
    lines = ProgressLines()
    for done, item in enumerate(items):
        if total:
            lines.show(f"{description}, {done} of {total}", done / total)
        yield item


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Yield a callback `show(task, fraction)`: it draws a bar where stderr is a terminal, else it writes lines."""
    if not sys.stderr.isatty():
        yield ProgressLines().show
        return
    from tqdm import tqdm

    tqdm.monitor_interval = 0
    with tqdm(total=1.0, bar_format=BAR_FORMAT, file=sys.stderr, leave=False) as bar:

        def show(task: str, fraction: float) -> None:
            bar.set_description_str(f"{task:<32.32}", refresh=False)
            bar.n = min(max(fraction, 0.0), 1.0)
            bar.refresh()

        yield show
