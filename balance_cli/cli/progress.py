"""Progress of a long step: a bar where stderr is a terminal, else a line from time to time; nothing with `--quiet`."""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any, TypeVar

import click

from balance_cli.io.text_output import printable_line

T = TypeVar("T")

BAR_FORMAT = "{desc} {percentage:3.0f} %|{bar}| {elapsed}<{remaining}"
LINE_INTERVAL = 10.0
"""[s] between the lines of a step: a log stays short, and nobody takes the step for dead."""
TICK = 1.0
"""[s] between the redraws of a bar whose step computes, so that its time runs on while it stands."""
USUAL_SIZE = (80, 24)
"""Columns and rows of a terminal that does not say how many it has (0), on which tqdm would draw nothing."""
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


def track(items: Iterable[T], description: str, total: int | None, reads_files: bool = True) -> Iterator[T]:
    """Yield the same items, with their progress as far as their number is known.

    Unless the work on an item `reads_files` (see `working`), the time runs on while an item takes long.
    """
    begin, done = time.monotonic(), 0
    for done, item in enumerate(_shown(items, description, total, reads_files), 1):  # noqa: B007  # counts them
        yield item
    log.info("%s: %d in %.2f s", description, done, time.monotonic() - begin)


def _shown(items: Iterable[T], description: str, total: int | None, reads_files: bool) -> Iterator[T]:
    if is_quiet() or total == 0:
        yield from items
        return
    if sys.stderr.isatty():
        bar = _bar(iterable=items, desc=description, total=total)
        with nullcontext() if reads_files else _repeat(bar.refresh):
            yield from bar
        return
    lines, done = ProgressLines(), 0

    def show() -> None:
        if total:
            lines.show(f"{description}, {done} of {total}", done / total)

    with nullcontext() if reads_files else _repeat(show):
        for done, item in enumerate(items):  # noqa: B007  # `show` reads it
            show()
            yield item


def _bar(**options: Any) -> Any:
    """Return a bar of tqdm on stderr."""
    from tqdm import tqdm

    tqdm.monitor_interval = 0  # no thread, which would make the fork of the process that reads files unsafe
    columns, rows = (None, None) if _has_size() else USUAL_SIZE
    return tqdm(file=sys.stderr, leave=False, ncols=columns, nrows=rows, **options)


def _has_size() -> bool:
    """Whether the terminal says how large it is: some that programs make state none, or are no file."""
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns > 0
    except (OSError, ValueError):
        return False


@contextmanager
def _repeat(call: Callable[[], object]) -> Iterator[None]:
    """Call a function every TICK from a thread of its own; no file is read within, as in `working`."""
    ended = threading.Event()

    def repeat() -> None:
        while not ended.wait(TICK):
            call()

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Yield a callback `show(task, fraction)`: it draws a bar where stderr is a terminal, else it writes lines.

    The time runs on between two calls. No file is read within, as in `working`.
    """
    if is_quiet():
        yield lambda task, fraction: None
        return
    if not sys.stderr.isatty():
        lines, last = ProgressLines(), [("", 0.0)]

        def show_line(task: str, fraction: float) -> None:
            last[0] = task, fraction
            lines.show(task, fraction)

        with _repeat(lambda: lines.show(*last[0])):
            yield _logged(show_line)
        return
    with _bar(total=1.0, bar_format=BAR_FORMAT) as bar, _repeat(bar.refresh):

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
        text = f"{printable_line(task)}: at work for {time.monotonic() - begin:.0f} s"
        click.echo(f"\r{text}" if on_terminal else f"balance: {text}", err=True, nl=not on_terminal)
        wait, shown = 1.0 if on_terminal else LINE_INTERVAL, True
    if on_terminal and shown:
        click.echo("\r\033[K", err=True, nl=False)


def is_quiet() -> bool:
    """Whether the command in work was called with `--quiet`."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.params.get("quiet"))
