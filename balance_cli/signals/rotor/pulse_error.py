"""Whether a periodic departure of the 1/rev pulses is an error of their timing or a change of the speed.

Where the speed changes, channels follow the azimuth of the pulses, and harmonic k has no lines beside it once the
change of the response is taken out. Where the pulses are wrong, it has them at the frequency of the pattern, k times as
large; without the pattern it has none. Between the two the lines are linear in the share of the pattern that is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.signals.rotor.harmonic_noise import blackman_taper
from balance_cli.signals.rotor.harmonics import BLOCK_SAMPLES, Harmonics, read_signals, sample_span
from balance_cli.signals.rotor.line_sums import LineSums
from balance_cli.signals.rotor.pulse_pattern import PulsePattern
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FLOOR_OFFSETS = np.arange(4, 12)
"""Lines away from the harmonic that tell the noise at one beside it: behind the lobe of the taper."""
FLOOR_SHARE = 1.0 / 3.0
"""Share of these lines that are taken for noise: others may hold twice the frequency of the pattern."""
CLEAR_RATIO = 25.0
"""Power of what a pattern makes of a line, over the noise, from which the line counts."""
FEWEST_LINES = 6
"""Lines that must tell: as for a change that all harmonics have in common."""
WHOLE_SHARE = 0.15
"""Share of the pattern by which it may depart from none or all: what a response with usual errors makes of a speed."""
EXPLAINED_SHARE = 0.3
"""Part of a line that may be left where its pattern is explained; loads that follow the speed leave some."""
SHARE_SIGMAS = 5.0
"""Standard deviations of the share by which it must depart: the floor comes from few lines, so that four are exceeded
in 30 of 1000 simulated records with a random load that hides most lines, five in 9."""
LEAST_DOUBT = 0.15
"""Degrees of a pattern that must be in doubt: 0.3 change a load beside a light mode by its sigma, 0.15 by a quarter."""


@dataclass(frozen=True)
class PulseVerdict:
    """The `share` of a pattern that is an error of the pulses: 0 a change of the speed, 1 an error, else something of
    both; complex, as the two have phases of their own. `contradicted`: neither explains the lines.
    """

    share: complex
    contradicted: bool


@dataclass(frozen=True)
class OrderedRecord:
    """A run over an azimuth, without what its harmonics change with the speed."""

    run: Run
    azimuth: Azimuth
    spectra: Harmonics


def judge_pattern(
    with_pattern: OrderedRecord, without: OrderedRecord, pattern: PulsePattern, names: tuple[str, ...]
) -> PulseVerdict | None:
    """Return the verdict on a pattern of the pulses; None where the channels do not tell.

    The two records are those of the pulses as they are, and without the pattern. What is in doubt of a small pattern
    changes no load, and does not count.
    """
    n = len(with_pattern.spectra.frequency_hz) - 1
    pairs = [item.spectra.revolutions for item in (with_pattern, without)]
    revolutions = max(first for first, _ in pairs), min(last for _, last in pairs)
    beside = _lines_beside(n, pattern.frequency, revolutions[1] - revolutions[0])
    if not len(beside):
        return None
    (given, floor), (removed, other_floor) = (
        _lines(item, names, revolutions, beside) for item in (with_pattern, without)
    )
    change = removed - given
    is_clear = np.abs(change) ** 2 > CLEAR_RATIO * np.minimum(floor, other_floor)
    if np.count_nonzero(is_clear) < FEWEST_LINES:
        return None
    each = -given[is_clear] / change[is_clear]
    clarity = np.where(is_clear, np.abs(change) / np.sqrt(np.minimum(floor, other_floor)), 0.0)
    weight = clarity[is_clear]
    share = complex(_weighted_median(each.real, weight), _weighted_median(each.imag, weight))
    uncertain = SHARE_SIGMAS * _sigma_of_share(clarity)
    if uncertain > 0.5:  # both none and all may be meant
        return None
    negligible = max(LEAST_DOUBT / pattern.degrees, uncertain)
    share = next((float(whole) for whole in (0, 1) if abs(share - whole) < max(WHOLE_SHARE, negligible)), share)
    left = _weighted_median(np.abs(each - share), weight)
    return PulseVerdict(share, left > max(EXPLAINED_SHARE, negligible))


def _sigma_of_share(clarity: Array) -> float:
    """Return the standard deviation of a real part of the share by lines (n, 2, c) so many times as large as noise.

    The channels of a line have the noise of one: random loads and free vibration are in all of them. The last factor is
    that of a median over a mean.
    """
    return float(np.sqrt(0.5 / np.sum(clarity.max(axis=2) ** 2)) * np.sqrt(0.5 * np.pi))


def _lines_beside(n: int, frequency: float, turns: int) -> NDArray[np.int64]:
    """Return the lines (n, 2), in units of one over the interval, below and above each harmonic from 1 on."""
    beside = round(frequency * turns)
    return np.asarray(turns * np.arange(1, n + 1)[:, None] + np.array([-beside, beside]))


def _lines(
    record: OrderedRecord, names: tuple[str, ...], revolutions: tuple[int, int], beside: NDArray[np.int64]
) -> tuple[ComplexArray, Array]:
    """Return the lines (n, 2, c) below and above the harmonics, and the floor (n, 1, c) of their power.

    Those below are conjugated: a wave of the azimuth makes both with its amplitude, not the conjugate.
    """
    index = beside[..., None] + np.outer([-1, 1], np.append(0, FLOOR_OFFSETS))
    sums = LineSums(int(np.abs(index).max()), len(names))
    first, last = revolutions
    run, azimuth = record.run, record.azimuth
    start, stop = sample_span(run, *azimuth.time_of(np.array(revolutions)))
    for low in range(start, stop, BLOCK_SAMPLES):
        high = min(low + BLOCK_SAMPLES, stop)
        psi, speed = azimuth.of_samples(sample_rate(run), low, high)
        turned = (psi / (2.0 * np.pi) - first) / (last - first)
        taper = blackman_taper(np.clip(turned, 0.0, 1.0)) * speed
        sums.add(turned, read_signals(run, names, low, high) * taper[:, None])
    lines = sums.at(index.ravel()).reshape(*index.shape, len(names))
    floor = np.quantile(np.abs(lines[:, :, 1:]) ** 2, FLOOR_SHARE, axis=(1, 2)) / -np.log(1.0 - FLOOR_SHARE)
    of_pattern = lines[:, :, 0]
    # A departure e(k) = Re a exp(j w k) of the azimuth turns harmonic n, X exp(j n psi), by 1 + j n e: the line above
    # is j n X a / 2, the one below j n X conj(a) / 2.
    return np.stack([of_pattern[:, 0].conj(), of_pattern[:, 1]], axis=1), np.asarray(floor[:, None])


def _weighted_median(values: Array, weight: Array) -> float:
    """Return the value at which half of the weight lies below."""
    order = np.argsort(values)
    passed = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(passed, 0.5 * passed[-1])])
