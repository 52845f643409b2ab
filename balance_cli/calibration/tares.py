"""Natural zeros and weight of the metric part, from the zeros of load series in several attitudes.

The applied loads do not include the weight of the metric part. In attitude a each channel of the
unloaded balance reads

    zero(a) = N + C T(a) w,    w = (W, W r),

with the natural zeros N, the linear part C of the model, and the weight W [N] of the metric part at r [m] from the hub.
T(a) w is the force W g(a) and the moment (W r) x g(a) about the hub, with the direction of gravity g(a). N and w follow
from the zeros by generalized least squares; the zeros share the errors of the coefficients.

Nonlinear terms depend on the total load. The fit is therefore repeated with the weight added to the applied loads until
w converges; the zeros of each new fit determine a correction of w.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints
from balance_cli.calibration.outliers import ScreenedFit, screen_outliers
from balance_cli.calibration.tare_result import Tares, weight_loads
from balance_cli.calibration.term_choice import TermChoice
from balance_cli.campaign.rig.attitude import ATTITUDE_TOLERANCE, is_one_direction
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]
Index = NDArray[np.intp]

TARE_ITERATIONS = 3
"""Upper bound on the repeated fits. Each reduces the error of w by the nonlinearity of the readings, a few per cent."""
TARE_TOLERANCE = 0.01
"""Change of w, in standard errors, below which it has converged."""
MIN_DIRECTION_SPREAD = 0.01
"""Distance of the third direction of gravity (unit vectors) from the line through two others: about 0.6 deg."""
MIN_SINGULAR_RATIO = 1e-8
"""Least over largest singular value of the scaled equations below which they do not determine w: half the digits."""
MISFIT_P_VALUE = 1e-3
"""P-value of chi-square below which the standard errors are widened."""


def screen_outliers_with_tares(
    points: CalibrationPoints, choice: TermChoice
) -> tuple[CalibrationPoints, ScreenedFit, Tares | None]:
    """Screen outliers with the weight of the metric part added to the applied loads.

    Returns the points with these loads, their screened fit, and the tares; the given points and None where the
    attitudes do not determine the weight.
    """
    screened = screen_outliers(points, choice)
    tares, total = estimate_tares(points, screened.fit), points
    for _ in range(TARE_ITERATIONS if tares is not None else 0):
        assert tares is not None
        total = add_weight_loads(points, tares)
        screened = screen_outliers(total, choice)
        updated = estimate_tares(total, screened.fit, tares.w)
        if updated is None:
            break
        change, tares = np.abs(updated.w - tares.w), updated
        if np.all(change <= TARE_TOLERANCE * np.sqrt(np.diag(tares.w_covariance))):
            break
    return total, screened, tares


def add_weight_loads(points: CalibrationPoints, tares: Tares) -> CalibrationPoints:
    """Add the weight of the metric part, in the attitude of each segment, to the applied loads."""
    assert points.gravity is not None
    loads = points.loads + tares.loads(segment_mean_gravity(points), points.components)
    return replace(points, loads=loads, series=points.load_series)


def segment_mean_gravity(points: CalibrationPoints) -> Array:
    """Direction of gravity (m, 3) of each row, averaged over its segment of constant attitude."""
    assert points.gravity is not None
    segment = points.attitude_segment
    sums = np.zeros((segment[-1] + 1, 3))
    np.add.at(sums, segment, points.gravity)
    return np.asarray((sums / np.bincount(segment)[:, None])[segment])


def estimate_tares(
    points: CalibrationPoints, fit: CalibrationModelFit, added_weight: Array | None = None
) -> Tares | None:
    """Estimate the tares from the zeros of a fit to loads that already include `added_weight` (4,), none by default.

    None where a run does not state its attitude, a component is no hub load, or there are not three directions of
    gravity out of line.
    """
    if points.gravity is None or not np.isfinite(points.gravity).all() or not set(points.components) <= set(COMPONENTS):
        return None
    gravity, is_constant = _series_gravity(points, np.asarray(np.isfinite(fit.residuals).all(axis=1)))
    if np.count_nonzero(is_constant) == 0 or not _directions_suffice(gravity[is_constant]):
        return None
    k = len(points.components)
    C = fit.model.coefficients[:k].T / fit.model.calibrated_range
    effect = np.einsum("ck,skw->csw", C, weight_loads(gravity[is_constant], points.components))
    covariance = fit.zero_covariance[:, is_constant][:, :, is_constant]
    solved = _solve_tares(effect, fit.model.zeros[is_constant].T, covariance, fit.model.residual_covariance)
    return None if solved is None else _tares_from_solution(*solved, added_weight)


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


def _solve_tares(
    effect: Array, zeros: Array, covariance: Array, residual: Array
) -> tuple[Array, Array, float, int] | None:
    """Solve zeros (c, s) = N + effect (c, s, 4) w by generalized least squares.

    `covariance` (c, s, s) is that of each channel's zeros. Zeros of two channels are correlated as their residuals are,
    of covariance `residual` (c, c). Returns N and w (c + 4,), their covariance, chi-square and the number of load
    series; None where the equations do not determine them, or there is no noise.
    """
    c, s, _ = effect.shape
    sigma = np.sqrt(np.diag(residual))
    if np.any(sigma == 0):
        return None
    natural = np.repeat(np.eye(c)[:, None], s, axis=1)
    table = np.concatenate([natural, effect, zeros[:, :, None]], axis=2)
    within_channels = [
        linalg.solve_triangular(np.linalg.cholesky(K), rows, lower=True)
        for K, rows in zip(covariance, table, strict=True)
    ]
    correlation_root = np.linalg.cholesky(residual / (sigma[:, None] * sigma))
    white = linalg.solve_triangular(correlation_root, np.reshape(within_channels, (c, -1)), lower=True).reshape(
        c * s, -1
    )
    X, y = white[:, :-1], white[:, -1]
    scale = np.linalg.norm(X, axis=0)
    # A balance without moments tells the weight, and not where it acts: those columns are zero.
    informed = scale > 0
    if not np.all(informed[: c + 1]) or len(y) < np.count_nonzero(informed):
        return None
    U, d, Vt = np.linalg.svd(X[:, informed] / scale[informed], full_matrices=False)
    if d[-1] < MIN_SINGULAR_RATIO * d[0]:
        return None
    root = np.zeros((len(scale), len(d)))
    root[informed] = Vt.T / d / scale[informed][:, None]
    solution = root @ (U.T @ y)
    return solution, root @ root.T, float(np.sum((y - X @ solution) ** 2)), s


def _tares_from_solution(
    solution: Array, covariance: Array, chi2: float, series_count: int, added_weight: Array | None
) -> Tares:
    """Tares from N and w (c + 4,), with the covariance widened by chi-square where that is significant."""
    c = len(solution) - 4
    dof = c * series_count - int(np.count_nonzero(np.diag(covariance) > 0))
    ratio = chi2 / dof if dof else float("nan")
    if dof and stats.chi2.sf(chi2, dof) < MISFIT_P_VALUE:
        covariance = covariance * ratio
    return Tares(
        w=solution[c:] + (0.0 if added_weight is None else added_weight),
        w_covariance=covariance[c:, c:],
        natural_zeros=solution[:c],
        natural_zeros_sigma=np.sqrt(np.diag(covariance)[:c]),
        chi2_per_dof=ratio,
        series_count=series_count,
    )


def undetermined_weight_notes(points: CalibrationPoints, tares: Tares | None) -> Iterator[str]:
    """Notes on why the weight of the metric part is not determined although runs state their attitude."""
    if points.gravity is None or tares is not None:
        return
    silent = np.unique(points.run[~np.isfinite(points.gravity).all(axis=1)])
    for run in silent:
        name = points.run_names[run]
        yield f"run {name} does not state its attitude: the weight of the metric part cannot be determined"
    if not len(silent) and not is_one_direction(points.gravity):
        why = "needs load series in three attitudes out of line, with hub loads as components"
        yield f"the weight of the metric part is not determined: it {why}; every attitude has a zero of its own"
