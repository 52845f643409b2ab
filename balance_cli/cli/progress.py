"""A progress bar for a step that says itself how far it is."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

BAR_FORMAT = "{desc} {percentage:3.0f} %|{bar}| {elapsed}"


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """What a step calls with what it is at and the share that is done; a bar on stderr where that is a terminal."""
    if not sys.stderr.isatty():
        yield lambda what, fraction: None
        return
    from tqdm import tqdm

    with tqdm(total=1.0, bar_format=BAR_FORMAT, file=sys.stderr, leave=False) as bar:

        def show(what: str, fraction: float) -> None:
            bar.set_description_str(f"{what:<32.32}", refresh=False)
            bar.n = min(max(fraction, 0.0), 1.0)
            bar.refresh()

        yield show
