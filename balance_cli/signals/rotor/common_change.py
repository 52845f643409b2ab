"""Whether all harmonics of a record change at one moment by one factor and one turn of the azimuth.

Gusts and a change of the operating point change each harmonic by itself, in size and phase. One real factor for all of
them is a gain or a supply that was switched, or a rotor speed that the loads follow. A turn of harmonic n by n times an
angle is an azimuth that has slipped, or samples that were lost: from there on the pulses belong to other samples. Both
are seen long before any single harmonic changes by more than gusts may do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LEAST_CHANGE = 0.05
"""Change of an amplitude, relative to its size, that matters: as for a mean load."""
FEWEST_WINDOWS = 4
"""Windows before and after the moment, whose scatter says how well the change is known."""
FEWEST_AMPLITUDES = 6
"""Amplitudes that must tell the change: two loads with three harmonics each. Gusts do not move so many alike."""
KNOWN_SHARE = 0.1
"""Standard deviation of the change of an amplitude, over its size or the change of all, up to which it counts."""
ALIKE_SHARE, ALIKE_DEPARTURE = 0.9, 0.25
"""Share of these amplitudes that must have the change of all, and by how much of its size they may miss it: a load that
itself changes a little meanwhile does not hide it."""
LEAST_INFORMATION = 25.0
"""Power of an amplitude over the square of its error from which it tells a factor: what noise has once in 10^5."""
POOLED_DEPARTURE = 2.0
"""Mean square of what amplitudes depart from one factor, over that of noise, up to which they share it. From four
windows the variance of noise has six degrees of freedom, so that the mean is up to 1.5 without any departure."""
TURNS = np.arange(360) * (2.0 * np.pi / 360.0)
"""Turns of the azimuth that are tried first [rad]: between two the twentieth harmonic turns by 20 deg."""


@dataclass(frozen=True)
class CommonChange:
    """Change of all harmonics from window `window` on: `factor`, and `turn` of the azimuth [rad] from -pi to pi.

    `size` is the median change of an amplitude, relative to its size; `misfit` what it misses of the changes, over it.
    """

    factor: float
    turn: float
    window: int
    size: float
    misfit: float


def common_change(values: ComplexArray) -> CommonChange | None:
    """Return the change that all amplitudes (w, n, m) of harmonics 1 to n in w windows have in common, None without.

    Of all moments at which they change alike it is that of the largest change that they share best.
    """
    order = np.repeat(np.arange(1, values.shape[1] + 1), values.shape[2])
    return _changes_of_groups(values.reshape(len(values), -1, 1), order)[0]


def changes_of_columns(values: ComplexArray) -> list[CommonChange | None]:
    """Return the same of each column of amplitudes (w, n, m) alone, all at once."""
    return _changes_of_groups(values, np.arange(1, values.shape[1] + 1))


def _changes_of_groups(values: ComplexArray, order: NDArray[np.intp]) -> list[CommonChange | None]:
    """Return the change that the amplitudes (w, r, g) of each group have in common, of harmonics `order` (r,)."""
    splits = np.arange(FEWEST_WINDOWS, len(values) - FEWEST_WINDOWS + 1)
    if not len(splits):
        return [None] * values.shape[2]
    before, after, error = _split_means(values, splits)
    is_clear = error < KNOWN_SHARE * np.abs(before)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio, relative_error = after / before, error / np.abs(before)
    clear = np.count_nonzero(is_clear, axis=1)
    changed = np.count_nonzero(is_clear & (np.abs(ratio - 1.0) > LEAST_CHANGE), axis=1)
    candidates: list[list[CommonChange]] = [[] for _ in range(values.shape[2])]
    for i, g in np.argwhere((clear >= FEWEST_AMPLITUDES) & (2 * changed > clear)).tolist():  # none in most records
        rows = is_clear[i, :, g]
        change = _change_at(ratio[i, rows, g], relative_error[i, rows, g], order[rows], int(splits[i]))
        candidates[g] += [] if change is None else [change]
    for g, change in _pooled_factors(before, after, error, splits):
        candidates[g].append(change)

    def shared_change(change: CommonChange) -> float:
        return change.size * (1.0 - change.misfit / ALIKE_DEPARTURE) * float(np.sqrt(_balance(change.window, values)))

    return [max(of_group, key=shared_change, default=None) for of_group in candidates]


def _balance(window: int, values: ComplexArray) -> int:
    """Return the product of the numbers of windows before and after one: a change among few is worse known."""
    return window * (len(values) - window)


def _split_means(values: ComplexArray, splits: NDArray[np.intp]) -> tuple[ComplexArray, ComplexArray, Array]:
    """Return the means (s, r, g) of amplitudes (w, r, g) before and after each split, and the error of their change.

    The error is the standard error of a real component.
    """
    values = values - (middle := values.mean(axis=0))
    total, squares = np.cumsum(values, axis=0), np.cumsum(np.abs(values) ** 2, axis=0)
    counts = [splits[:, None, None], len(values) - splits[:, None, None]]
    sums = [total[splits - 1], total[-1] - total[splits - 1]]
    powers = [squares[splits - 1], squares[-1] - squares[splits - 1]]
    means = [sum_ / count for sum_, count in zip(sums, counts, strict=True)]
    variance = sum(
        np.maximum(power / count - np.abs(mean) ** 2, 0.0) / (2.0 * (count - 1))
        for power, mean, count in zip(powers, means, counts, strict=True)
    )
    return means[0] + middle, means[1] + middle, np.sqrt(variance)


def _change_at(ratio: ComplexArray, relative_error: Array, order: NDArray[np.intp], k: int) -> CommonChange | None:
    """Return the change at window k of clear amplitudes (r,), which change by these ratios; None without."""
    is_known = relative_error < KNOWN_SHARE * np.median(np.abs(_expected(ratio, order)[2] - 1.0))
    if np.count_nonzero(is_known) < FEWEST_AMPLITUDES:
        return None
    ratio, order = ratio[is_known], order[is_known]
    factor, turn, expected = _expected(ratio, order)
    size = float(np.median(np.abs(expected - 1.0)))
    missed = np.abs(ratio - expected) / np.maximum(np.abs(expected - 1.0), size)
    if size < LEAST_CHANGE or np.mean(missed < ALIKE_DEPARTURE) < ALIKE_SHARE:
        return None
    return CommonChange(factor, float(np.angle(np.exp(1j * turn))), k, size, float(np.median(missed)))


def _pooled_factors(
    before: ComplexArray, after: ComplexArray, error: Array, splits: NDArray[np.intp]
) -> list[tuple[int, CommonChange]]:
    """Return the groups whose amplitudes (s, r, g) share a factor, and that after the split that shows it best.

    Gusts hide a tenth in each amplitude, but not in their weighted mean.
    """
    weight = np.where(error > 0.0, 1.0 / np.maximum(error, np.finfo(float).tiny), 0.0)
    weight = np.where(np.abs(before * weight) ** 2 > LEAST_INFORMATION, weight, 0.0)
    b, a = before * weight, after * weight
    information = np.abs(b) ** 2
    total = np.maximum(information.sum(axis=1), np.finfo(float).tiny)
    factor = np.sum((b.conj() * a).real, axis=1) / total
    count = np.maximum(np.count_nonzero(weight, axis=1), 1)
    departure = np.sum(np.abs(a - factor[:, None] * b) ** 2, axis=1) / (2.0 * count)
    shared_by = total**2 / np.maximum(np.sum(information**2, axis=1), np.finfo(float).tiny)
    size, sigma = np.abs(factor - 1.0), total**-0.5
    is_common = (size > LEAST_CHANGE) & (sigma < KNOWN_SHARE * size)
    is_common &= (shared_by >= FEWEST_AMPLITUDES) & (departure < POOLED_DEPARTURE)
    best = np.argmax(np.where(is_common, size / sigma, 0.0), axis=0)
    return [
        (g, CommonChange(float(factor[i, g]), 0.0, int(splits[i]), float(size[i, g]), float(sigma[i, g] / size[i, g])))
        for g, i in enumerate(best.tolist())
        if is_common[i, g]
    ]


def _expected(ratio: ComplexArray, order: NDArray[np.intp]) -> tuple[float, float, ComplexArray]:
    """Return the factor and the turn [rad] that describe the ratios (r,) of amplitudes best, and their ratios."""
    direction = ratio / np.maximum(np.abs(ratio), np.finfo(float).tiny)
    turn = TURNS[int(np.argmax((np.exp(-1j * np.outer(TURNS, order)) @ direction).real))]
    left = np.angle(direction * np.exp(-1j * order * turn))
    turn += float(left @ order) / float(order @ order)
    factor = float(np.median((ratio * np.exp(-1j * order * turn)).real))
    return factor, turn, factor * np.exp(1j * order * turn)
