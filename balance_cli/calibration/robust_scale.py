"""Robust standard deviations of the errors of a calibration, which outliers hardly affect."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.noise import APPLIED_SHARE

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MIN_OWN_SCALE_ROWS = 12
"""Rows of a load series from which its own scale is trusted: one outlier shifts the zero of fewer rows too far."""
MAX_SHORT_SERIES_RATIO = 3.0
"""Scale of a shorter load series over the median of all series at most.

The noise of a load reading is present only where that load was applied, and makes some series noisier than others.
"""


USUAL_LOAD_ERROR, LARGEST_LOAD_ERROR = 2e-4, 1e-3
"""Relative standard deviations that loads have anyway, and may have: weights, hangers and lever arms are known to 0.02
to 0.1 %."""
FAR_SHARE, MIN_FAR_ROWS = 0.25, 3
"""Share of the range of a channel from which a row shows the error of its load, and the rows that tell it."""


MIN_UNLOADED_ROWS = 3
"""Unloaded rows of one kind from which they have a scale of their own: one wrong row does not make their median."""


def growth_without_load(ratio: Array, x: Array, load_series: Index, used: NDArray[np.bool_]) -> Array:
    """Factor (m,), 1 at least, by which the errors of unloaded rows are in general larger than those of the others.

    `ratio` (m,): error of each row that is `used` over its standard deviation; x (m, k): loads in units of the
    calibrated range. Where a load hangs during a whole load series, the unloaded row alone compares its weight and its
    line of action with those of the other series; elsewhere it shows what comes with the first weight, hanger and
    friction. These two kinds of rows have errors that no loaded row has.
    """
    loaded = np.any(np.abs(x) > APPLIED_SHARE, axis=1)
    beside = np.zeros(len(x), bool)
    for name in np.unique(load_series):
        rows = load_series == name
        values = x[rows & loaded]
        if len(values):
            beside[rows] = np.any((np.ptp(values, axis=0) <= APPLIED_SHARE) & (np.abs(values[0]) > APPLIED_SHARE))
    growth = np.ones(len(x))
    for kind in (~loaded & beside, ~loaded & ~beside):
        if np.count_nonzero(kind & used) >= MIN_UNLOADED_ROWS and np.any(loaded & used):
            usual = max(float(np.median(ratio[loaded & used])), np.finfo(float).tiny)
            growth[kind] = max(1.0, float(np.median(ratio[kind & used])) / usual)
    return growth


def robust_sigma(errors: Array) -> Array:
    """Robust standard deviation (c,) of errors (m, c): 1.4826 times the median of their absolute values."""
    # np.nanmedian takes several times as long where nothing is missing.
    median = np.median if np.isfinite(errors).all() else np.nanmedian
    return np.asarray(np.maximum(1.4826 * median(np.abs(errors), axis=0), np.finfo(float).tiny))


def load_error_sigma(errors: Array, predicted: Array) -> Array:
    """Standard deviation (m, c) of errors (m, c) in proportion to the readings (m, c) that the loads should cause.

    A weight that is off by a share of itself changes the reading by that share: a channel that one load moves, as a
    torque meter, has this error in few rows, and most rows show its noise alone. The rows that show it tell the share,
    within LARGEST_LOAD_ERROR.
    """
    size = np.abs(predicted)
    far = np.isfinite(errors) & (size >= FAR_SHARE * np.max(size, axis=0)) & (size > 0.0)
    ratio = np.where(far, np.abs(errors) / np.where(far, size, 1.0), 0.0)
    known = np.count_nonzero(far, axis=0) >= MIN_FAR_ROWS
    share = np.array([robust_sigma(ratio[far[:, c], c, None])[0] if known[c] else 0.0 for c in range(len(known))])
    return np.asarray(np.clip(share, USUAL_LOAD_ERROR, LARGEST_LOAD_ERROR) * size)


def robust_row_sigma(errors: Array, load_series: Index, used: NDArray[np.bool_], x: Array) -> Array:
    """Robust standard deviation (m, c) of the errors of each row: that of all rows or, if larger, of its load series.

    In a short load series an outlier hides in the scale of the series. That scale is therefore limited by the others'.
    A dozen rows tell their own scale to a quarter, and may be quiet by chance: series in which the same of the loads
    x (m, k), in units of the calibrated range, vary have the noise of these loads in common, and none has less than
    all of them together. Rows that are not `used` have the scale of their series. Unloaded rows have at least that of
    such rows.
    """
    used = used & np.asarray(np.isfinite(errors).all(axis=1))
    common = robust_sigma(errors[used])
    members = {name: np.flatnonzero((load_series == name) & used) for name in np.unique(load_series[used]).tolist()}
    # An outlier shifts the zero of its load series, and with it the errors of all other rows.
    centered = {name: errors[rows] - np.median(errors[rows], axis=0) for name, rows in members.items()}
    own = {name: robust_sigma(values) for name, values in centered.items()}
    limit = MAX_SHORT_SERIES_RATIO * np.maximum(np.median(list(own.values()), axis=0), common)
    shared = _sigma_by_varied_loads({name: x[rows] for name, rows in members.items()}, centered)
    sigma = np.tile(common, (len(errors), 1))
    for name, rows in members.items():
        scale = np.maximum(own[name], shared[name])
        bounded = scale if len(rows) >= MIN_OWN_SCALE_ROWS else np.minimum(scale, limit)
        sigma[load_series == name] = np.maximum(common, bounded)
    ratio = np.max(np.abs(np.where(used[:, None], errors, 0.0)) / common, axis=1)
    return np.asarray(np.maximum(sigma, common * growth_without_load(ratio, x, load_series, used)[:, None]))


def _sigma_by_varied_loads(x: Mapping[int, Array], centered: Mapping[int, Array]) -> dict[int, Array]:
    """Robust standard deviation (c,) of the errors of all load series in which the same loads vary, by series.

    Rows at which the load of the series is off have none of its noise, and are left out.
    """
    varied = {name: np.ptp(values, axis=0) > APPLIED_SHARE for name, values in x.items()}
    alike = defaultdict(list)
    for name, values in x.items():
        changes = np.abs(values - values[np.argmin(np.abs(values), axis=0), np.arange(values.shape[1])])
        applied = np.any(changes[:, varied[name]] > APPLIED_SHARE, axis=1)
        alike[varied[name].tobytes()].append(centered[name][applied])
    sigma = {key: robust_sigma(np.concatenate(parts)) for key, parts in alike.items() if any(map(len, parts))}
    none = np.zeros(next(iter(centered.values())).shape[1])
    return {name: sigma.get(of_series.tobytes(), none) for name, of_series in varied.items()}
