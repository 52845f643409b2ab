"""Rotor azimuth from the 1/rev pulses: repair of the pulses, azimuth and speed at any time between them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from balance_cli.io.errors import UserError
from balance_cli.signals.interpolating_spline import PiecewisePolynomial, interpolating_spline
from balance_cli.signals.rotor.pulse_repair import PULSE_DATASET, PULSE_REMEDY, repair_pulses

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

LARGEST_SCATTER = 0.1
"""Degrees by which a pulse may scatter and still be taken as it is; beyond, the pulses are smoothed and a note is made.
At 8/rev it takes 1e-4 of an amplitude. Scatter also passes for a change of speed, over whose range the response is
averaged: beside light modes a scatter of half a degree contradicted the redundant channels.
"""
LONGEST_SMOOTHING = 60.0
"""Revolutions over which a smoother of pulses averages at most: so many have an error in common."""
FEWEST_SMOOTHED = 1.5
"""Revolutions over which pulses must be averaged for smoothing to be worthwhile."""
CONVERGED_STEP = 1e-9
"""Revolutions of a step of Newton's method after which the error is that of rounding."""
MOST_KEPT = 2**20
"""Samples whose azimuth and speed are kept, 16 MB; those of longer records are computed where they are asked for."""


@dataclass(frozen=True)
class Azimuth:
    """Azimuth of the rotor between the first and the last sound pulse of a record.

    `pulse_times` (p,) [s] are the sound pulses and `revolutions` (p,) their numbers, 0 at the first; a number is
    skipped where a pulse is missing. `notes` lists the repairs. `pulse_scatter` is the standard deviation of the
    timing of a single pulse, `local_error` that of the azimuth near one, both [rad]; they differ where the pulses were
    smoothed. `common_error` [rad] is that of all pulses alike: where times are whole steps, the edge may lie at either
    end of a step; where pulses alternate, either half may be the right one.

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
    common_error: float = 0.0
    _kept: dict[float, tuple[Array, Array]] = field(default_factory=dict, init=False, repr=False, compare=False)

    @cached_property
    def revolution_count(self) -> PiecewisePolynomial:
        """Revolutions since the first pulse, a spline over time [s]."""
        return interpolating_spline(self.pulse_times, self.revolutions.astype(float), degree=5)

    @cached_property
    def speed_curve(self) -> PiecewisePolynomial:
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
        count, speed = self.revolution_count.with_slope(inside)
        return 2.0 * np.pi * count, speed

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
            count, speed = self.revolution_count.with_slope(time)
            step = (count - target) / speed
            time = np.clip(time - step, self.first, self.last)
            # The next step is quadratic in this one, and in the share of a revolution by which the speed changes.
            if np.max(np.abs(step), initial=0.0) * self.mean_rate < CONVERGED_STEP:
                break
        return np.asarray(time, float)

    def _evaluate_within_pulses(self, time: ArrayLike, curve: PiecewisePolynomial) -> Array:
        t = np.asarray(time, float)
        return np.where((t >= self.first) & (t <= self.last), curve(np.clip(t, self.first, self.last)), np.nan)


def azimuth_from_pulses(pulse_times: ArrayLike, smooth: bool = True) -> Azimuth:
    """Compute the azimuth from the times (n,) [s] of the 1/rev pulses.

    Double, stray and mistimed pulses are dropped; missing pulses are counted; pulses that scatter by more than a rotor
    can are smoothed, unless `smooth` is false. Each repair is a line of `notes`. Raises UserError where the pulses
    cannot be repaired.
    """
    repaired = repair_pulses(np.asarray(pulse_times, float))
    azimuth = Azimuth(repaired.times, repaired.revolutions, repaired.notes)
    if smooth:
        azimuth = _without_alternation(azimuth)
    azimuth = _with_scatter(azimuth, smooth)
    _check_forward_rotation(azimuth)
    return azimuth


def with_stated_error(azimuth: Azimuth, error: float) -> Azimuth:
    """Return the azimuth with the error [rad] that an import stated of it, one standard deviation near a pulse.

    The pulses were smoothed and no longer show their scatter. Over how many revolutions is not known; the longest are
    assumed, over which the error of the mean azimuth is largest.
    """
    scatter = error * math.sqrt(min(LONGEST_SMOOTHING, azimuth.turns))
    return replace(
        azimuth,
        pulse_scatter=max(azimuth.pulse_scatter, scatter),
        local_error=max(azimuth.local_error, error),
    )


def _without_alternation(azimuth: Azimuth) -> Azimuth:
    """Return the azimuth by the mean of pulses that are late and early in turn, as the speed of no rotor is."""
    from balance_cli.signals.rotor.pulse_pattern import pulse_alternation, without_pattern

    pattern = pulse_alternation(azimuth.pulse_times, azimuth.revolutions)
    if pattern is None:
        return azimuth
    note = (
        f"{pattern.description} (two marks, or a trigger that alternates): averaged, either half may be the right one"
    )
    times = without_pattern(azimuth.pulse_times, azimuth.revolutions, pattern)
    error = 2.0 * math.pi * abs(pattern.amplitude)
    return replace(azimuth, pulse_times=times, notes=(*azimuth.notes, note), common_error=error)


def _with_scatter(azimuth: Azimuth, smooth: bool) -> Azimuth:
    """Return the azimuth with the errors of its pulses, smoothed where they scatter or have a coarse step."""
    from balance_cli.signals.rotor.pulse_resolution import timing_step
    from balance_cli.signals.rotor.pulse_smoothing import pulse_scatter, smooth_pulses

    times, per_second = azimuth.pulse_times, 2.0 * np.pi * azimuth.mean_rate
    step = timing_step(times)
    within_step = per_second * step / math.sqrt(12.0)  # an error of at most half a step, all alike
    common = math.hypot(within_step, azimuth.common_error)
    scatter = max(per_second * pulse_scatter(times, azimuth.revolutions), within_step)
    scattered = replace(azimuth, pulse_scatter=scatter, local_error=scatter, common_error=common)
    note = _scatter_note(math.degrees(scatter), step, math.degrees(per_second * step))
    if not note:
        return scattered
    smoothed = smooth_pulses(times, azimuth.revolutions, step)
    if not smooth or smoothed.window < FEWEST_SMOOTHED:
        return replace(scattered, notes=(*azimuth.notes, note))
    return Azimuth(
        smoothed.times,
        np.arange(len(smoothed.times)),
        (*azimuth.notes, f"{note}; smoothed over {smoothed.window:.0f} revolutions"),
        per_second * smoothed.scatter,
        per_second * smoothed.sigma,
        common,
    )


def _scatter_note(scatter_deg: float, step: float, step_deg: float) -> str:
    """Say by how much pulses scatter, and in what step [s] they were timed; empty where that does not matter."""
    if scatter_deg <= LARGEST_SCATTER:
        return ""
    if scatter_deg > step_deg:
        return f"pulses scatter by {scatter_deg:.1f} degrees of azimuth"
    half = f"the azimuth may be off by half of it, {0.5 * step_deg:.2g} degrees"
    return f"pulses were timed in steps of {1e3 * step:.3g} ms: {half}"


def _check_forward_rotation(azimuth: Azimuth) -> None:
    """Raise UserError where the curve through the pulses would turn the rotor backward."""
    grid = azimuth.pulse_times[:-1, None] + np.diff(azimuth.pulse_times)[:, None] * np.linspace(0.0, 1.0, 5)
    speed = azimuth.speed_curve(grid)
    if np.any(speed <= 0.0):
        at = float(grid.ravel()[int(np.argmin(speed))])
        raise UserError(f"the pulses near {at:.4f} s would turn the rotor backward", "", PULSE_DATASET, PULSE_REMEDY)
