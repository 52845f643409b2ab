"""Natural zeros and weight of the metric part, from the zeros of load series in several attitudes.

The applied loads do not include the weight of the metric part. In attitude a each channel of the
unloaded balance reads

    zero(a) = N + C T(a) w,    w = (W, W r),

with the natural zeros N, the linear part C of the model, and the weight W [N] of the metric part at r [m] from the hub.
T(a) w is the force W g(a) and the moment (W r) x g(a) about the hub, with the direction of gravity g(a). N and w follow
from the zeros by generalized least squares; the zeros share the errors of the coefficients. The moment of the weight
about a shaft with a torque meter acts on the plate: there C is the response to that.

Nonlinear terms depend on the total load. The fit is therefore repeated with the weight added to the applied loads until
w converges; the zeros of each new fit determine a correction of w.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.attitude_contradiction import describe_contradiction
from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints
from balance_cli.calibration.outliers import ScreenedFit, screen_outliers
from balance_cli.calibration.tare_result import Tares
from balance_cli.calibration.term_choice import TermChoice
from balance_cli.calibration.zero_equations import (
    MISFIT_P_VALUE,
    ZeroEquations,
    segment_mean_gravity,
    zero_equations,
)
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]

TARE_ITERATIONS = 3
"""Upper bound on the repeated fits. Each reduces the error of w by the nonlinearity of the readings, a few per cent."""
TARE_TOLERANCE = 0.01
"""Change of w, in standard errors, below which it has converged."""
MIN_SINGULAR_RATIO = 1e-8
"""Least over largest singular value of the scaled equations below which they do not determine w: half the digits."""


def screen_outliers_with_tares(
    points: CalibrationPoints, choice: TermChoice
) -> tuple[CalibrationPoints, ScreenedFit, Tares | None]:
    """Screen outliers with the weight of the metric part added to the applied loads.

    Returns the points with these loads, their screened fit, and the tares; the given points and None where the
    attitudes do not determine the weight.
    """
    screened = screen_outliers(points, choice)
    tares, total = estimate_tares(points, screened.fit), points
    if tares is not None and describe_contradiction(points, screened.fit):
        return points, screened, None
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
    """Add the weight of the metric part, in the attitude of each segment, to the applied loads.

    What it makes the channels read beyond these loads is taken off them.
    """
    gravity = segment_mean_gravity(points)
    loads = points.loads + tares.loads(gravity, points.components)
    channels = points.channels - tares.readings_beside_shaft(gravity, points.components)
    return replace(points, loads=loads, channels=channels, series=points.load_series)


def estimate_tares(
    points: CalibrationPoints, fit: CalibrationModelFit, added_weight: Array | None = None
) -> Tares | None:
    """Estimate the tares from the zeros of a fit to loads that already include `added_weight` (4,), none by default.

    None where the zeros do not determine them.
    """
    equations = zero_equations(points, fit)
    solved = None if equations is None else _solve_tares(equations)
    if equations is None or solved is None:
        return None
    return replace(_tares_from_solution(*solved, added_weight), beside_shaft=equations.beside_shaft)


def _solve_tares(equations: ZeroEquations) -> tuple[Array, Array, float, int] | None:
    """Solve the equations by generalized least squares.

    Returns N and w (c + 4,), their covariance, chi-square and the number of load series; None where the equations do
    not determine them, or there is no noise.
    """
    white = equations.whitened(equations.gravity)
    if white is None:
        return None
    c, s = equations.zeros.shape
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
