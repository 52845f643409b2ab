"""What seems to be wrong with a row: loads of another row, one load, or one reading."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.io.units import NUMBER, RATIO

Array = NDArray[np.float64]

MAX_LEFT_SHARE = 0.15
"""Share of an error that an explanation may leave, as amplitude: noise and curvature near the noise remain."""
MAX_LEFT_SIGMA = 5.0
"""Residual standard deviations that an explanation may leave in any case."""
SAME_SIZE = 0.05
"""Relative difference of two sizes that count as equal, so that a reversed sign is told from another value."""
MIN_OTHER_LOAD = 0.02
"""Share of the calibrated range by which two loads must differ to be exchanged."""


def exchanged_rows(points: CalibrationPoints, fit: CalibrationModelFit, excluded: NDArray[np.bool_]) -> dict[int, int]:
    """Pairs of excluded rows of one run that read each other's loads: each row with its partner."""
    fitted = np.unique(points.load_series[np.isfinite(fit.residuals).all(axis=1)])
    rows = [row for row in np.flatnonzero(excluded).tolist() if points.load_series[row] in fitted]
    sigma = np.sqrt(np.diag(fit.model.residual_covariance))
    predicted = {row: fit.model.readings(points.loads[row][None])[0] for row in rows}
    change = {
        row: points.channels[row] - fit.model.zeros[np.searchsorted(fitted, points.load_series[row])] for row in rows
    }
    partner: dict[int, int] = {}
    for i in rows:
        for j in rows:
            if j <= i or points.run[i] != points.run[j] or i in partner or j in partner:
                continue
            if np.max(np.abs(points.x[i] - points.x[j])) < MIN_OTHER_LOAD:
                continue
            pairs = ((change[i], predicted[i], predicted[j]), (change[j], predicted[j], predicted[i]))
            if all(_explains(reading - other, reading - own, sigma) for reading, own, other in pairs):
                partner |= {i: j, j: i}
    return partner


def _explains(left: Array, error: Array, sigma: Array) -> bool:
    """Whether what an explanation leaves (c,) of an error (c,) is little, against the error and the noise."""
    size = float(np.sqrt(np.mean((error / sigma) ** 2)))
    return bool(np.sqrt(np.mean((left / sigma) ** 2)) <= max(MAX_LEFT_SHARE * size, min(MAX_LEFT_SIGMA, 0.5 * size)))


def likely_cause(model: CalibrationModel, points: CalibrationPoints, row: int, error: Array) -> str | None:
    """What single mistake would explain the error (c,) [V] of a row, in words; None where no single one would."""
    causes = [*_load_causes(model, points.loads[row], error), *_reading_causes(model, points, row, error)]
    return " or ".join(causes[:2]) or None


def _load_causes(model: CalibrationModel, loads: Array, error: Array) -> list[str]:
    sigma = np.sqrt(np.diag(model.residual_covariance))
    J = model.jacobian(loads[None])[0] / sigma[:, None]
    causes = []
    reversed_error = model.readings(-loads[None])[0] - model.readings(loads[None])[0]
    if np.count_nonzero(np.abs(loads) > MIN_OTHER_LOAD * model.calibrated_range) > 1 and _explains(
        error - reversed_error, error, sigma
    ):
        causes.append("the signs of all its loads seem to be reversed")
    for j, name in enumerate(model.components):
        step = float(J[:, j] @ (error / sigma) / (J[:, j] @ J[:, j]))
        if not _explains(error - J[:, j] * sigma * step, error, sigma):
            continue
        value = loads[j] + step * model.calibrated_range[j]
        reversed_sign = abs(value + loads[j]) <= SAME_SIZE * abs(loads[j])
        causes.append(f"{name} seems to be {value:.4g}, not {loads[j]:.4g}{' (its sign)' if reversed_sign else ''}")
    return causes


def _reading_causes(model: CalibrationModel, points: CalibrationPoints, row: int, error: Array) -> list[str]:
    sigma = np.sqrt(np.diag(model.residual_covariance))
    c = int(np.argmax(np.abs(error) / sigma))
    rest = np.delete(error / sigma, c)
    if len(rest) and np.max(np.abs(rest)) > max(MAX_LEFT_SIGMA, MAX_LEFT_SHARE * abs(error[c]) / sigma[c]):
        return []
    reading = points.channels[row, c]
    unit = points.reading_unit(c)
    factor, symbol = (1e3, f"m{unit}") if unit == RATIO else (1.0, "" if unit == NUMBER else unit)
    right, wrong = (f"{factor * value:.5g} {symbol}".strip() for value in (reading - error[c], reading))
    return [f"{model.channel_names[c]} seems to read {right}, not {wrong}"]
