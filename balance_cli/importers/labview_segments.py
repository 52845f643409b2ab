"""Files of LabVIEW with a head before each segment, as one table where the segments continue each other.

A program that writes in a loop repeats the head for each piece (`One header per segment`); the times of a segment may
begin anew, and its head says when it began.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date
from itertools import pairwise

from balance_cli.io.errors import UserError

MAGIC = b"LabVIEW Measurement"
END_OF_HEAD = "***End_of_Header***"
FIRST_KEY = "Channels"
TIME_NAME = "X_Value"
LARGEST_GAP = 0.5
"""Of a step, by which a segment may begin early or late and still continue the one before."""


@dataclass(frozen=True)
class _Segment:
    """The head of a segment by its keys, its line of names, its rows of data, and the line (from 1) of the first."""

    head: dict[str, tuple[str, ...]]
    names: str
    rows: tuple[str, ...]
    line: int

    def first_cell(self, key: str) -> str:
        return next((cell for cell in self.head.get(key, ()) if cell), "")

    @property
    def step(self) -> float:
        return _number(self.first_cell("Delta_X"))

    def seconds_until(self, other: _Segment) -> float:
        """Time from the begin of this segment to that of another one [s]."""
        days = (other._day - self._day).days
        return 86400.0 * days + (other._time_of_day - self._time_of_day)

    @property
    def _day(self) -> date:
        return date(*map(int, self.first_cell("Date").replace("-", "/").split("/")))

    @property
    def _time_of_day(self) -> float:
        hours, minutes, seconds = self.first_cell("Time").split(":")
        return 3600.0 * int(hours) + 60.0 * int(minutes) + _number(seconds)


def joined_segments(content: bytes) -> tuple[bytes, int] | None:
    """A file with several segments as one with a single head, and their number; None where it has one, or is another.

    Raises UserError, with the line, where a segment has other channels or another rate, or does not continue the one
    before.
    """
    lines = content.decode("latin-1").splitlines()
    if not content.startswith(MAGIC) or sum(line.startswith(END_OF_HEAD) for line in lines) < 3:
        return None
    start = next(k for k, line in enumerate(lines) if line.startswith(END_OF_HEAD)) + 1
    try:
        segments = list(_segments(lines, start))
        _require_one_kind(segments)
        shifts = _shifts(segments)
    except (ValueError, KeyError, IndexError) as error:
        fault = f"has several segments, and the head of one cannot be read ({error})"
        raise UserError(fault, remedy="Save each segment as a file of its own") from error
    first = segments[0]
    times = [k for k, name in enumerate(first.names.split("\t")) if name.strip() == TIME_NAME]
    rows = [
        _shifted(row, times, shift) for segment, shift in zip(segments, shifts, strict=True) for row in segment.rows
    ]
    return "\n".join([*lines[: first.line - 1], *rows, ""]).encode("latin-1"), len(segments)


def _segments(lines: Sequence[str], start: int) -> Iterator[_Segment]:
    ends = [k for k in range(start, len(lines)) if lines[k].startswith(END_OF_HEAD)]
    begins = [max(k for k in range(start, end) if lines[k].startswith(FIRST_KEY + "\t")) for end in ends]
    for begin, end, next_begin in zip(begins, ends, [*begins[1:], len(lines)], strict=True):
        cells = [line.split("\t") for line in lines[begin:end]]
        head = {row[0]: tuple(cell.strip() for cell in row[1:]) for row in cells}
        rows = tuple(line for line in lines[end + 2 : next_begin] if line.strip())
        yield _Segment(head, lines[end + 1].rstrip("\t"), rows, end + 3)


def _require_one_kind(segments: Sequence[_Segment]) -> None:
    """Raise UserError where a segment has other channels or another rate than the first, or no samples."""
    first = segments[0]
    for segment in segments:
        if segment.names.split("\t") != first.names.split("\t") or segment.head["Delta_X"] != first.head["Delta_X"]:
            raise _fault("has other channels, or another rate, than the first segment", segment)
        if not segment.rows:
            raise _fault("has no samples", segment)


def _shifts(segments: Sequence[_Segment]) -> list[float]:
    """What is to be added to the times of each segment [s]: nothing where they go on as they are written."""
    step = segments[0].step
    written = [(_first_time(one.rows[-1]), _first_time(other.rows[0])) for one, other in pairwise(segments)]
    if all(last is not None and first is not None and _follows(first - last, step) for last, first in written):
        return [0.0] * len(segments)
    shifts = [0.0]
    for one, other in pairwise(segments):
        expected, elapsed = len(one.rows) * step, one.seconds_until(other)
        if abs(elapsed - expected) > LARGEST_GAP * step:
            fault = f"begins {elapsed:.6g} s after the segment before, which lasts {expected:.6g} s"
            raise _fault(fault, other)
        shifts.append(shifts[-1] + expected)
    return shifts


def _follows(distance: float, step: float) -> bool:
    return abs(distance - step) <= LARGEST_GAP * step


def _first_time(row: str) -> float | None:
    cell = row.split("\t", maxsplit=1)[0].strip()
    return _number(cell) if cell else None


def _shifted(row: str, times: Sequence[int], shift: float) -> str:
    if not shift:
        return row
    cells = row.split("\t")
    for k in times:
        if k < len(cells) and cells[k].strip():
            text = repr(round(_number(cells[k]) + shift, 9))
            cells[k] = text.replace(".", ",") if "," in cells[k] else text
    return "\t".join(cells)


def _number(cell: str) -> float:
    return float(cell.replace(",", "."))


def _fault(fault: str, segment: _Segment) -> UserError:
    return UserError(fault, place=f"row {segment.line}", remedy="Save each segment as a file of its own")
