"""What is plainly wrong in a calibration: a row, a loading sequence of a channel, two channels exchanged.

Each is judged by what the rest predicts, never by a fit that it took part in, and the scale is a median, which the
wrong ones do not move.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from balance_cli.calibration.fit import GageFit, LoadPoints, gage_fit, refitted

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Probability of one good row among all being called an outlier, and of one good sequence.
LEVEL = 1e-3
# A sequence whose gain is off by less than this share is no matter of cables.
LEAST_GAIN = 0.01
# Share of a sequence's signal that a channel must leave to be called another one's.
UNLIKE = 0.3
MOST = 6
# Share of the rows that may be outliers before it is the model that is wrong.
MOST_OUTLIERS = 0.05
ROOM = 1.3
# Noise over signal up to which a channel hears a sequence; how much worse another sequence may be and still be named.
LEAST_HEARD = 0.1
ALIKE = 1.5
# Square of an error over its noise beyond which it counts no more.
LARGEST = 100.0


@dataclass(frozen=True)
class Outlier:
    """A row that the others do not predict: `row` counted from 1 in its run, error [V], and that over its sigma."""

    run: str
    row: int
    channel: str
    error: float
    over_sigma: float


@dataclass(frozen=True)
class BadSequence:
    """A loading sequence in which a channel does not do what the other sequences predict.

    `gain` +- `gain_sigma` of its change over the predicted one; `like`: the channel whose prediction it follows
    instead, empty where none. `or_else`: sequences that may be the bad ones in its place.
    """

    sequence: str
    channel: str
    gain: float
    gain_sigma: float
    like: str
    or_else: tuple[str, ...] = ()


@dataclass(frozen=True)
class Examined:
    """The fit without what is wrong, what that is, and `limits`, where the hunt was given up."""

    fit: GageFit
    outliers: tuple[Outlier, ...]
    sequences: tuple[BadSequence, ...]
    limits: tuple[str, ...]


def examined(points: LoadPoints, search: bool = True) -> Examined:
    """Fit, name what is plainly wrong, and fit again without: sequences one by one, then rows.

    Nothing is dropped silently: what took no part is in the result.
    """
    bad: list[BadSequence] = []
    limits: list[str] = []
    used, fit = points, gage_fit(points, search)
    worst = _worst_sequence(used, fit, gage_fit(used, search=False) if search else fit)
    while worst is not None and len({one.sequence for one in bad}) < MOST:
        rows, found = worst
        bad += found
        used = used.without(rows)
        fit = gage_fit(used, search)
        worst = _worst_sequence(used, fit, gage_fit(used, search=False) if search else fit)
    if worst is not None:
        limits.append(f"{MOST} loading sequences took no part, and more disagree")
    outliers: list[Outlier] = []
    # One by one: a bad row pulls the model away from its neighbours.
    found_row = _outlier(used, left := fit)
    while found_row is not None and len(outliers) < MOST_OUTLIERS * len(points.loads):
        row, outlier = found_row
        outliers.append(outlier)
        used = used.without(np.arange(len(points.loads)) == row)
        left = refitted(used, left.model)
        found_row = _outlier(used, left)
    if found_row is not None:
        limits.append(f"{len(outliers)} rows took no part, and more are away from what the others say")
    fit = gage_fit(used, search) if outliers else fit
    return Examined(fit, tuple(outliers), tuple(bad), tuple(limits))


def _worst_sequence(
    points: LoadPoints, fit: GageFit, straight: GageFit
) -> tuple[NDArray[np.bool_], list[BadSequence]] | None:
    """The rows (m,) of the sequence without which the rest agrees best, and what is wrong in which channels of it.

    None where all are sound. It must look wrong by the loads alone, and by the terms that were found: what these
    explain is no fault. Of two that disagree with no third to decide, the other one is named with it.
    """
    sequence, used = points.sequence, points.weight > 0
    unexplained = _suspected(points, fit)
    if not unexplained:
        return None
    each = {name: found for name, found in _suspected(points, straight).items() if name in unexplained and found}
    if not each:
        return None
    left = {name: _disagreement(points, (sequence == name) & used) for name in each}
    worst = min(each, key=lambda name: left[name])
    known = dict(_words(np.unique(sequence[used]), fit))
    others = tuple(known[name] for name in each if name != worst and left[name] < ALIKE * left[worst])
    return (sequence == worst) & used, [replace(one, or_else=others) for one in each[worst]]


def _suspected(points: LoadPoints, fit: GageFit) -> dict[int, list[BadSequence]]:
    """What is wrong in which channels, by sequence; an empty list where the others do not predict a sequence."""
    sequence, used = points.sequence, points.weight > 0
    found = {}
    for name, words in _words(np.unique(sequence[used]), fit):
        rows = (sequence == name) & used
        known = bool(np.isfinite(fit.left_out[rows]).all())
        wrong = _channels(points, fit, rows, words) if known else []
        if wrong or not known:
            found[name] = wrong
    return found


def _words(names: Index, fit: GageFit) -> list[tuple[int, str]]:
    return list(zip(names.tolist(), fit.model.sequences, strict=True))


def _disagreement(points: LoadPoints, rows: NDArray[np.bool_]) -> float:
    """Mean square error of the sequences that are left without these rows, over the noise, large ones reined in."""
    errors = gage_fit(points.without(rows), search=False).left_out
    scaled = (errors / _noise(errors)) ** 2
    return float(np.mean(np.minimum(scaled[np.isfinite(scaled)], LARGEST)))


def _noise(errors: Array) -> Array:
    """Robust standard deviation (c,) of errors (m, c)."""
    return np.asarray(np.maximum(1.4826 * np.nanmedian(np.abs(errors), axis=0), np.finfo(float).tiny))


def _channels(points: LoadPoints, fit: GageFit, rows: NDArray[np.bool_], words: str) -> list[BadSequence]:
    """What is wrong with each channel in these rows."""
    change = points.channels[rows] - points.channels[rows].mean(axis=0)
    errors = fit.left_out[rows]
    predicted = change - (errors - errors.mean(axis=0))
    noise = _noise(fit.left_out)
    each = [_judged(c, change, predicted, noise, points.channel_names, words) for c in range(change.shape[1])]
    return [one for one in each if one is not None]


def _judged(
    c: int, change: Array, predicted: Array, noise: Array, channels: Sequence[str], words: str
) -> BadSequence | None:
    """Whether one channel's change (rows,) follows its prediction, and if not, whose it follows."""
    power = float(np.sum(predicted[:, c] ** 2))
    if power == 0.0:
        return None
    gain = float(predicted[:, c] @ change[:, c] / power)
    # What a straight line misses goes with the load: it does not average out over the rows.
    sigma = float(noise[c] / np.sqrt(power / len(change)))
    far = abs(gain - 1.0) > max(stats.norm.isf(0.5 * LEVEL / len(channels)) * sigma, LEAST_GAIN)
    # A channel that hears next to nothing in this sequence tells nothing of its gain.
    if not far or sigma > LEAST_HEARD:
        return None
    left = change[:, c] - gain * predicted[:, c]
    like = ""
    if np.sum(left**2) > UNLIKE**2 * np.sum(change[:, c] ** 2) or gain < 0.5:
        others = [_unexplained(change[:, c], predicted[:, i]) for i in range(len(channels))]
        best = int(np.argmin(others))
        like = channels[best] if best != c and others[best] < UNLIKE**2 else ""
    return BadSequence(words, channels[c], gain, sigma, like)


def _unexplained(change: Array, predicted: Array) -> float:
    """Share of a change's power that a prediction leaves, as it is."""
    return float(np.sum((change - predicted) ** 2) / max(float(np.sum(change**2)), np.finfo(float).tiny))


def _outlier(points: LoadPoints, fit: GageFit) -> tuple[int, Outlier] | None:
    """The row whose error, predicted by all others, is largest, if it is beyond chance."""
    used = points.weight > 0
    scaled = fit.press * np.sqrt(points.weight)[:, None]
    over = np.where(used[:, None], np.abs(scaled) / _noise_of_rows(scaled, points.sequence, used), 0.0)
    # A median of so many rows is itself known to a few per cent only.
    limit = ROOM * stats.t.isf(0.5 * LEVEL / over.size, max(float(np.min(fit.model.dof)), 3.0))
    row, c = divmod(int(np.argmax(over)), over.shape[1])
    if over[row, c] <= limit:
        return None
    run = int(points.run[row])
    number = row - int(np.flatnonzero(points.run == run)[0]) + 1
    name, channel = points.run_names[run], points.channel_names[c]
    return row, Outlier(name, number, channel, float(fit.press[row, c]), float(over[row, c]))


def _noise_of_rows(errors: Array, sequence: Index, used: NDArray[np.bool_]) -> Array:
    """Robust standard deviation (m, c) of each row's errors: of all rows or, where larger, of its sequence.

    The noise of a load reading is there only where that load was applied.
    """
    found = np.tile(_noise(errors[used]), (len(errors), 1))
    for name in np.unique(sequence[used]):
        rows = (sequence == name) & used
        # A bad row shifts the zero of its sequence: all others are off by as much.
        found[rows] = np.maximum(found[rows], _noise(errors[rows] - np.median(errors[rows], axis=0)))
    return found


def exchanged(points: LoadPoints, expected: Array) -> tuple[str, ...]:
    """Pairs of channels that read each other's loads, `expected` (c, k) being the declared response over full range.

    Two rows of the straight fit that both follow the other's declared row far better than their own.
    """
    found = gage_fit(replace(points), search=False).model.coefficients[: len(points.components)].T
    alike = _unit(found) @ _unit(expected).T
    pairs = []
    for i in range(len(found)):
        for j in range(i + 1, len(found)):
            own, other = min(alike[i, i], alike[j, j]), min(alike[i, j], alike[j, i])
            if other > 0.95 and own < 0.8:
                pairs.append(f"{points.channel_names[i]} and {points.channel_names[j]}")
    return tuple(pairs)


def _unit(rows: Array) -> Array:
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.where(size > 0, size, 1.0))
