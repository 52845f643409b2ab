"""Loads as functions of the readings, without iteration: the direct model of balance practice.

With more channels than loads the readings say the same several times over; so the first loads y = W (r - zero), in
units of full range, stand for them, W C1 = 1 as in the gage model. The loads are

    x = y + sum_t b_t h_t(y),

the terms h chosen and fitted as those of a channel are, with the loads in the place of the readings. It is quicker, and
needs no proof; it is worse than the iteration where readings are noisy, for terms of noisy y are biased.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from balance_cli.calibration.fit import CalibrationPoints, fit_calibration_model
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.terms import columns

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NonIterativeModel:
    """`inverse` W (k, c) [1/V], and the model of the loads over full range as functions of y: its `channels` are loads.

    `full_range` (k,) [N, N m].
    """

    inverse: Array
    model: CalibrationModel
    full_range: Array

    @property
    def residual_percent_fs(self) -> Array:
        """Standard deviation (k,) of the loads about the model, percent of full range."""
        return np.asarray(100.0 * np.sqrt(np.diag(self.model.residual_covariance)))

    def loads(self, change: ArrayLike) -> Array:
        """Loads (m, k) [N, N m] of readings (m, c) [V] beyond the zero."""
        y = np.atleast_2d(np.asarray(change, float)) @ self.inverse.T
        return np.asarray(columns(self.model.parsed_terms, y) @ self.model.coefficients * self.full_range)


def fit_noniterative_model(
    points: CalibrationPoints, gage: CalibrationModel, used: NDArray[np.bool_], search: bool = True
) -> NonIterativeModel:
    """Fit it to the rows `used` (m,) of the gage model `gage`, readings counted from the zeros found there."""
    W = gage.inverse()
    sequence = points.sequence
    kept = np.unique(sequence[used])
    # Rows of a sequence that took no part have no zero, and no weight.
    place = np.clip(np.searchsorted(kept, sequence), 0, len(kept) - 1)
    y = (points.channels - gage.zeros[place]) @ W.T
    first = CalibrationPoints(
        channel_names=points.components,
        components=points.components,
        run_names=points.run_names,
        channels=points.x,
        loads=y,
        run=points.run,
        weight=np.where(used, points.weight, 0.0),
        full_range=np.ones(len(points.components)),
        gravity=points.gravity,
    )
    return NonIterativeModel(W, fit_calibration_model(first, search, points.x).model, points.full_range)
