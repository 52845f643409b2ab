"""Equations of the zeros of load series in several attitudes: natural zeros and the weight of the metric part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints
from balance_cli.calibration.tare_result import weight_loads
from balance_cli.campaign.rig.attitude import ATTITUDE_TOLERANCE
from balance_cli.campaign.rig.components import COMPONENTS

Array = NDArray[np.float64]

MIN_DIRECTION_SPREAD = 0.01
"""Distance of the third direction of gravity (unit vectors) from the line through two others: about 0.6 deg."""
MISFIT_P_VALUE = 1e-3
"""P-value of chi-square below which the standard errors are widened."""


@dataclass(frozen=True)
class ZeroEquations:
    """The zeros (c, s) [V] of load series in a constant attitude, with what decides how the weight changes them.

    `gravity` (s, 3); `on_plate` (c, k): response to loads on the plate, `beside_shaft` (c, k) its difference from that
    to hub loads; `covariance` (c, s, s) of the zeros of each channel, `residual` (c, c) of the channels' residuals.
    """

    zeros: Array
    gravity: Array
    components: tuple[str, ...]
    on_plate: Array
    beside_shaft: Array | None
    covariance: Array
    residual: Array

    def whitened(self, gravity: Array) -> Array | None:
        """Equations (c s, c + 5) of unit noise for N, w and, last, the zeros, with these directions of gravity (s, 3).

        None where there is no noise. Zeros of two channels are correlated as their residuals are.
        """
        c, s = self.zeros.shape
        sigma = np.sqrt(np.diag(self.residual))
        if np.any(sigma == 0):
            return None
        effect = np.einsum("ck,skw->csw", self.on_plate, weight_loads(gravity, self.components))
        natural = np.repeat(np.eye(c)[:, None], s, axis=1)
        table = np.concatenate([natural, effect, self.zeros[:, :, None]], axis=2)
        within_channels = [
            linalg.solve_triangular(np.linalg.cholesky(K), rows, lower=True)
            for K, rows in zip(self.covariance, table, strict=True)
        ]
        root = np.linalg.cholesky(self.residual / (sigma[:, None] * sigma))
        white = linalg.solve_triangular(root, np.reshape(within_channels, (c, -1)), lower=True)
        return np.asarray(white.reshape(c * s, -1))


def zero_equations(points: CalibrationPoints, fit: CalibrationModelFit) -> ZeroEquations | None:
    """Return the equations of the zeros of a fit.

    None where a run does not state its attitude, a component is no hub load, or there are not three directions of
    gravity out of line.
    """
    if points.gravity is None or not np.isfinite(points.gravity).all() or not set(points.components) <= set(COMPONENTS):
        return None
    gravity, is_constant = _series_gravity(points, np.asarray(np.isfinite(fit.residuals).all(axis=1)))
    if np.count_nonzero(is_constant) == 0 or not _directions_suffice(gravity[is_constant]):
        return None
    C = fit.model.coefficients[: len(points.components)].T / fit.model.calibrated_range
    beside = None if points.plate_response is None else np.nan_to_num(points.plate_response - C)
    return ZeroEquations(
        zeros=fit.model.zeros[is_constant].T,
        gravity=gravity[is_constant],
        components=points.components,
        on_plate=C if beside is None else C + beside,
        beside_shaft=beside,
        covariance=fit.zero_covariance[:, is_constant][:, :, is_constant],
        residual=fit.model.residual_covariance,
    )


def segment_mean_gravity(points: CalibrationPoints) -> Array:
    """Direction of gravity (m, 3) of each row, averaged over its segment of constant attitude."""
    assert points.gravity is not None
    segment = points.attitude_segment
    sums = np.zeros((segment[-1] + 1, 3))
    np.add.at(sums, segment, points.gravity)
    return np.asarray((sums / np.bincount(segment)[:, None])[segment])


def _series_gravity(points: CalibrationPoints, used: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
    """Direction of gravity (s, 3) of each load series with rows that were used (m,), and whether it was constant."""
    assert points.gravity is not None
    load_series, means = points.load_series, segment_mean_gravity(points)
    names = np.unique(load_series[used])
    deviation = np.linalg.norm(points.gravity - means, axis=1)
    is_constant = np.array([deviation[(load_series == name) & used].max() <= ATTITUDE_TOLERANCE for name in names])
    return np.array([means[np.argmax(load_series == name)] for name in names]), is_constant


def _directions_suffice(gravity: Array) -> bool:
    """Whether there are at least three directions (s, 3) that do not lie on a line."""
    difference = gravity - gravity[0]
    longest = difference[np.argmax(np.linalg.norm(difference, axis=1))]
    length = np.linalg.norm(longest)
    if length < MIN_DIRECTION_SPREAD:
        return False
    return bool(np.max(np.linalg.norm(np.cross(difference, longest / length), axis=1)) >= MIN_DIRECTION_SPREAD)
