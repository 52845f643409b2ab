"""Lines below the head of a text table that are no load points: headings of blocks, footers, and rows of statistics.

A row of statistics is known by its word (`Mean`, `Std. dev.`, `Summe`) or, at the end of the table, by its numbers,
which are the means of the columns above it.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError

Array = NDArray[np.float64]
Row = tuple[int, tuple[str, ...]]
ParseNumber = Callable[[str], float | None]

MEAN_WORDS = frozenset(
    (
        *("mean", "average", "avg", "std", "stdev", "stddev", "standarddeviation", "sd", "rms", "median"),
        *("mittel", "mittelwert", "standardabweichung", "stabw", "moyenne", "ecarttype", "media", "promedio"),
    )
)
"""Words that name no load point, in lower case and without accents."""
OTHER_WORDS = frozenset(
    (
        *("max", "maximum", "min", "minimum", "sum", "total", "count", "range", "summe", "anzahl", "somme"),
        *("fs", "fullscale", "rated", "ratedload", "capacity", "messbereich", "nennlast"),
    )
)
"""Words that may also label a load point, such as the largest load of a series."""
MOST_STATISTICS = 6
"""Rows of statistics below a table: mean, standard deviation, largest, smallest, range, number."""
FEWEST_POINTS = 5
"""Rows above a row of means without a word: of fewer, one is their mean too easily."""
FEWEST_MEANS = 3
"""Columns that a row of means without a word must have, each other than zero: a tare point has means near zero."""
MIN_UNITS_OF_MEAN = 20.0
"""Units of the last digit that such a mean must have, so that it is none by accident."""


def separate_rows(rows: Sequence[Row], columns: int, parse: ParseNumber) -> tuple[list[Row], list[Row]]:
    """Separate the rows below the head into load points and others; `columns`: the number of cells of the head."""
    texts = [row for row in rows if _is_text(row[1], parse)]
    numbers = [row for row in rows if not _is_text(row[1], parse)]
    statistics = {line for line, _ in _statistics(numbers, columns, parse)}
    points = [row for row in numbers if row[0] not in statistics]
    return points, sorted([*texts, *(row for row in numbers if row[0] in statistics)])


def _is_text(cells: Sequence[str], parse: ParseNumber) -> bool:
    """Whether a line has words and no number."""
    return any(cells) and not any(cell and parse(cell) is not None for cell in cells)


def _statistics(rows: Sequence[Row], columns: int, parse: ParseNumber) -> Iterator[Row]:
    """Yield the rows of statistics among rows with numbers."""
    named = _named_rows(rows, columns, parse)
    yield from named
    lines = {line for line, _ in named}
    rest = [row for row in rows if row[0] not in lines]
    if not named:
        yield from _rows_of_means(rest, columns, parse)


def _named_rows(rows: Sequence[Row], columns: int, parse: ParseNumber) -> list[Row]:
    """Rows with a word of statistics, in a column of numbers or, at the end of the table, in one of labels."""
    words = {line: word for line, cells in rows if (word := _word_of_statistics(cells[:columns])) is not None}
    if not words:
        return []
    counts = [
        sum(1 for _, cells in rows if column < len(cells) and parse(cells[column]) is not None)
        for column in range(columns)
    ]
    points = len(rows) - len(words)
    named = [(line, cells) for line, cells in rows if line in words and 2 * counts[words[line][0]] >= max(points, 1)]
    return named or _named_end(rows, words)


def _named_end(rows: Sequence[Row], words: Mapping[int, tuple[int, str]]) -> list[Row]:
    """The last rows where each has another word of statistics that no other row has, one of them that of a mean."""
    end: list[Row] = []
    for row in reversed(rows):
        if row[0] not in words or len(end) == MOST_STATISTICS:
            break
        end.append(row)
    of_end = [words[line] for line, _ in end]
    is_single = len(set(of_end)) == len(of_end) == len(words)
    return end[::-1] if is_single and any(word in MEAN_WORDS for _, word in of_end) else []


def _word_of_statistics(cells: Sequence[str]) -> tuple[int, str] | None:
    """Column and word of the first cell that is a word of statistics."""
    for column, cell in enumerate(cells):
        word = _plain_word(cell) if cell and cell[0].isalpha() else ""
        if word in MEAN_WORDS or word in OTHER_WORDS:
            return column, word
    return None


@lru_cache(maxsize=1024)
def _plain_word(cell: str) -> str:
    """Letters of a cell, in lower case and without accents."""
    return re.sub(r"[^a-z]", "", unicodedata.normalize("NFKD", cell).lower())


# ---- rows of means without a word ------------------------------------------------------------------------------------


def _rows_of_means(rows: Sequence[Row], columns: int, parse: ParseNumber) -> list[Row]:
    """The last rows where one is the mean of those above them, and the others are other statistics of them.

    None where such a row repeats one above it, as unloaded rows do: their readings are the means of symmetric loads.
    """
    for count in range(min(MOST_STATISTICS, len(rows) - FEWEST_POINTS), 0, -1):
        points, end = rows[:-count], rows[-count:]
        kinds = [{"mean", *_OTHER_STATISTICS} for _ in end]
        means = np.zeros(count, int)
        for column in range(columns):
            _keep_matching(kinds, means, points, end, column, parse)
            if not all(kinds) or not any("mean" in kind for kind in kinds):
                break
        else:
            is_mean = np.array([kind == {"mean"} for kind in kinds])
            is_repeated = not {cells for _, cells in points}.isdisjoint(cells for _, cells in end)
            if np.any(is_mean & (means >= FEWEST_MEANS)) and not is_repeated:
                return list(end)
    return []


_OTHER_STATISTICS: Mapping[str, Callable[[Array], float]] = {
    "std": lambda values: float(np.std(values, ddof=1)),
    "population std": lambda values: float(np.std(values)),
    "max": lambda values: float(np.max(values)),
    "min": lambda values: float(np.min(values)),
    "range": lambda values: float(np.ptp(values)),
    "count": lambda values: float(len(values)),
}


def _keep_matching(
    kinds: Sequence[set[str]],
    means: NDArray[np.int_],
    points: Sequence[Row],
    end: Sequence[Row],
    column: int,
    parse: ParseNumber,
) -> None:
    """Remove from the `kinds` of each row at the end those that one column contradicts; count the means that tell."""
    stated = [parse(cells[column]) if column < len(cells) and cells[column] else None for _, cells in end]
    if all(value is None for value in stated):
        return
    texts = [cells[column] for _, cells in points if column < len(cells) and cells[column]]
    numbers = [(text, value) for text in texts if (value := parse(text)) is not None]
    values = np.array([value for _, value in numbers])
    if len(values) < FEWEST_POINTS or np.ptp(values) == 0.0:
        return
    unit = max(_last_digit(text) for text, _ in numbers[:100])
    statistics = {"mean": float(np.mean(values))} | {name: of(values) for name, of in _OTHER_STATISTICS.items()}
    for place, ((_, cells), value) in enumerate(zip(end, stated, strict=True)):
        if value is None:
            continue
        # The mean is rounded, and so are the values that it was computed from.
        width = 0.51 * (_last_digit(cells[column]) + unit)
        kinds[place] -= {name for name in set(kinds[place]) if abs(statistics[name] - value) > width}
        means[place] += abs(statistics["mean"]) > MIN_UNITS_OF_MEAN * width


def _last_digit(cell: str) -> float:
    """A unit of the last digit of a number as written, which may have a minus sign of typography in its exponent."""
    mantissa, _, power = cell.lower().replace("d", "e").replace("\N{MINUS SIGN}", "-").partition("e")
    fraction = re.search(r"[.,](\d*)$", mantissa)
    exponent = int(re.sub(r"[^\d-]", "", power) or 0)
    return float(f"1e{exponent - (len(fraction[1]) if fraction else 0)}")


def unnamed_columns(data: Sequence[Row], header: Sequence[str]) -> int:
    """Number of columns that have no name in the head, and hold something."""
    filled = {index for _, cells in data for index, cell in enumerate(cells) if cell}
    return sum(1 for index in filled if index >= len(header) or not header[index])


def require_even_rows(path: Path, data: Sequence[Row], header: Sequence[str], head: Row) -> None:
    """Raise UserError where a row has fewer cells than the head has names, or filled cells where the head has none.

    Notes beside a table stand in columns of the head that are empty there: spreadsheets write all lines equally long.
    """
    line_of_head, cells_of_head = head
    for line, cells in data:
        if any(cells[len(cells_of_head) :]) or len(cells) < len(header):
            columns = "1 column" if len(cells) == 1 else f"{len(cells)} columns"
            fault = f"has {columns}, the head (line {line_of_head}) has {len(header)}"
            remedy = "Give every row one cell for each column, and delete lines that are no rows of the table"
            raise UserError(fault, str(path), f"line {line}", remedy)
