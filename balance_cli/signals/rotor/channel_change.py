"""Whether one channel changes within a record while the others do not: its gain, its delay, or its contact.

Loads change several channels, and each harmonic by itself. What changes all harmonics of one channel by one factor, or
turns them by one delay, is no load; neither is what disturbs windows of one channel alone. No other channel of the same
force is needed to see it, nor a model of the rig.

The relative change of all harmonics of a window is one number for each channel, known much better than that of a single
harmonic: a drift by a few per cent shows in records of fifty revolutions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.rotor.common_turn import CommonTurn, common_turn, median_amplitude
from balance_cli.signals.rotor.steadiness import (
    FEWEST_WINDOWS,
    critical_sum,
    largest_change,
    window_scatter,
)

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Integers = NDArray[np.int64]

LEAST_GAIN = 0.02
"""Change of the gain of a channel that matters. No load changes all harmonics of one channel alone."""
LEAST_TURN = 0.007
"""Turn of the first harmonic [rad] that matters: it turns the third one by as much as LEAST_GAIN changes it."""
ALONE = 4.0
"""Change of a channel over that of any channel of another sensor from which it changes alone."""
FEWEST_HARMONICS = 6
"""Harmonics that must tell the change: the weight of a harmonic is at most that of the sixth best known."""
ALIKE_SHARE, ALIKE_DEPARTURE = 0.9, 0.25
"""Share of the harmonics that must have the change of all, and by how much of it they may miss it beyond noise."""
NOISE_LIMIT = 3.0
"""Standard deviations by which noise may miss a change."""
BURST = 25.0
"""Power of a window, over the usual one, from which it is disturbed: five standard deviations in every harmonic."""
ALONE_IN_POWER = 10.0
"""The same over the power of any channel of another sensor in this window from which the channel is disturbed alone."""
MATERIAL_BURST = 4.0
"""Standard deviations of an amplitude that the disturbed windows must change: spikes are noise, which sigma contains,
and change one of eight harmonics by so much once in 400 records."""
BEYOND_CHANCE = 3.0
"""Standard deviations of the mean of windows from which it differs from their median by more than chance: the
difference has a standard deviation of 0.75 of them."""
ENDS = 8
"""Part of a record whose mean is that at its begin or end: a drift goes from one to the other, a step is half of it."""


@dataclass(frozen=True)
class RelativeChanges:
    """Changes of channels from window to window, relative to their amplitudes.

    `series` (w, 2, c): gain less one and turn [rad] that all harmonics of a channel have, with their `scatter` (2, c);
    `ratio` (w, n, c): the change of each harmonic, with the `variance` (n, c) of a real component of it, and its
    `weight` (n, c) among the harmonics.
    """

    series: Array
    scatter: Array
    ratio: ComplexArray
    variance: Array
    weight: Array


@dataclass(frozen=True)
class ChannelChange:
    """What channel `column` (None: all) does from window `window` on, in words, with the cause to ask for."""

    column: int | None
    window: int
    description: str
    question: str


def channel_change(values: ComplexArray, sensors: Integers, sigma: Array) -> ChannelChange | None:
    """Return what one channel does alone in w windows of amplitudes (w, n, c) of harmonics 1 to n; None without.

    `sensors` (c,) numbers what each channel measures, `sigma` (n, c) is the standard deviation of a real component of
    the amplitudes of the record.
    """
    if len(values) < FEWEST_WINDOWS or values.shape[1] < FEWEST_HARMONICS:
        return None
    changes = relative_changes(values)
    turn = common_turn(values, changes.weight, sigma)
    if turn is not None:
        return _describe_turn(turn)
    return _change_alone(changes, sensors) or _disturbed_channel(values, sensors, sigma)


def _describe_turn(turn: CommonTurn) -> ChannelChange:
    if turn.is_steady:
        said = f"turn by harmonic times {np.degrees(turn.turn):+.2g} deg from each window to the next"
        asked = "do the pulses belong to the record, is `sample_rate` right, have pulses and samples one clock?"
        return ChannelChange(None, 0, said, asked)
    said = f"turn by harmonic times {np.degrees(turn.turn):+.2g} deg"
    return ChannelChange(None, turn.window, said, "did the azimuth slip, or were samples lost?")


def _change_alone(changes: RelativeChanges, sensors: Integers) -> ChannelChange | None:
    series, ratio, variance = changes.series, changes.ratio, changes.variance
    least = np.array([LEAST_GAIN, LEAST_TURN])[:, None]
    size = (largest_change(series) / least).max(axis=0)
    # Modes that outlast a window correlate the noise of one harmonic; of several at once, none does.
    scatter = np.maximum(changes.scatter, window_scatter(series))
    wander = np.abs(np.cumsum(series - series.mean(axis=0), axis=0))[:-1] / (scatter * np.sqrt(len(series)))
    limit = critical_sum(len(series), 2 * FEWEST_HARMONICS)
    changed = (size > 1.0) & np.any(wander.max(axis=0) > limit, axis=0) & (_others(size, sensors) * ALONE < size)
    order = np.arange(1, len(variance) + 1)
    for c in np.flatnonzero(changed).tolist():
        window = 1 + int(np.argmax(wander[:, :, c].max(axis=1)))
        before, after = (part.mean(axis=0) for part in np.split(series[:, :, c], [window]))
        if _is_common(ratio[:, :, c], variance[:, c], order, window, after - before):
            return _describe(c, window, (1.0 + after[0]) / (1.0 + before[0]), after[1] - before[1])
    return None


def relative_changes(values: ComplexArray) -> RelativeChanges:
    """Return the relative changes of amplitudes (w, n, c) of harmonics 1 to n of c channels in w windows."""
    size = values.mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(size != 0.0, values / size - 1.0, 0.0)
        scatter = np.maximum(window_scatter(values.real), window_scatter(values.imag))
        precision = np.where(scatter > 0.0, np.abs(size) ** 2 / scatter**2, 0.0)
    weight = np.minimum(precision, np.sort(precision, axis=0)[-FEWEST_HARMONICS])
    order = np.arange(1.0, values.shape[1] + 1)[:, None]
    information = np.stack([weight.sum(axis=0), (weight * order**2).sum(axis=0)])
    series = np.stack([(weight * ratio.real).sum(axis=1), (weight * order * ratio.imag).sum(axis=1)], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = np.where(precision > 0.0, 1.0 / precision, np.inf)
        known = np.stack([weight**2 * variance, weight**2 * order**2 * variance])
        spread = np.sqrt(np.nansum(known, axis=1)) / information
        series, spread = np.nan_to_num(series / information), np.where(spread > 0.0, spread, np.inf)
    return RelativeChanges(series, spread, ratio, variance, weight)


def _others(size: Array, sensors: Integers) -> Array:
    """Return the largest of the sizes (c,) among the channels of other sensors than each."""
    other = sensors[:, None] != sensors[None, :]
    return np.asarray(np.where(other, size[None, :], 0.0).max(axis=1))


def _is_common(ratio: ComplexArray, variance: Array, order: Integers, window: int, change: Array) -> bool:
    """Whether amplitudes with these relative changes (w, r) all have a change of gain and turn from a window on."""
    before, after = (1.0 + median_amplitude(part) for part in np.split(ratio, [window]))
    expected = (1.0 + change[0]) * np.exp(1j * order * change[1]) - 1.0
    noise = np.sqrt(2.0 * variance * (1.0 / window + 1.0 / (len(ratio) - window)))
    with np.errstate(divide="ignore", invalid="ignore"):
        missed, noise = np.abs(after / before - 1.0 - expected), noise / np.abs(before)
    return bool(np.mean(missed <= ALIKE_DEPARTURE * np.abs(expected) + NOISE_LIMIT * noise) >= ALIKE_SHARE)


def _describe(column: int, window: int, factor: float, turn: float) -> ChannelChange:
    parts = [
        f"have {factor:.3g} times their size" if abs(factor - 1.0) > LEAST_GAIN / 2.0 else "",
        f"turn by harmonic times {np.degrees(turn):+.2g} deg" if abs(turn) > LEAST_TURN / 2.0 else "",
    ]
    question = "did its gain or excitation change?" if parts[0] else "were its samples lost or late?"
    return ChannelChange(column, window, " and ".join(filter(None, parts)), question)


def _disturbed_channel(values: ComplexArray, sensors: Integers, sigma: Array) -> ChannelChange | None:
    """Return the channel of which windows are disturbed that no other sensor shows, if that matters; None without."""
    size = median_amplitude(values)
    departure = np.abs(values - size) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        usual = np.median(departure, axis=0)
        power = np.where(usual > 0.0, departure / usual, 0.0).mean(axis=1)
    for c in range(values.shape[2]):
        others = power[:, sensors != sensors[c]].max(axis=1, initial=0.0)
        disturbed = (power[:, c] > BURST) & (power[:, c] > ALONE_IN_POWER * others)
        if not disturbed.any() or disturbed.mean() > 0.5:
            continue
        change = np.abs(values[~disturbed, :, c].mean(axis=0) - values[:, :, c].mean(axis=0))
        if np.any(change > MATERIAL_BURST * sigma[:, c]):
            windows = (
                f"are disturbed in {np.count_nonzero(disturbed)} of {len(values)} windows, those of no other sensor"
            )
            return ChannelChange(c, int(np.argmax(disturbed)), windows, "is its contact loose?")
    return None


def harmonic_drift(values: ComplexArray, reported: ComplexArray, sigma: Array, mean_changes: bool = False) -> Array:
    """Return by how much changes within a record make its harmonic loads `reported` (n, m) uncertain, (n, m).

    `values` (w, n, m) are the loads of windows, `sigma` (n, m) the standard deviations, below which an effect is left
    out. `mean_changes`: whether a mean load is known to step or drift, so that less has to be shown.
    """
    if len(values) < FEWEST_WINDOWS or not values.size:
        return np.zeros(sigma.shape)
    remainder = step_remainder(values, reported, 1.0 if mean_changes else BEYOND_CHANCE)
    error = np.hypot(common_drift(values) * np.abs(reported), remainder)
    return np.where(error > sigma, error, 0.0)


def step_remainder(values: ComplexArray, reported: ComplexArray, limit: float) -> Array:
    """Return by how much the loads (n, m) reported, or the mean of windows (w, n, m), miss most windows, (n, m).

    It is zero up to `limit` standard deviations of the mean.
    """
    scatter = np.hypot(window_scatter(values.real), window_scatter(values.imag)) / np.sqrt(len(values))
    most = median_amplitude(values)
    remainder = np.maximum(np.abs(reported - most), np.abs(values.mean(axis=0) - most))
    return np.where(remainder > limit * scatter, remainder, 0.0)


def common_drift(values: ComplexArray) -> float:
    """Return half of the relative change that all loads of windows (w, n, m) have in common; 0 where it may be chance.

    As of a mean load, nobody knows whether what is sought is the load before or after. Fewer than six loads tell none.
    """
    if values[0].size < FEWEST_HARMONICS:
        return 0.0
    changes = relative_changes(values.reshape(len(values), -1, 1))
    return _half_change(changes.series[:, 0, 0], float(changes.scatter[0, 0]))


def _half_change(series: Array, scatter: float) -> float:
    """Return half of what a series (w,) of windows changes by, 0 where its scatter or that given explains it."""
    # Modes that outlast a window correlate the noise of one harmonic; of several at once, none does.
    scatter = max(scatter, float(window_scatter(series)))
    wander = float(np.abs(np.cumsum(series - series.mean())).max())
    if wander <= critical_sum(len(series), 2 * FEWEST_HARMONICS) * scatter * np.sqrt(len(series)):
        return 0.0
    part = max(len(series) // ENDS, 2)
    return 0.5 * max(float(largest_change(series)), abs(float(series[-part:].mean() - series[:part].mean())))
