"""How a result shows itself in a console and in a notebook: a summary of a few lines, and a table."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from html import escape
from textwrap import shorten
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

WARNING_WIDTH = 116
"""Characters of a warning in a summary, which has lines of 120; the result holds all of it."""
MAX_HTML_ROWS = 20
"""Rows of a table in a notebook; pandas shortens a longer one in the middle."""


class ResultView:
    """Base of the results that artefacts hold, for dataclasses with `repr=False`.

    A result writes its summary (`summary_lines`, at most seven lines) and its table (`to_frame`) itself; both read
    stored fields only, so that neither the digest nor the file of a result depends on them.
    """

    @abstractmethod
    def summary_lines(self) -> Iterator[str]:
        """The result in one to seven lines: what it is, how many, how good, and what is flagged."""

    @abstractmethod
    def to_frame(self) -> pd.DataFrame:
        """The result as one table."""

    def __repr__(self) -> str:
        return "\n".join(self.summary_lines())

    def _repr_html_(self) -> str:
        """The summary and the table, for a notebook."""
        lines = "<br>".join(escape(line) for line in self.summary_lines())
        table = self.to_frame().to_html(max_rows=MAX_HTML_ROWS, show_dimensions=True, border=0, index=False)
        return f"<p>{lines}</p>\n{table}"


def warning_lines(texts: Sequence[str] | None) -> Iterator[str]:
    """Yield one line of a summary for what is to be known of a result: the first text, and how many there are."""
    if texts:
        more = f" (and {len(texts) - 1} more)" if len(texts) > 1 else ""
        yield shorten(f"warning: {texts[0]}", WARNING_WIDTH - len(more), placeholder=" ...").join(("  ", more))


def plural(count: int, noun: str) -> str:
    """`1 run`, `2 runs`."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
