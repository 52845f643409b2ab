"""Repair of 1/rev pulse times: double, stray and mistimed pulses are dropped, missing ones are counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError
from balance_cli.signals.rotor.spectral_floor import row_medians

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

PULSE_DATASET = "rotor/pulse_times"
PULSE_REMEDY = "Correct the pulse times, or cut the record to the part with sound pulses"
FEWEST_PULSES = 3
"""Pulses of two revolutions, for the speed to have a derivative."""
LONGEST_PULSE_GAP = 6
"""Revolutions in one interval; in a longer one the number of revolutions depends on an assumed speed."""
COUNT_TOLERANCE = 0.25
"""Revolutions by which an interval may differ from a whole number: half of what would make the number ambiguous."""
REPAIRED_SHARE = 0.2
"""Largest share of the pulses that may need repair; beyond it the neighbors used for a repair are suspect, too."""
MISTIMING_LIMIT = 0.02
"""Revolutions (7 degrees) of timing error; the inertia of a rotor permits no such change between revolutions."""
MISTIMING_SIGMAS = 10.0
"""Timing error over the median one, from which a pulse is mistimed where all pulses jitter."""
MEDIAN_INTERVALS = 9
"""Intervals of the running median of the revolution time: it is not affected by four bad ones."""


@dataclass(frozen=True)
class RepairedPulses:
    """Times (p,) [s] of the sound pulses, numbers (p,) of their revolutions from 0 on, and a note for each repair."""

    times: Array
    revolutions: Integers
    notes: tuple[str, ...]


def repair_pulses(recorded: Array) -> RepairedPulses:
    """Repair pulse times (n,) [s]. Raises UserError where they cannot be repaired."""
    _check_pulse_times(recorded)
    times, stray = _drop_stray_pulses(recorded)
    times, mistimed = _drop_mistimed_pulses(times)
    counts = _revolutions_between(times)
    missing = _missing_pulse_notes(times, counts, mistimed)
    repairs = len(stray) + len(mistimed) + len(missing)
    if repairs > max(1.0, REPAIRED_SHARE * len(recorded)):
        fault = f"{repairs} of {len(recorded)} pulses need repair, which is too many to be reliable"
        raise UserError(fault, "", PULSE_DATASET, PULSE_REMEDY)
    notes = [f"pulse at {t:.4f} s dropped: double or stray" for t in stray]
    notes += [f"pulse at {t:.4f} s dropped: mistimed against its neighbors" for t in mistimed]
    return RepairedPulses(times, np.concatenate([[0], np.cumsum(counts)]), (*notes, *missing))


def _check_pulse_times(times: Array) -> None:
    if times.ndim != 1 or len(times) < FEWEST_PULSES:
        raise UserError(
            f"only {times.size} pulses, at least {FEWEST_PULSES} are needed", "", PULSE_DATASET, PULSE_REMEDY
        )
    if not np.all(np.isfinite(times)):
        bad = int(np.flatnonzero(~np.isfinite(times))[0])
        raise UserError("a pulse time is not a finite number", "", f"{PULSE_DATASET}, entry {bad}", PULSE_REMEDY)
    decreasing = np.flatnonzero(np.diff(times) < 0)
    if decreasing.size:
        place = f"{PULSE_DATASET}, entry {int(decreasing[0]) + 1}"
        raise UserError("the pulse times decrease", "", place, PULSE_REMEDY)


def _running_median_interval(intervals: Array) -> Array:
    """Running median of the intervals: the revolution time [s] around each."""
    half = MEDIAN_INTERVALS // 2
    padded = np.pad(intervals, half, mode="reflect" if len(intervals) > half else "edge")
    return np.asarray(row_medians(np.lib.stride_tricks.sliding_window_view(padded, MEDIAN_INTERVALS)), float)


def _sum_of_squared_count_errors(intervals: Array, local: float) -> float:
    """Sum of the squared differences of intervals from whole revolutions."""
    turns = intervals / local
    return float(np.sum((turns - np.maximum(np.rint(turns), 1.0)) ** 2))


def _drop_stray_pulses(times: Array) -> tuple[Array, list[float]]:
    """Drop double and stray pulses one by one; return the times that remain, and those dropped."""
    dropped: list[float] = []
    while len(times) > FEWEST_PULSES:
        intervals = np.diff(times)
        local = _running_median_interval(intervals)
        short = int(np.argmin(intervals / local))
        if intervals[short] > (1.0 - COUNT_TOLERANCE) * local[short]:
            break
        near = slice(max(short - 2, 0), short + 4)
        choices = [np.delete(times, short), np.delete(times, short + 1)]
        uneven = [_sum_of_squared_count_errors(np.diff(choice[near]), local[short]) for choice in choices]
        best = int(np.argmin(uneven))
        dropped.append(float(times[short + best]))
        times = choices[best]
    return times, dropped


def _timing_errors(times: Array) -> Array:
    """Revolutions by which each inner pulse differs from the cubic through its four neighbors, two on either side."""
    errors = np.zeros(len(times))
    middle = times[2:-2]
    predicted = (-times[:-4] + 4.0 * times[1:-3] + 4.0 * times[3:-1] - times[4:]) / 6.0
    errors[2:-2] = (middle - predicted) / ((times[4:] - times[:-4]) / 4.0)
    return errors


def _drop_mistimed_pulses(times: Array) -> tuple[Array, list[float]]:
    """Drop pulses that are much too early or too late; return the times that remain, and those dropped.

    Pulses beside a gap are not tested.
    """
    dropped: list[float] = []
    counts = np.diff(times) / _running_median_interval(np.diff(times))
    sound = np.zeros(len(times), bool)
    if len(times) < MEDIAN_INTERVALS:
        return times, dropped
    single = np.abs(counts - 1.0) < COUNT_TOLERANCE
    sound[2:-2] = single[:-3] & single[1:-2] & single[2:-1] & single[3:]
    errors = np.where(sound, np.abs(_timing_errors(times)), 0.0)
    limit = max(MISTIMING_LIMIT, MISTIMING_SIGMAS * float(np.median(errors)))
    keep = np.ones(len(times), bool)
    for pulse in np.argsort(-errors):
        if errors[pulse] <= limit:
            break
        if np.all(keep[max(pulse - 2, 0) : pulse + 3]):  # a bad pulse affects the prediction of its neighbors
            keep[pulse] = False
            dropped.append(float(times[pulse]))
    return times[keep], dropped


def _revolutions_between(times: Array) -> Integers:
    """Whole revolutions in each interval. Raises UserError where the number is in doubt."""
    intervals = np.diff(times)
    turns = intervals / _running_median_interval(intervals)
    counts = np.maximum(np.rint(turns), 1.0)
    doubtful = np.flatnonzero((np.abs(turns - counts) > COUNT_TOLERANCE) | (counts > LONGEST_PULSE_GAP))
    if doubtful.size:
        k = int(doubtful[0])
        if _changes_speed(intervals, k):
            fault = f"the rotor changes its speed by more than {100 * COUNT_TOLERANCE:.0f} % at {times[k]:.4f} s"
            raise UserError(fault, "", PULSE_DATASET, "Cut the record to the part at nearly constant speed")
        interval = f"the interval from {times[k]:.4f} to {times[k + 1]:.4f} s is {turns[k]:.2f} times as long as others"
        raise UserError(f"{interval}: the pulses cannot be repaired", "", PULSE_DATASET, PULSE_REMEDY)
    return counts.astype(np.int64)


def _changes_speed(intervals: Array, k: int) -> bool:
    """Whether the revolutions about interval k become ever shorter or ever longer: a rotor that is run up or down."""
    near = intervals[max(k - MEDIAN_INTERVALS // 2, 0) : k + MEDIAN_INTERVALS // 2 + 1]
    steps = np.diff(near)
    return len(steps) > 2 and bool(np.all(steps < 0.0) or np.all(steps > 0.0))


def _missing_pulse_notes(times: Array, counts: Integers, mistimed: list[float]) -> list[str]:
    """Return a note for each gap that no dropped pulse explains."""
    notes = []
    for k in np.flatnonzero(counts > 1):
        missing = int(counts[k]) - 1 - sum(times[k] < t < times[k + 1] for t in mistimed)
        if missing > 0:
            notes.append(f"{missing} missing after {times[k]:.4f} s: counted")
    return notes
