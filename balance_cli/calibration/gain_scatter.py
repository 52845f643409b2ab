"""Gain errors of load series that are no fault, and how far gains scatter: what the model lacks changes all of them.

A model that lacks terms, the loads alone for a balance that curves, predicts no load series: each gain errs by as much
as another. A wrong gain is that of one series. It is therefore compared with the gains of the others.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints
from balance_cli.calibration.robust_scale import robust_sigma

Array = NDArray[np.float64]

MIN_GAIN_ERROR = 0.01
"""Gain error below which no load series is suspected: nonlinearity causes as much, a wrong cable or range far more."""
MIN_SERIES, MIN_GAINS = 5, 8
"""Other load series, and gains in them, from which their scatter is known: the two that a wrong series spoils with it
are then no majority."""
MAX_GAIN_SIGMA = 0.1
"""Noise over signal up to which a gain counts: above it the gain is uncertain."""


def gain_scatter(points: CalibrationPoints, fit: CalibrationModelFit) -> Mapping[int, float]:
    """Robust scatter of the gains of the other load series, beyond their noise, for each series; 0 with too few."""
    used = points.weight > 0
    noise = robust_sigma(fit.cross_validation_errors[used])
    gains = {
        name: _gains(points.channels[rows], fit.cross_validation_errors[rows], noise)
        for name in np.unique(points.load_series[used]).tolist()
        if (rows := (points.load_series == name) & used).any()
    }
    return {name: _scatter([each for other, each in gains.items() if other != name]) for name in gains}


def least_gain_errors(
    points: CalibrationPoints, fit: CalibrationModelFit, rows: NDArray[np.bool_], predicted: Array
) -> Array:
    """Gain errors (c,) in some rows below which a channel is not suspected, for its predicted change (r, c).

    A weight and its line of action may change a channel by MIN_GAIN_ERROR of its response to the load that it feels
    most. Of the small change that an interaction makes, or two loads that cancel, this is a larger part.
    """
    response = np.max(np.abs(fit.model.coefficients[: len(points.components)]), axis=0)
    usual = MIN_GAIN_ERROR * response * np.max(np.ptp(points.loads[rows] / fit.model.calibrated_range, axis=0))
    change = np.ptp(predicted, axis=0)
    return np.asarray(np.maximum(MIN_GAIN_ERROR, usual / np.maximum(change, np.maximum(usual, np.finfo(float).tiny))))


def _gains(channels: Array, errors: Array, noise: Array) -> Array:
    """Errors of the gains, and their noise, (g, 2), of the channels (r, c) of a load series that have a signal."""
    change = channels - channels.mean(axis=0)
    predicted = change - (errors - errors.mean(axis=0))
    power = np.maximum(np.sum(predicted**2, axis=0), np.finfo(float).tiny)
    gains = np.column_stack([np.sum(predicted * change, axis=0) / power - 1.0, noise / np.sqrt(power)])
    # The misfit of a model follows the load, and does not average out over the rows.
    size = noise / np.sqrt(power / len(change))
    return np.asarray(gains[np.isfinite(gains).all(axis=1) & (size < MAX_GAIN_SIGMA)])


def _scatter(gains: list[Array]) -> float:
    known = [each for each in gains if len(each)]
    if len(known) < MIN_SERIES or sum(map(len, known)) < MIN_GAINS:
        return 0.0
    error, noise = np.vstack(known).T
    return float(np.sqrt(max(robust_sigma(error[:, None])[0] ** 2 - np.median(noise) ** 2, 0.0)))
