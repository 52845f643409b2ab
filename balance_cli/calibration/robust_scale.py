"""Robust standard deviations of the errors of a calibration, which outliers hardly affect."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MIN_OWN_SCALE_ROWS = 12
"""Rows of a load series from which its own scale is trusted: one outlier shifts the zero of fewer rows too far."""
MAX_SHORT_SERIES_RATIO = 3.0
"""Scale of a shorter load series over the median of all series at most.

The noise of a load reading is present only where that load was applied, and makes some series noisier than others.
"""


def robust_sigma(errors: Array) -> Array:
    """Robust standard deviation (c,) of errors (m, c): 1.4826 times the median of their absolute values."""
    # np.nanmedian takes several times as long where nothing is missing.
    median = np.median if np.isfinite(errors).all() else np.nanmedian
    return np.asarray(np.maximum(1.4826 * median(np.abs(errors), axis=0), np.finfo(float).tiny))


def robust_row_sigma(errors: Array, load_series: Index, used: NDArray[np.bool_]) -> Array:
    """Robust standard deviation (m, c) of the errors of each row: that of all rows or, if larger, of its load series.

    In a short load series an outlier hides in the scale of the series. That scale is therefore limited by the others'.
    """
    used = used & np.asarray(np.isfinite(errors).all(axis=1))
    common = robust_sigma(errors[used])
    names = np.unique(load_series[used])
    own = {name: _series_sigma(errors[(load_series == name) & used]) for name in names.tolist()}
    limit = MAX_SHORT_SERIES_RATIO * np.maximum(np.median(list(own.values()), axis=0), common)
    sigma = np.tile(common, (len(errors), 1))
    for name, scale in own.items():
        rows = (load_series == name) & used
        bounded = scale if np.count_nonzero(rows) >= MIN_OWN_SCALE_ROWS else np.minimum(scale, limit)
        sigma[rows] = np.maximum(common, bounded)
    return sigma


def _series_sigma(errors: Array) -> Array:
    # An outlier shifts the zero of its load series, and with it the errors of all other rows.
    return robust_sigma(errors - np.median(errors, axis=0))
