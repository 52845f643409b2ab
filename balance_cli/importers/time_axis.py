"""Sample rate and start from a column of times."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from balance_cli.importers.base import Array, ReadBlock
from balance_cli.importers.missing_rows import require_no_gap
from balance_cli.importers.uneven_times import are_uneven
from balance_cli.importers.written_times import read_written_times
from balance_cli.io.errors import UserError

BLOCK = 2**17
DAY = 86400.0
"""[s]"""
LARGEST_SCATTER = 0.6
"""Steps by which a time may be off the straight line through all: times that are rounded to half a step are equal
steps, a missing or a repeated sample shifts those behind it by a whole one."""
SHIFT_WINDOW = 512
LARGEST_SHIFT = 0.2
"""Samples, and steps by which their mean may be off the line: rounding averages out, and a missing sample in the middle
of a record puts the means on either side off by up to half a step."""
LARGEST_REPEATED_SHARE = 0.5
"""Of the times; where more are equal to the one before, their last digit is longer than two steps."""
FEWEST_CHANGES = 2
"""Groups of equal times, all of one size, by which the rows are those of several sensors."""
NOTED_SCATTER = 0.02
"""Steps of scatter from which a note is made."""
WHOLE_RATE_TOLERANCE = 3e-6
"""Relative difference from a whole number of hertz that is taken as rounding where the times are rounded too: six
digits of a step. Over ten minutes it shifts the last sample by 1.8 ms of the file's own clock."""


@dataclass(frozen=True)
class TimeAxis:
    """Rate [Hz], time of the first sample [s], and the largest distance of a time from equal steps [steps]."""

    rate: float
    start: float
    scatter: float
    times_of_each: int = 1
    """How often each time is there, as far as the first block shows."""

    @property
    def note(self) -> str:
        """What to tell where the times are not exactly even, else empty."""
        if self.scatter < NOTED_SCATTER:
            return ""
        note = f"times scatter by up to {self.scatter:.2f} steps about equal steps of 1/{self.rate:.10g} s"
        if self.times_of_each > 1:
            note += f", as each is there {self.times_of_each} times: rows of several sensors must be a file for each"
        return note


def read_time_axis(read: ReadBlock, samples: int, factor: float = 1.0) -> TimeAxis:
    """Fit equal steps to the times in column 0; `factor` makes seconds of them.

    The straight line is that of least squares, which averages rounded times. Times of day without dates may pass
    midnight. Raises UserError, with the row, where times are missing, do not increase or are not even.
    """
    try:
        return _even_times(read, samples, factor)
    except UserError as error:
        # A record of a minute passes midnight once in many; the others need no second look at their times.
        with suppress(UserError):
            if (later := _beyond_midnight(read, samples, factor)) is not None:
                return _even_times(later, samples, factor)
        raise error from None


def _beyond_midnight(read: ReadBlock, samples: int, factor: float) -> ReadBlock | None:
    """Times of day that go on counting behind a midnight; None where they do not pass one."""
    starts, before = list[int](), -np.inf
    for start in range(0, samples, BLOCK):
        times = read([0], start, min(start + BLOCK, samples))[:, 0] * factor
        if not (np.all(times >= 0.0) and np.all(times < DAY)):
            return None
        starts += (start + np.flatnonzero(np.diff(times, prepend=before) < -0.5 * DAY)).tolist()
        before = times[-1]

    def later(columns: Sequence[int], start: int, stop: int) -> Array:
        days = np.searchsorted(starts, np.arange(start, stop), side="right")
        return np.asarray(read(columns, start, stop) + days[:, None] * (DAY / factor))

    return later if starts else None


def _even_times(read: ReadBlock, samples: int, factor: float) -> TimeAxis:
    """The equal steps of times that increase throughout, as `read_time_axis`."""
    if samples < 3:
        raise UserError("has fewer than three samples", remedy="Give the sample rate in the map")
    first = float(read([0], 0, 1)[0, 0])
    sums = np.zeros(2)
    middle, square = (samples - 1) / 2.0, samples * (samples**2 - 1.0) / 12.0
    for start in range(0, samples, BLOCK):
        times = _finite(read, start, min(start + BLOCK, samples)) - first
        index = np.arange(start, start + len(times)) - middle
        sums += index @ times, times.sum()
    step, mean = sums[0] / square, sums[1] / samples
    if not step > 0.0:
        fault, remedy = "the times do not increase", "Give the sample rate in the map instead of a time"
        if step < 0.0:
            fault, remedy = "the times decrease from row to row", "Write the rows in the order of their times"
        raise UserError(fault, remedy=remedy)
    written = read_written_times(read, samples, 1.0 / (step * factor), factor)
    if written is not None:
        errors = (read([0], 0, min(BLOCK, samples))[:, 0] * factor - written.start) * written.rate
        return TimeAxis(written.rate, written.start, float(np.abs(errors - np.arange(len(errors))).max()))
    scatter = _scatter(read, samples, first, step, mean - step * middle)
    if samples <= BLOCK:
        require_no_gap(read([0], 0, samples)[:, 0])
    rate = 1.0 / (step * factor)
    if abs(rate - round(rate)) < WHOLE_RATE_TOLERANCE * rate and round(rate) > 0:
        rate = float(round(rate))
    each = times_of_each(np.diff(read([0], 0, min(BLOCK, samples))[:, 0])) if scatter >= NOTED_SCATTER else 1
    return TimeAxis(rate, float(first + mean - step * middle) * factor, scatter, each)


def _largest_mean(errors: Array) -> float:
    """Largest mean over SHIFT_WINDOW values, those left over at the end not counted."""
    count = len(errors) // SHIFT_WINDOW
    return float(np.abs(errors[: count * SHIFT_WINDOW].reshape(count, SHIFT_WINDOW).mean(axis=1)).max(initial=0.0))


def _finite(read: ReadBlock, start: int, stop: int) -> Array:
    times = read([0], start, stop)[:, 0]
    bad = np.flatnonzero(~np.isfinite(times))
    if bad.size:
        place = f"sample {start + int(bad[0]) + 1}"
        raise UserError("a time is missing", place=place, remedy="Correct it, or give the sample rate in the map")
    return times


def _scatter(read: ReadBlock, samples: int, first: float, step: float, begin: float) -> float:
    """Largest distance from the line, in steps. Raises UserError where it is too large for rounding."""
    largest, before = 0.0, None
    for start in range(0, samples, BLOCK):
        times = read([0], start, min(start + BLOCK, samples))[:, 0] - first
        errors = (times - begin) / step - np.arange(start, start + len(times))
        largest = max(largest, float(np.abs(errors).max()))
        if largest > LARGEST_SCATTER or _largest_mean(errors) > LARGEST_SHIFT:
            steps = np.diff(times if before is None else np.concatenate([[before], times])) / step
            raise _uneven(steps, start + (2 if before is None else 1), largest)
        before = times[-1]
    return largest


def _uneven(steps: Array, first: int, largest: float) -> UserError:
    """What is wrong with times whose steps (n,), over the mean step, end at samples from `first`, and what helps."""
    fault = f"the times are not even: {largest:.3g} steps off a straight line"
    worst = int(np.argmax(np.abs(steps - np.median(steps))))
    remedy = "Cut the record at the gap, or give the sample rate in the map"
    if (times := times_of_each(steps)) > 1:
        fault += f" (each time is there {times} times)"
        remedy = "Save the rows of each sensor as a file of its own; give the sample rate in the map if they are of one"
        return UserError(fault, place=f"sample {first}", remedy=remedy)
    if np.mean(steps == 0.0) > LARGEST_REPEATED_SHARE:
        worst = int(np.argmax(np.abs(steps - 1.0)))
        fault += " (most are equal to the one before: they have too few digits to tell a gap from rounding)"
    elif steps.min() < 0.0:
        worst = int(np.argmin(steps))
        fault += " (a time is before that of the row above)"
        remedy = "Write the rows in the order of their times, each once; a clock that begins anew is another record"
    elif steps[worst] == 0.0:
        fault += " (a time is that of the row above)"
        remedy = "Remove rows that are there twice"
        if are_uneven(steps[steps > 0.0]):
            remedy += ", or state `resample` [Hz] in the map: the first of them is then taken"
    elif are_uneven(steps):
        remedy = "State `resample` [Hz] in the map: samples at uneven times are then interpolated"
    return UserError(fault, place=f"sample {first + worst}", remedy=remedy)


def times_of_each(steps: Array) -> int:
    """Return how often each time is there, by the steps from one row to the next; 1 where they differ in that."""
    changes = np.flatnonzero(steps > 0.0)
    counts = np.diff(changes)
    if len(counts) < FEWEST_CHANGES or counts.min() != counts.max() or steps.min() < 0.0:
        return 1
    return int(counts[0])
