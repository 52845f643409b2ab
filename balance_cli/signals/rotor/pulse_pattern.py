"""Periodic departures of the 1/rev pulses from a smooth rotation: errors of their timing, or changes of the speed.

Pulses that are late and early in turn are never the speed of a rotor: its inertia permits no such change. A slower
pattern may be either, and only the channels tell which.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.interpolating_spline import interpolating_spline
from balance_cli.signals.rotor.harmonic_noise import blackman_taper
from balance_cli.signals.rotor.spectral_floor import local_maxima, row_medians

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

DIFFERENCE_ORDER = 4
"""Order of the differences of pulse times in which slow changes of the speed vanish."""
FEWEST_PULSES = 24
"""With fewer there is no floor from which a line stands out."""
NEIGHBOR_BINS = (4, 12)
"""Distances of the bins that a line is compared with: behind the lobe of the taper, near enough for a sloping floor."""
LINE_TO_FLOOR = 50.0
"""Power of a line over the median around it: of a million bins of noise one reaches 20."""
FEWEST_PERIODS = 4.0
"""Periods of a pattern within a record: the lobe of the taper is three bins wide, and a drift fills those of rest."""
LEAST_PATTERN, LARGEST_PATTERN = 0.02, 20.0
"""Degrees: less changes no load by its sigma (a pattern of 0.3 degrees does beside a light mode, by its square), and no
pulse is wrong by more, while a speed that changes by 1 % in tens of revolutions leads and lags by 200."""
LEAST_ALTERNATION = 0.002
"""Degrees by which pulses must alternate: less turns no harmonic by a ten-thousandth of its amplitude."""
FEWEST_ALTERNATIONS = 8
ALTERNATION_SIGMAS = 10.0
"""Mean of the differences with alternating signs over its standard error, if they were independent: those of scatter
are alike by 1.8."""
FREQUENCY_STEPS = 4
"""Steps of Newton's method from the nearest bin: each is quadratic in the error before."""
PERIOD_DEGREE = 3
"""Degree of the polynomial for the revolution time: a pattern in degrees is one in seconds times this."""


@dataclass(frozen=True)
class PulsePattern:
    """Departure amplitude cos(2 pi frequency k) - j sin(...) of pulse k: `frequency` [per revolution].

    `amplitude` is complex [revolutions]; a pulse that comes late departs by a positive real part.
    """

    frequency: float
    amplitude: complex

    @property
    def degrees(self) -> float:
        """The amplitude in degrees of azimuth."""
        return 360.0 * abs(self.amplitude)

    @property
    def description(self) -> str:
        """The pattern in words."""
        if self.frequency == 0.5:
            return f"pulses are late and early in turn by {self.degrees:.2g} degrees"
        return f"pulses are early and late by {self.degrees:.2g} degrees every {1.0 / self.frequency:.3g} revolutions"

    def at(self, revolutions: NDArray[np.int64]) -> Array:
        """Return the departure (p,) [revolutions] of the pulses of these revolutions."""
        return np.asarray((self.amplitude * np.exp(2j * np.pi * self.frequency * revolutions)).real)


def without_pattern(times: Array, revolutions: NDArray[np.int64], pattern: PulsePattern) -> Array:
    """Return the pulse times (p,) [s] of these revolutions without a pattern; their mean stays."""
    return np.asarray(times - pattern.at(revolutions) * _revolution_time(times, revolutions))


def pulse_alternation(times: Array, revolutions: NDArray[np.int64]) -> PulsePattern | None:
    """Return the departure of pulses that are late and early in turn; None within their scatter."""
    sign = 1.0 - 2.0 * (revolutions % 2)
    usable = _consecutive(revolutions)
    change = (sign[:-DIFFERENCE_ORDER] * np.diff(times, DIFFERENCE_ORDER))[usable]
    if len(change) < FEWEST_ALTERNATIONS:
        return None
    rate = float(revolutions[-1] / (times[-1] - times[0]))
    least = LEAST_ALTERNATION / 360.0 / rate * 2.0**DIFFERENCE_ORDER
    if abs(change.mean()) <= max(ALTERNATION_SIGMAS * float(change.std()) / np.sqrt(len(change)), least):
        return None
    return PulsePattern(0.5, _fit(times, revolutions, 0.5)[0])


def pulse_pattern(
    times: Array, revolutions: NDArray[np.int64], known: Sequence[PulsePattern] = ()
) -> PulsePattern | None:
    """Return the largest periodic departure of pulses that may be an error of their timing, None without.

    `times` (p,) [s] are those of the pulses of these revolutions, the first of which is 0. Patterns that are `known`
    are left out.
    """
    if len(times) < FEWEST_PULSES:
        return None
    turns = int(revolutions[-1])
    rate = turns / float(times[-1] - times[0])
    frequency, power, gain = _line_powers(times, revolutions)
    is_line = (power > LINE_TO_FLOOR * _surrounding(power)) & local_maxima(power)
    is_line &= (frequency * turns >= FEWEST_PERIODS) & (frequency <= 0.5 - NEIGHBOR_BINS[0] / turns)
    for pattern in known:
        is_line &= np.abs(frequency - pattern.frequency) * turns > NEIGHBOR_BINS[0]
    degrees = 360.0 * rate * np.sqrt(power) / gain
    is_line &= (degrees > LEAST_PATTERN) & (degrees < LARGEST_PATTERN)
    if not is_line.any():
        return None
    strongest = float(frequency[np.argmax(np.where(is_line, degrees, 0.0))])
    for _ in range(FREQUENCY_STEPS):
        amplitude, slope = _fit(times, revolutions, strongest)
        strongest += float((slope / amplitude).imag) / (2.0 * np.pi)
    return PulsePattern(strongest, _fit(times, revolutions, strongest)[0])


def _line_powers(times: Array, revolutions: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Return frequencies (k,) per revolution, squared amplitudes [s2] of the differences there, and their gain (k,).

    The gain is that over the pulse times, of which missing ones are interpolated.
    """
    every = np.arange(int(revolutions[-1]) + 1)
    filled = times if len(times) == len(every) else interpolating_spline(revolutions, times, degree=3)(every)
    differences = np.diff(filled, DIFFERENCE_ORDER)
    differences = differences[len(differences) % 2 :]
    count = len(differences)
    taper = blackman_taper((np.arange(count) + 0.5) / count)
    lines = np.fft.rfft(taper * differences) * (2.0 / taper.sum())
    lines[-1] *= 0.5
    frequency = np.arange(len(lines)) / count
    gain = (2.0 * np.sin(np.pi * np.maximum(frequency, 0.5 / count))) ** DIFFERENCE_ORDER
    return frequency, np.abs(lines) ** 2, gain


def _surrounding(power: Array) -> Array:
    """Return the floor around each line: the larger one of the medians of the bins below and above it.

    Near rest, where a line reaches the bins below it, that above.
    """
    nearest, farthest = NEIGHBOR_BINS
    padded = np.pad(power, farthest, mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, farthest - nearest + 1)
    medians = row_medians(windows)
    below, above = medians[: len(power)], medians[farthest + nearest :][: len(power)]
    near_rest = np.arange(len(power)) < farthest + nearest
    return np.asarray(np.where(near_rest, above, np.maximum(below, above)))


def _revolution_time(times: Array, revolutions: NDArray[np.int64]) -> Array:
    """Return the duration (p,) [s] of a revolution at each pulse, as a smooth function."""
    position = 2.0 * revolutions / revolutions[-1] - 1.0
    curve = np.polynomial.Polynomial.fit(position, times, PERIOD_DEGREE + 1, domain=[-1.0, 1.0])
    return np.asarray(curve.deriv()(position) * 2.0 / revolutions[-1])


def _consecutive(revolutions: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which differences of pulses are over consecutive revolutions."""
    single = np.diff(revolutions) == 1
    if len(single) < DIFFERENCE_ORDER:
        return np.zeros(0, bool)
    return np.asarray(np.lib.stride_tricks.sliding_window_view(single, DIFFERENCE_ORDER).all(axis=1))


def _fit(times: Array, revolutions: NDArray[np.int64], frequency: float) -> tuple[complex, complex]:
    """Return amplitude [revolutions] and slope [revolutions per revolution] of a wave in the times of pulses.

    It is the real part of (amplitude + slope (k - mean of k)) exp(2 pi j frequency k), by least squares of
    differences, under a taper, as scatter is large in their high frequencies.
    """
    wave = np.exp(2j * np.pi * frequency * revolutions) * _revolution_time(times, revolutions)
    middle = float(revolutions.mean())
    columns = [wave.real] if frequency == 0.5 else [wave.real, -wave.imag]
    if frequency != 0.5:
        columns += [(revolutions - middle) * column for column in columns]
    usable = _consecutive(revolutions)
    design = np.diff(np.stack(columns, axis=1), DIFFERENCE_ORDER, axis=0)
    taper = blackman_taper((np.arange(len(design)) + 0.5) / len(design))[usable]
    change = taper * np.diff(times, DIFFERENCE_ORDER)[usable]
    solution = np.linalg.lstsq(taper[:, None] * design[usable], change, rcond=None)[0]
    if frequency == 0.5:
        return complex(solution[0]), 0j
    return complex(solution[0], solution[1]), complex(solution[2], solution[3])
