"""Rotor azimuth from the 1/rev pulses: repair of the pulses, azimuth and speed at any time between them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from balance_cli.io.errors import UserError
from balance_cli.signals.rotor.spectral_floor import row_medians

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

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
LARGEST_SCATTER = 1.0
"""Degrees by which a pulse may scatter and still be taken as it is; beyond, the pulses are smoothed and a note is
made. At 8/rev the phase scatters by eight times as much, which takes 1 % of the amplitude."""
FEWEST_SMOOTHED = 1.5
"""Revolutions over which pulses must be averaged for smoothing to be worthwhile."""
CONVERGED_STEP = 1e-9
"""Revolutions of a step of Newton's method after which the error is that of rounding."""
MOST_KEPT = 2**20
"""Samples whose azimuth and speed are kept, 16 MB; those of longer records are computed where they are asked for."""
MEDIAN_INTERVALS = 9
"""Intervals of the running median of the revolution time: it is not affected by four bad ones."""


@dataclass(frozen=True)
class Azimuth:
    """Azimuth of the rotor between the first and the last sound pulse of a record.

    `pulse_times` (p,) [s] are the sound pulses and `revolutions` (p,) their numbers, 0 at the first; a number is
    skipped where a pulse is missing. `notes` lists the repairs. `pulse_scatter` is the standard deviation of the
    timing of a single pulse, `local_error` that of the azimuth near one, both [rad]; they differ where the pulses were
    smoothed.

    Between pulses the revolution count is a spline of degree 5 over time through the pulses. Because of the inertia of
    the rotor the count is smooth, and the error of the spline, of order (T_rev / T_drift)^6, is far below that of a
    cubic spline: in records whose speed changes by 6 % in 30 s, pulses that were left out were interpolated within
    1e-10 revolutions (cubic: 5e-9).
    """

    pulse_times: Array = field(repr=False)
    revolutions: Integers = field(repr=False)
    notes: tuple[str, ...] = ()
    pulse_scatter: float = 0.0
    local_error: float = 0.0
    _kept: dict[float, tuple[Array, Array]] = field(default_factory=dict, init=False, repr=False, compare=False)

    @cached_property
    def revolution_count(self) -> PPoly:
        """Revolutions since the first pulse, a spline over time [s]; a B-spline would take eight times as long."""
        from scipy.interpolate import PPoly, make_interp_spline

        degree = min(5, len(self.pulse_times) - 1)
        return PPoly.from_spline(make_interp_spline(self.pulse_times, self.revolutions.astype(float), k=degree).tck)

    @cached_property
    def speed_curve(self) -> PPoly:
        """Rotor speed [Hz], a spline over time [s]."""
        return self.revolution_count.derivative()

    @property
    def first(self) -> float:
        """Time of the first pulse [s]."""
        return float(self.pulse_times[0])

    @property
    def last(self) -> float:
        """Time of the last pulse [s]."""
        return float(self.pulse_times[-1])

    @property
    def turns(self) -> int:
        """Whole revolutions from the first pulse to the last."""
        return int(self.revolutions[-1])

    @property
    def mean_rate(self) -> float:
        """Mean pulse rate [Hz]: the number of revolutions over their duration."""
        return self.turns / (self.last - self.first)

    def psi(self, time: ArrayLike) -> Array:
        """Return the azimuth [rad] at `time` [s]: a multiple of 2 pi at each pulse, 0 at the first, NaN outside."""
        return 2.0 * np.pi * self._evaluate_within_pulses(time, self.revolution_count)

    def speed(self, time: ArrayLike) -> Array:
        """Return the rotor speed [Hz] at `time` [s], NaN outside the pulses."""
        return self._evaluate_within_pulses(time, self.speed_curve)

    def of_samples(self, rate: float, start: int, stop: int) -> tuple[Array, Array]:
        """Return azimuth [rad] and speed [Hz] of samples, at most MOST_KEPT kept; beyond the pulses as at the next."""
        count = max(stop, int(self.last * rate) + 2)
        if count > MOST_KEPT:
            return self._evaluate_samples(np.arange(start, stop), rate)
        if rate not in self._kept or len(self._kept[rate][0]) < count:
            self._kept[rate] = self._evaluate_samples(np.arange(count), rate)
        psi, speed = self._kept[rate]
        return psi[start:stop], speed[start:stop]

    def _evaluate_samples(self, index: Integers, rate: float) -> tuple[Array, Array]:
        inside = np.clip(index / rate, self.first, self.last)
        return 2.0 * np.pi * self.revolution_count(inside), self.speed_curve(inside)

    def extrapolated_count(self, time: ArrayLike) -> Array:
        """Return the revolutions since the first pulse at any `time` [s]; the speed is constant outside the pulses."""
        t = np.asarray(time, float)
        inside = np.clip(t, self.first, self.last)
        first, last = self.speed_curve(np.array([self.first, self.last]))
        return np.asarray(self.revolution_count(inside) + np.where(t < self.first, first, last) * (t - inside))

    def time_of(self, revolution: ArrayLike) -> Array:
        """Return the time [s] at which the revolution count reaches `revolution`, between 0 and `turns`."""
        target = np.asarray(revolution, float)
        time = np.interp(target, self.revolutions, self.pulse_times)
        for _ in range(4):
            step = (self.revolution_count(time) - target) / self.speed_curve(time)
            time = np.clip(time - step, self.first, self.last)
            # The next step is quadratic in this one, and in the share of a revolution by which the speed changes.
            if np.max(np.abs(step), initial=0.0) * self.mean_rate < CONVERGED_STEP:
                break
        return np.asarray(time, float)

    def _evaluate_within_pulses(self, time: ArrayLike, curve: PPoly) -> Array:
        t = np.asarray(time, float)
        return np.where((t >= self.first) & (t <= self.last), curve(np.clip(t, self.first, self.last)), np.nan)


def azimuth_from_pulses(pulse_times: ArrayLike, smooth: bool = True) -> Azimuth:
    """Compute the azimuth from the times (n,) [s] of the 1/rev pulses.

    Double, stray and mistimed pulses are dropped; missing pulses are counted; pulses that scatter by more than a rotor
    can are smoothed, unless `smooth` is false. Each repair is a line of `notes`. Raises UserError where the pulses
    cannot be repaired.
    """
    recorded = np.asarray(pulse_times, float)
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
    azimuth = Azimuth(times, np.concatenate([[0], np.cumsum(counts)]), (*notes, *missing))
    azimuth = _with_scatter(azimuth, smooth)
    _check_forward_rotation(azimuth)
    return azimuth


def _with_scatter(azimuth: Azimuth, smooth: bool) -> Azimuth:
    """Return the azimuth with the scatter of its pulses, smoothed where that is large."""
    from balance_cli.signals.rotor.pulse_smoothing import pulse_scatter, smooth_pulses

    per_second = 2.0 * np.pi * azimuth.mean_rate
    scatter = per_second * pulse_scatter(azimuth.pulse_times, azimuth.revolutions)
    degrees = float(np.degrees(scatter))
    if degrees <= LARGEST_SCATTER:
        return replace(azimuth, pulse_scatter=scatter, local_error=scatter)
    note = f"pulses scatter by {degrees:.1f} degrees of azimuth"
    smoothed = smooth_pulses(azimuth.pulse_times, azimuth.revolutions)
    if not smooth or smoothed.window < FEWEST_SMOOTHED:
        return replace(azimuth, notes=(*azimuth.notes, note), pulse_scatter=scatter, local_error=scatter)
    notes = (*azimuth.notes, f"{note}: smoothed over {smoothed.window:.0f} revolutions")
    numbers = np.arange(len(smoothed.times))
    return Azimuth(smoothed.times, numbers, notes, per_second * smoothed.scatter, per_second * smoothed.sigma)


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
        interval = f"the interval from {times[k]:.4f} to {times[k + 1]:.4f} s is {turns[k]:.2f} times as long as others"
        raise UserError(f"{interval}: the pulses cannot be repaired", "", PULSE_DATASET, PULSE_REMEDY)
    return counts.astype(np.int64)


def _missing_pulse_notes(times: Array, counts: Integers, mistimed: list[float]) -> list[str]:
    """Return a note for each gap that no dropped pulse explains."""
    notes = []
    for k in np.flatnonzero(counts > 1):
        missing = int(counts[k]) - 1 - sum(times[k] < t < times[k + 1] for t in mistimed)
        if missing > 0:
            notes.append(f"{missing} missing after {times[k]:.4f} s: counted")
    return notes


def _check_forward_rotation(azimuth: Azimuth) -> None:
    """Raise UserError where the curve through the pulses would turn the rotor backward."""
    grid = azimuth.pulse_times[:-1, None] + np.diff(azimuth.pulse_times)[:, None] * np.linspace(0.0, 1.0, 5)
    speed = azimuth.speed_curve(grid)
    if np.any(speed <= 0.0):
        at = float(grid.ravel()[int(np.argmin(speed))])
        raise UserError(f"the pulses near {at:.4f} s would turn the rotor backward", "", PULSE_DATASET, PULSE_REMEDY)
