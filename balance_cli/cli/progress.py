"""Progress of a long step: a bar where stderr is a terminal, else a line from time to time; nothing with `--quiet`."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import click

T = TypeVar("T")

BAR_FORMAT = "{desc} {percentage:3.0f} %|{bar}| {elapsed}<{remaining}"
LINE_INTERVAL = 10.0
"""[s] between the lines of a step: a log stays short, and nobody takes the step for dead."""
FIRST_SIGN = 2.0
"""[s] after which a step that cannot say how far it is shows on a terminal that it is at work."""

log = logging.getLogger(__name__)


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
    begin, done = time.monotonic(), 0
    for done, item in enumerate(_shown(items, description, total), 1):  # noqa: B007  # counts them
        yield item
    log.info("%s: %d in %.2f s", description, done, time.monotonic() - begin)


def _shown(items: Iterable[T], description: str, total: int | None) -> Iterator[T]:
    if is_quiet():
        yield from items
        return
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
    if is_quiet():
        yield lambda task, fraction: None
        return
    if not sys.stderr.isatty():
        lines = ProgressLines()
        yield _logged(lines.show)
        return
    from tqdm import tqdm

    tqdm.monitor_interval = 0
    with tqdm(total=1.0, bar_format=BAR_FORMAT, file=sys.stderr, leave=False) as bar:

        def show(task: str, fraction: float) -> None:
            bar.set_description_str(f"{task:<32.32}", refresh=False)
            bar.n = min(max(fraction, 0.0), 1.0)
            bar.refresh()

        yield _logged(show)


def _logged(show: Callable[[str, float], None]) -> Callable[[str, float], None]:
    """Return the callback; each task is logged with the time since the first."""
    begin = time.monotonic()

    def show_and_log(task: str, fraction: float) -> None:
        log.info("%s, %.2f s", task, time.monotonic() - begin)
        show(task, fraction)

    return show_and_log


@contextmanager
def working(task: str) -> Iterator[None]:
    """Show that a step is at work that cannot say how far it is: seconds on a terminal, else a line from time to time.

    No file is read within: the process that reads files must not be forked beside the thread that counts.
    """
    begin, ended = time.monotonic(), threading.Event()
    thread = None
    if not is_quiet():
        thread = threading.Thread(target=_count_seconds, args=(task, begin, ended), daemon=True)
        thread.start()
    try:
        yield
    finally:
        ended.set()
        if thread is not None:
            thread.join()
    log.info("%s in %.2f s", task, time.monotonic() - begin)


def _count_seconds(task: str, begin: float, ended: threading.Event) -> None:
    on_terminal = sys.stderr.isatty()
    wait, shown = FIRST_SIGN if on_terminal else LINE_INTERVAL, False
    while not ended.wait(wait):
        text = f"{task}: at work for {time.monotonic() - begin:.0f} s"
        click.echo(f"\r{text}" if on_terminal else f"balance: {text}", err=True, nl=not on_terminal)
        wait, shown = 1.0 if on_terminal else LINE_INTERVAL, True
    if on_terminal and shown:
        click.echo("\r\033[K", err=True, nl=False)


def is_quiet() -> bool:
    """Whether the command in work was called with `--quiet`."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.params.get("quiet"))
