"""Rows that stand out from a robust fit of the loads, or that intrude into a load series, before terms are selected.

Terms selected with gross errors among the rows would explain these.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.load_series import intruding_rows
from balance_cli.calibration.robust_fit import fit_robustly

Mask = NDArray[np.bool_]


def gross_outlier_candidates(points: CalibrationPoints) -> Mask:
    """Rows (m,) that stand out from a robust fit, whose loads belong to another load series, or are misplaced."""
    misplaced = misplaced_rows(points)
    # The errors of misplaced loads would hide in the robust fit of a short table, and make others stand out.
    used = np.flatnonzero((points.weight > 0) & ~misplaced)
    block = np.unique(points.load_series[used], return_inverse=True)[1]
    candidates = np.zeros(len(points.weight), bool)
    candidates[used] = fit_robustly(points.x[used], points.channels[used], block).stands_out
    for segment in np.unique(points.attitude_segment[used]):
        rows = used[points.attitude_segment[used] == segment]
        candidates[rows] |= intruding_rows(points.x[rows])
    return candidates | misplaced


def misplaced_rows(points: CalibrationPoints) -> Mask:
    """Rows (m,) whose loads were found to stand in each other's row, or to have the wrong sign."""
    misplaced = np.zeros(len(points.weight), bool)
    misplaced[list(points.series_reading.misplaced)] = True
    return misplaced & (points.weight > 0)
