"""The non-iterative method: loads as functions of the readings (AIAA R-091A-2020).

With more channels than loads the readings are redundant. They are therefore replaced by the linear loads
y = W (r - zero), in units of the calibrated range, with W C1 = 1 as in the calibration model. The loads are

    x = y + sum_t b_t h_t(y),

with terms h selected and fitted as for a channel, loads in the place of readings. The method is faster than the
iteration and needs no proof of convergence. It is less accurate where readings are noisy, because terms of noisy
regressors y are biased.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.fit import CalibrationPoints, fit_calibration_model
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.noniterative_model import NonIterativeModel
from balance_cli.calibration.term_choice import SEARCHED, TermChoice

Array = NDArray[np.float64]


def fit_noniterative_model(
    points: CalibrationPoints, math_model: CalibrationModel, used: NDArray[np.bool_], choice: TermChoice = SEARCHED
) -> NonIterativeModel:
    """Fit the loads as functions of the readings to the rows `used` (m,), with the zeros of the calibration model."""
    W = math_model.inverse()
    load_series = points.load_series
    fitted_series = np.unique(load_series[used])
    # Rows of an excluded load series have no zero: the zero assigned to them does not matter, their weight is 0.
    place = np.clip(np.searchsorted(fitted_series, load_series), 0, len(fitted_series) - 1)
    y = (points.channels - math_model.zeros[place]) @ W.T
    exchanged_points = CalibrationPoints(
        channel_names=points.components,
        components=points.components,
        run_names=points.run_names,
        channels=points.x,
        loads=y,
        run=points.run,
        weight=np.where(used, points.weight, 0.0),
        calibrated_range=np.ones(len(points.components)),
        gravity=points.gravity,
        series=load_series,
    )
    return NonIterativeModel(
        W, fit_calibration_model(exchanged_points, choice.for_all_channels(), points.x).model, points.calibrated_range
    )
