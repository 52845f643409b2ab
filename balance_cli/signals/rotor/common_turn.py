"""Whether the azimuth of a record slips within it, or does not belong to it: all harmonics of all channels turn alike.

Harmonic n turns by n times an angle where samples were lost or pulses slipped, from a moment on, and steadily where the
sample rate is wrong or the pulses are those of another record. Loads do not turn so, and neither do the responses of a
rig whose speed changes. `common_change` finds slips of the loads from a few windows before and after them; here all
amplitudes together tell the angle in each window.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals import distributions as stats
from balance_cli.signals.rotor.steadiness import (
    FALSE_ALARM,
    FEWEST_BESIDE_STEP,
    critical_sum,
    largest_change,
    window_scatter,
)

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LEAST_TURN = 0.02
"""Turn of the first harmonic [rad] from a moment on that matters: pulses that scatter or a rotor that hunts by half a
degree change hardly a load."""
LEAST_STEADY_TURN = 0.2
"""The same over a record in which it grows steadily: the mean is turned by half of it, and the eighth harmonic a third
smaller."""
SLOW_SIGMAS = 5.0
"""Standard deviations of an amplitude by which a slower one must turn it: half of the turn is in its phase, as pulses
and samples agree where the record begins. Clocks that differ by 1e-4 turn the eighth harmonic of 60 revolutions by 17
degrees from the first to the last."""
FEWEST_ORDERS = 3
"""Harmonics among those that tell a slow turn: a load whose phase drifts turns one."""
COHERENCE = 0.8
"""Length of the sum of the products of neighboring windows, over the sum of their lengths, from which an amplitude
turns regularly; of noise it is below a half."""
FEWEST_AMPLITUDES = 6
"""Amplitudes that must tell a steady turn."""
PREFERENCE = 1e-3
"""By how much half a turn must agree better than none: harmonics that are all multiples of the blades' agree as well
after any part of a revolution between two blades, and noise would choose among these."""
TURNS_PER_HARMONIC = 16
"""Turns of the azimuth that are tried first, over the number of harmonics: between two the last turns by 22 deg."""
ALIKE_SHARE, ALIKE_DEPARTURE = 0.9, 0.25
"""Share of the amplitudes that must have the turn of all, and by how much of their change they may miss it beyond
noise."""
NOISE_LIMIT = 3.0
"""Standard deviations by which noise may miss a change."""


@dataclass(frozen=True)
class CommonTurn:
    """Turn [rad] of all harmonics, from window `window` on or, where `is_steady`, from each window to the next."""

    window: int
    turn: float
    is_steady: bool


def common_turn(values: ComplexArray, weight: Array, sigma: Array) -> CommonTurn | None:
    """Return the turn of amplitudes (w, n, c) of harmonics 1 to n in w windows; None without.

    `weight` (n, c) is the inverse variance of a real component of an amplitude over its squared size, `sigma` (n, c)
    the standard deviation of one over the record.
    """
    # Of amplitudes that turn far the mean over the record may vanish: that over its first or its last third does not.
    third = len(values) // 3
    return (
        _steady_turn(values)
        or _sudden_turn(values, values[:third].mean(axis=0), weight)
        or _sudden_turn(values, values[-third:].mean(axis=0), weight)
        or _slow_turn(values, weight, sigma)
    )


def _steady_turn(values: ComplexArray) -> CommonTurn | None:
    """Return the turn from each window to the next: of amplitudes that turn, no mean over the record is left."""
    count, n, _ = values.shape
    product = (values[:-1].conj() * values[1:]).sum(axis=0)
    most = (np.abs(values[:-1]) * np.abs(values[1:])).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        coherence = np.where(most > 0.0, np.abs(product) / most, 0.0)
    is_clear = coherence > COHERENCE
    if np.count_nonzero(is_clear) < FEWEST_AMPLITUDES:
        return None
    phasor, share = product[is_clear] / np.abs(product[is_clear]), coherence[is_clear]
    order = np.repeat(np.arange(1, n + 1)[:, None], values.shape[2], axis=1)[is_clear]
    turn = float(_best_turn(phasor[None, :], order)[0])
    error = np.sqrt(np.maximum(1.0 / share**2 - 1.0, 0.0) / (2.0 * (count - 1)))
    missed = np.abs(np.angle(phasor * np.exp(-1j * order * turn)))
    is_alike = missed <= ALIKE_DEPARTURE * order * abs(turn) + NOISE_LIMIT * error
    is_known = np.abs(np.angle(phasor)) > NOISE_LIMIT * error
    if abs(turn) * (count - 1) < LEAST_STEADY_TURN or np.count_nonzero(is_known) < FEWEST_AMPLITUDES:
        return None
    # Gusts that shake many channels are one witness: of each harmonic the amplitude that is known best is another.
    best = [np.flatnonzero(order == n)[np.argmax(share[order == n])] for n in np.unique(order)]
    agrees = min(np.mean(is_alike), np.mean(is_alike[best])) >= ALIKE_SHARE
    return CommonTurn(0, turn, is_steady=True) if agrees else None


def _slow_turn(values: ComplexArray, weight: Array, sigma: Array) -> CommonTurn | None:
    """Return the turn from each window to the next by a straight line, where it turns an amplitude by SLOW_SIGMAS."""
    count, size, order = len(values), values.mean(axis=0), np.arange(1, values.shape[1] + 1)[:, None]
    ratio = np.where(size != 0.0, values / np.where(size != 0.0, size, 1.0), 1.0)
    turn, error = _slopes(_best_turn(np.einsum("whc,hc->wh", ratio, weight), order[:, 0]))
    certain = float(stats.t.isf(FALSE_ALARM, np.array(count - 2.0)))
    material = 0.5 * (count - 1) * abs(turn) * np.max(order * np.abs(size) / np.where(sigma > 0.0, sigma, np.inf))
    if abs(turn) <= certain * error or material < SLOW_SIGMAS:
        return None
    of_order, of_order_error = _common_slopes(ratio.imag, weight / order, order, 2)
    if np.count_nonzero(np.abs(of_order) > NOISE_LIMIT * of_order_error) < FEWEST_ORDERS:
        return None
    of_channel, of_channel_error = _common_slopes(ratio.imag, weight * order, order, 1)
    slopes, errors = np.append(of_order, of_channel), np.append(of_order_error, of_channel_error)
    is_alike = np.abs(slopes - turn) <= ALIKE_DEPARTURE * abs(turn) + NOISE_LIMIT * errors
    return CommonTurn(0, float(turn), is_steady=True) if is_alike.all() else None


def _common_slopes(turns: Array, weight: Array, order: NDArray[np.int64], axis: int) -> tuple[Array, Array]:
    """Return the slopes of the turns (w, n, c) over their orders, averaged over an axis, and their standard errors."""
    total = np.maximum(np.sum(weight * order, axis=axis - 1), np.finfo(float).tiny)
    return _slopes(np.sum(turns * weight, axis=axis) / total)


def _slopes(series: Array) -> tuple[Array, Array]:
    """Return the slope (...) of series (w, ...) by windows, and its standard error."""
    x = np.arange(len(series)) - 0.5 * (len(series) - 1)
    centered = series - series.mean(axis=0)
    slope = np.tensordot(x, centered, 1) / (x @ x)
    rest = centered - np.multiply.outer(x, slope)
    return slope, np.sqrt(np.sum(rest**2, axis=0) / ((len(series) - 2) * (x @ x)))


def _sudden_turn(values: ComplexArray, size: ComplexArray, weight: Array) -> CommonTurn | None:
    """Return the turn of amplitudes from a window on, counted from those of a part of the record (n, c).

    None where too few windows tell it.
    """
    ratio = np.where(size != 0.0, values / np.where(size != 0.0, size, 1.0), 1.0)
    order = np.arange(1, values.shape[1] + 1)
    turn = _best_turn(np.einsum("whc,hc->wh", ratio, weight), order)[:, None]
    wander = np.abs(np.cumsum(turn - turn.mean(axis=0), axis=0))[:-1, 0]
    limit = float(critical_sum(len(turn), 1)) * float(window_scatter(turn)[0]) * np.sqrt(len(turn))
    if largest_change(turn)[0] < LEAST_TURN or not wander.max() > limit:
        return None
    window = 1 + int(np.argmax(wander))
    change = float(np.median(turn[window:]) - np.median(turn[:window]))
    if min(window, len(turn) - window) < FEWEST_BESIDE_STEP:
        return None
    return CommonTurn(window, change, is_steady=False) if _is_common(ratio, order, window, change) else None


def _best_turn(phasors: ComplexArray, order: NDArray[np.int64]) -> Array:
    """Return the turns [rad] (w,) by which phasors (w, n) of the orders agree best."""
    turns = np.linspace(-np.pi, np.pi, TURNS_PER_HARMONIC * int(order.max()), endpoint=False)
    agreement = (phasors @ np.exp(-1j * np.outer(order, turns))).real
    most = np.abs(phasors).sum(axis=1, keepdims=True)
    turn = turns[np.argmax(agreement - PREFERENCE * most * np.abs(turns) / np.pi, axis=1)]
    left = np.angle(phasors * np.exp(-1j * np.outer(turn, order)))
    size = np.abs(phasors) * order
    return np.asarray(turn + (left * size).sum(axis=1) / np.maximum(size @ order, np.finfo(float).tiny))


def _is_common(ratio: ComplexArray, order: NDArray[np.int64], window: int, turn: float) -> bool:
    """Whether amplitudes with these ratios to their means (w, n, c) all turn by order times an angle."""
    parts = np.split(ratio, [window])
    before, after = (median_amplitude(part) for part in parts)
    scatter = np.maximum(window_scatter(ratio.real), window_scatter(ratio.imag))
    noise = scatter * np.sqrt(2.0 * sum(1.0 / len(part) for part in parts))
    expected = np.exp(1j * order * turn)[:, None] - 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        missed, noise = np.abs(after / before - 1.0 - expected), noise / np.abs(before)
    is_alike = missed <= ALIKE_DEPARTURE * np.abs(expected) + NOISE_LIMIT * noise
    best = np.take_along_axis(is_alike, np.argmin(noise, axis=1)[:, None], axis=1)
    is_known = np.any(np.abs(expected) > NOISE_LIMIT * noise)
    return bool(is_known and min(np.mean(is_alike), np.mean(best)) >= ALIKE_SHARE)


def median_amplitude(values: ComplexArray) -> ComplexArray:
    """Return the medians (...) of the real and imaginary parts of values (w, ...)."""
    return np.asarray(np.median(values.real, axis=0) + 1j * np.median(values.imag, axis=0))
