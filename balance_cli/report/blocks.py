"""Building blocks of the page: sections of text, warnings, tables and pictures, as plain data for the template."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

from balance_cli.report.plots import Plot


@dataclass(frozen=True)
class TableCell:
    """A cell of a table: text, a note in small print beside it, the number of columns it spans, and its styles.

    `mark` names styles, separated by blanks: `good`, `bad`, `best`, `quiet`, `group`, `name`. `title` is shown under
    the pointer.
    """

    text: str
    note: str = ""
    mark: str = ""
    span: int = 1
    title: str = ""


Row = tuple[TableCell, ...]


@dataclass(frozen=True)
class Table:
    """A table with a caption; `head` may have several rows. A `sortable` one sorts and filters where scripts run."""

    kind: ClassVar[str] = "table"
    caption: str
    head: tuple[Row, ...]
    rows: tuple[Row, ...]
    sortable: bool = False


@dataclass(frozen=True)
class RunIndex:
    """A sortable table of runs with a small curve for each, and the loads of every run, which a click unfolds.

    `curves`: paths for a box of 100 by 24, one for each row (empty: none). `data`: JSON of the page's script.
    """

    kind: ClassVar[str] = "index"
    table: Table
    curves: tuple[str, ...]
    data: str


@dataclass(frozen=True)
class Card:
    """The answer for one run: its name, a note, a verdict (`badge`, with the style `mark`), a sentence and a table."""

    title: str
    note: str
    badge: str
    mark: str
    sentence: str
    head: tuple[Row, ...]
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class CardGrid:
    """Cards side by side as far as the screen is wide."""

    kind: ClassVar[str] = "cards"
    cards: tuple[Card, ...]


@dataclass(frozen=True)
class Picture:
    """A picture as self-contained markup (inline SVG); `name` is unique on the page."""

    kind: ClassVar[str] = "picture"
    name: str
    caption: str
    markup: str


@dataclass(frozen=True)
class PlotGroup:
    """Plots that are shown together; several groups of one chart are offered as a choice under `label`."""

    label: str
    plots: tuple[Plot, ...]


@dataclass(frozen=True)
class Chart:
    """A picture that zooms, pans and reads out values where scripts run.

    Charts of one `link` zoom together. `static_markup` is shown in print and without scripts (empty: drawn from the
    plots of the first group). `wide`: one plot a row.
    """

    kind: ClassVar[str] = "chart"
    name: str
    caption: str
    groups: tuple[PlotGroup, ...]
    link: str = ""
    static_markup: str = ""
    wide: bool = False

    @classmethod
    def single(cls, name: str, caption: str, plots: tuple[Plot, ...], link: str = "", wide: bool = False) -> Chart:
        """Return a chart of one group of plots."""
        return cls(name, caption, (PlotGroup("", plots),), link, wide=wide)


@dataclass(frozen=True)
class Paragraph:
    """A paragraph; `mark` names a style."""

    kind: ClassVar[str] = "text"
    text: str
    mark: str = ""


@dataclass(frozen=True)
class WarningText:
    """A paragraph that is highlighted as a warning."""

    kind: ClassVar[str] = "warn"
    text: str


@dataclass(frozen=True)
class BulletList:
    """A list of short statements."""

    kind: ClassVar[str] = "points"
    items: tuple[str, ...]


@dataclass(frozen=True)
class Heading:
    """A heading below that of the section."""

    kind: ClassVar[str] = "heading"
    text: str


@dataclass(frozen=True)
class KeyFigures:
    """Key figures side by side: (number, caption, mark)."""

    kind: ClassVar[str] = "figures"
    items: tuple[tuple[str, str, str], ...]


@dataclass(frozen=True)
class Details:
    """Blocks that unfold on a click (and are always printed)."""

    kind: ClassVar[str] = "details"
    summary: str
    blocks: tuple[PageBlock, ...]


PageBlock = (
    Table
    | RunIndex
    | CardGrid
    | Picture
    | Chart
    | Paragraph
    | WarningText
    | BulletList
    | Heading
    | KeyFigures
    | Details
)


@dataclass(frozen=True)
class Section:
    """A section of the page; `key` is its anchor."""

    key: str
    title: str
    blocks: tuple[PageBlock, ...]


def pictures(blocks: Sequence[PageBlock]) -> Iterator[Picture | Chart]:
    """All pictures and charts among the blocks, including those inside `Details`."""
    for block in blocks:
        if isinstance(block, (Picture, Chart)):
            yield block
        elif isinstance(block, Details):
            yield from pictures(block.blocks)


def plain_row(*texts: str, mark: str = "") -> Row:
    """A row of plain cells."""
    return tuple(TableCell(text, mark=mark) for text in texts)


def row_with_name(name: str, *texts: str) -> Row:
    """A row whose first cell names it."""
    return (TableCell(name, mark="name"), *plain_row(*texts))


def group_heading_row(text: str, span: int) -> Row:
    """A heading row over the rows below it."""
    return (TableCell(text, mark="group", span=span),)
