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

from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints, fit_calibration_model, refit_terms

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Probability of one good row among all being called an outlier, and of one good sequence.
OUTLIER_SIGNIFICANCE_LEVEL = 1e-3
# A sequence whose gain is off by less than this share is no matter of cables.
MIN_GAIN_ERROR = 0.01
# Share of a sequence's signal that a channel must leave to be called another one's.
MIN_UNEXPLAINED_SHARE = 0.3
MAX_SUSPECT_SERIES = 6
# Share of the rows that may be outliers before it is the model that is wrong.
MAX_OUTLIER_SHARE = 0.05
OUTLIER_LIMIT_FACTOR = 1.3
# Noise over signal up to which a channel hears a sequence; how much worse another sequence may be and still be named.
MAX_NOISE_TO_SIGNAL = 0.1
AMBIGUITY_FACTOR = 1.5
# Square of an error over its noise beyond which it counts no more.
MAX_SCALED_SQUARE = 100.0


@dataclass(frozen=True)
class Outlier:
    """A row that the others do not predict: `row` counted from 1 in its run, error [V], and that over its sigma."""

    run: str
    row: int
    channel: str
    error: float
    over_sigma: float


@dataclass(frozen=True)
class SuspectLoadSeries:
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
class ScreenedFit:
    """The fit without what is wrong, what that is, and `limits`, where the hunt was given up."""

    fit: CalibrationModelFit
    outliers: tuple[Outlier, ...]
    sequences: tuple[SuspectLoadSeries, ...]
    limits: tuple[str, ...]


def screen_outliers(points: CalibrationPoints, search: bool = True) -> ScreenedFit:
    """Fit, name what is plainly wrong, and fit again without: sequences one by one, then rows.

    Nothing is dropped silently: what took no part is in the result.
    """
    suspect_series: list[SuspectLoadSeries] = []
    limits: list[str] = []
    used, fit = points, fit_calibration_model(points, search)
    worst = _worst_series(used, fit, fit_calibration_model(used, search=False) if search else fit)
    while worst is not None and len({one.sequence for one in suspect_series}) < MAX_SUSPECT_SERIES:
        rows, found = worst
        suspect_series += found
        used = used.exclude_rows(rows)
        fit = fit_calibration_model(used, search)
        worst = _worst_series(used, fit, fit_calibration_model(used, search=False) if search else fit)
    if worst is not None:
        limits.append(f"{MAX_SUSPECT_SERIES} loading sequences took no part, and more disagree")
    outliers: list[Outlier] = []
    # One by one: a bad row pulls the model away from its neighbours.
    found_row = _largest_outlier(used, left := fit)
    while found_row is not None and len(outliers) < MAX_OUTLIER_SHARE * len(points.loads):
        row, outlier = found_row
        outliers.append(outlier)
        used = used.exclude_rows(np.arange(len(points.loads)) == row)
        left = refit_terms(used, left.model)
        found_row = _largest_outlier(used, left)
    if found_row is not None:
        limits.append(f"{len(outliers)} rows took no part, and more are away from what the others say")
    fit = fit_calibration_model(used, search) if outliers else fit
    return ScreenedFit(fit, tuple(outliers), tuple(suspect_series), tuple(limits))


def _worst_series(
    points: CalibrationPoints, fit: CalibrationModelFit, linear_fit: CalibrationModelFit
) -> tuple[NDArray[np.bool_], list[SuspectLoadSeries]] | None:
    """The rows (m,) of the sequence without which the rest agrees best, and what is wrong in which channels of it.

    None where all are sound. It must look wrong by the loads alone, and by the terms that were found: what these
    explain is no fault. Of two that disagree with no third to decide, the other one is named with it.
    """
    sequence, used = points.sequence, points.weight > 0
    unexplained = _find_suspect_series(points, fit)
    if not unexplained:
        return None
    each = {
        name: found for name, found in _find_suspect_series(points, linear_fit).items() if name in unexplained and found
    }
    if not each:
        return None
    left = {name: _cross_validation_misfit(points, (sequence == name) & used) for name in each}
    worst = min(each, key=lambda name: left[name])
    known = dict(_series_names(np.unique(sequence[used]), fit))
    others = tuple(known[name] for name in each if name != worst and left[name] < AMBIGUITY_FACTOR * left[worst])
    return (sequence == worst) & used, [replace(one, or_else=others) for one in each[worst]]


def _find_suspect_series(points: CalibrationPoints, fit: CalibrationModelFit) -> dict[int, list[SuspectLoadSeries]]:
    """What is wrong in which channels, by sequence; an empty list where the others do not predict a sequence."""
    sequence, used = points.sequence, points.weight > 0
    found = {}
    for name, description in _series_names(np.unique(sequence[used]), fit):
        rows = (sequence == name) & used
        known = bool(np.isfinite(fit.left_out[rows]).all())
        wrong = _suspect_channels(points, fit, rows, description) if known else []
        if wrong or not known:
            found[name] = wrong
    return found


def _series_names(names: Index, fit: CalibrationModelFit) -> list[tuple[int, str]]:
    return list(zip(names.tolist(), fit.model.sequences, strict=True))


def _cross_validation_misfit(points: CalibrationPoints, rows: NDArray[np.bool_]) -> float:
    """Mean square error of the sequences that are left without these rows, over the noise, large ones reined in."""
    errors = fit_calibration_model(points.exclude_rows(rows), search=False).left_out
    scaled = (errors / _robust_sigma(errors)) ** 2
    return float(np.mean(np.minimum(scaled[np.isfinite(scaled)], MAX_SCALED_SQUARE)))


def _robust_sigma(errors: Array) -> Array:
    """Robust standard deviation (c,) of errors (m, c)."""
    return np.asarray(np.maximum(1.4826 * np.nanmedian(np.abs(errors), axis=0), np.finfo(float).tiny))


def _suspect_channels(
    points: CalibrationPoints, fit: CalibrationModelFit, rows: NDArray[np.bool_], description: str
) -> list[SuspectLoadSeries]:
    """What is wrong with each channel in these rows."""
    change = points.channels[rows] - points.channels[rows].mean(axis=0)
    errors = fit.left_out[rows]
    predicted = change - (errors - errors.mean(axis=0))
    noise = _robust_sigma(fit.left_out)
    each = [
        _check_channel_gain(c, change, predicted, noise, points.channel_names, description)
        for c in range(change.shape[1])
    ]
    return [one for one in each if one is not None]


def _check_channel_gain(
    c: int, change: Array, predicted: Array, noise: Array, channels: Sequence[str], description: str
) -> SuspectLoadSeries | None:
    """Whether one channel's change (rows,) follows its prediction, and if not, whose it follows."""
    power = float(np.sum(predicted[:, c] ** 2))
    if power == 0.0:
        return None
    gain = float(predicted[:, c] @ change[:, c] / power)
    # What a straight line misses goes with the load: it does not average out over the rows.
    sigma = float(noise[c] / np.sqrt(power / len(change)))
    is_significant = abs(gain - 1.0) > max(
        stats.norm.isf(0.5 * OUTLIER_SIGNIFICANCE_LEVEL / len(channels)) * sigma, MIN_GAIN_ERROR
    )
    # A channel that hears next to nothing in this sequence tells nothing of its gain.
    if not is_significant or sigma > MAX_NOISE_TO_SIGNAL:
        return None
    left = change[:, c] - gain * predicted[:, c]
    like = ""
    if np.sum(left**2) > MIN_UNEXPLAINED_SHARE**2 * np.sum(change[:, c] ** 2) or gain < 0.5:
        others = [_unexplained_share(change[:, c], predicted[:, i]) for i in range(len(channels))]
        best = int(np.argmin(others))
        like = channels[best] if best != c and others[best] < MIN_UNEXPLAINED_SHARE**2 else ""
    return SuspectLoadSeries(description, channels[c], gain, sigma, like)


def _unexplained_share(change: Array, predicted: Array) -> float:
    """Share of a change's power that a prediction leaves, as it is."""
    return float(np.sum((change - predicted) ** 2) / max(float(np.sum(change**2)), np.finfo(float).tiny))


def _largest_outlier(points: CalibrationPoints, fit: CalibrationModelFit) -> tuple[int, Outlier] | None:
    """The row whose error, predicted by all others, is largest, if it is beyond chance."""
    used = points.weight > 0
    scaled = fit.press * np.sqrt(points.weight)[:, None]
    over = np.where(used[:, None], np.abs(scaled) / _robust_row_sigma(scaled, points.sequence, used), 0.0)
    # A median of so many rows is itself known to a few per cent only.
    limit = OUTLIER_LIMIT_FACTOR * stats.t.isf(
        0.5 * OUTLIER_SIGNIFICANCE_LEVEL / over.size, max(float(np.min(fit.model.dof)), 3.0)
    )
    row, c = divmod(int(np.argmax(over)), over.shape[1])
    if over[row, c] <= limit:
        return None
    run = int(points.run[row])
    number = row - int(np.flatnonzero(points.run == run)[0]) + 1
    name, channel = points.run_names[run], points.channel_names[c]
    return row, Outlier(name, number, channel, float(fit.press[row, c]), float(over[row, c]))


def _robust_row_sigma(errors: Array, sequence: Index, used: NDArray[np.bool_]) -> Array:
    """Robust standard deviation (m, c) of each row's errors: of all rows or, where larger, of its sequence.

    The noise of a load reading is there only where that load was applied.
    """
    found = np.tile(_robust_sigma(errors[used]), (len(errors), 1))
    for name in np.unique(sequence[used]):
        rows = (sequence == name) & used
        # A bad row shifts the zero of its sequence: all others are off by as much.
        found[rows] = np.maximum(found[rows], _robust_sigma(errors[rows] - np.median(errors[rows], axis=0)))
    return found


def exchanged(points: CalibrationPoints, expected: Array) -> tuple[str, ...]:
    """Pairs of channels that read each other's loads, `expected` (c, k) being the declared response over full range.

    Two rows of the straight fit that both follow the other's declared row far better than their own.
    """
    found = fit_calibration_model(replace(points), search=False).model.coefficients[: len(points.components)].T
    alike = _unit_rows(found) @ _unit_rows(expected).T
    pairs = []
    for i in range(len(found)):
        for j in range(i + 1, len(found)):
            own, other = min(alike[i, i], alike[j, j]), min(alike[i, j], alike[j, i])
            if other > 0.95 and own < 0.8:
                pairs.append(f"{points.channel_names[i]} and {points.channel_names[j]}")
    return tuple(pairs)


def _unit_rows(rows: Array) -> Array:
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.where(size > 0, size, 1.0))
