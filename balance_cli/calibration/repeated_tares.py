"""Repeated unloaded rows, which tell the noise of a row but nothing of what a calibration lacks at its loads.

Unloaded rows of one zero differ by noise alone (pure error), whatever the model; its lack of fit is in the loaded rows
(Draper and Smith, Applied Regression Analysis, 1998, section 2.1). Both together are less than the error of a load, and
the unloaded rows are no degrees of freedom of it: of 6 rows for 4 coefficients, two of them unloaded, one is left.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.load_series import MIN_LOAD_CHANGE
from balance_cli.calibration.math_model import CalibrationModel

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def repeated_tares(x: Array) -> NDArray[np.bool_]:
    """Unloaded rows (m,) of loads x (m, k) in units of their range, if there are several."""
    unloaded = np.asarray(np.all(np.abs(x) <= MIN_LOAD_CHANGE, axis=1))
    return unloaded if np.count_nonzero(unloaded) > 1 else np.zeros(len(x), bool)


def lack_of_fit_variance(residuals: Array, weight: Array, x: Array, block: Index, dof: Array) -> tuple[Array, Array]:
    """Growth (c,) of the variances of residuals (m, c) to those without repeated unloaded rows, and their dof (c,).

    `block` (m,): zero of each row; `dof` (c,) of all rows. Where the unloaded rows scatter as much, both are kept.
    """
    tare = repeated_tares(x)
    _, zero = np.unique(block[tare], return_inverse=True)
    repeats = len(zero) - (int(zero.max()) + 1 if len(zero) else 0)
    rest = dof - repeats
    if repeats == 0 or np.min(rest) < 1.0:
        return np.ones(len(dof)), dof
    w, e = weight[tare], residuals[tare]
    mean = np.eye(int(zero.max()) + 1)[:, zero] @ (w[:, None] * e) / np.bincount(zero, w)[:, None]
    squares = np.maximum(weight @ residuals**2, np.finfo(float).tiny)
    growth = (squares - w @ (e - mean[zero]) ** 2) / rest / (squares / dof)
    return np.maximum(growth, 1.0), np.where(growth > 1.0, rest, dof)


def lack_of_fit_model(
    model: CalibrationModel, residuals: Array, weight: Array, x: Array, load_series: Index
) -> tuple[CalibrationModel, Array]:
    """The model with its covariances by the rows that show a lack of fit, and the growth (c,) of the variances."""
    growth, dof = lack_of_fit_variance(residuals, weight, x, load_series, model.dof)
    root = np.sqrt(growth)
    model = replace(
        model,
        residual_covariance=model.residual_covariance * root[:, None] * root,
        covariance=model.covariance * growth[:, None, None],
        zero_sigma=model.zero_sigma * root,
        dof=dof,
    )
    return model, growth
