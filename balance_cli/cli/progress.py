"""A progress bar for steps that report their own progress."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

BAR_FORMAT = "{desc} {percentage:3.0f} %|{bar}| {elapsed}"


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Yield a callback `show(task, fraction)`: it draws a bar where stderr is a terminal, else it does nothing."""
    if not sys.stderr.isatty():
        yield lambda task, fraction: None
        return
    from tqdm import tqdm

    with tqdm(total=1.0, bar_format=BAR_FORMAT, file=sys.stderr, leave=False) as bar:

        def show(task: str, fraction: float) -> None:
            bar.set_description_str(f"{task:<32.32}", refresh=False)
            bar.n = min(max(fraction, 0.0), 1.0)
            bar.refresh()

        yield show
