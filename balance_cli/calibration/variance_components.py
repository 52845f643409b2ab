"""Variances of groups of random coefficients and of the noise, by restricted maximum likelihood (REML).

Every channel c of a calibration reads y_c = F a_c + Z u_c + e_c. The coefficients u of the columns Z are not selected
but random, u_pc ~ N(0, g_c^2 t_f^2) with one relative size t_f for each family f of columns, which all channels share,
and e ~ N(0, s_c^2). The likelihood is that of the part of y that F does not explain (Patterson and Thompson, Biometrika
58, 1971, 545), so that the noise is not underestimated by the degrees of freedom of loads and zeros.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]

START_SIZE = 4e-3
"""Size of a random coefficient over the response of its channel at which the search begins: that of most balances."""
SIZE_LIMITS = (1e-6, 1.0)
"""Limits of that size: at the lower one no reading shows a column, at the upper one it is as large as the response."""
NOISE_FLOOR = 1e-14
"""Floor of the noise over the power of a channel: below it a residual is rounding."""
MAX_ITERATIONS = 60
"""Upper bound on the steps of the search, which ends after 10 to 30."""
MIN_SHARE = 1e-9
"""Singular value over the largest below which a direction of the columns is rounding."""


@dataclass(frozen=True)
class VarianceComponents:
    """Sizes (f,) of the families over `scale` (c,) of the channels, and the restricted log likelihood of all channels.

    `noise` (c,) [V]: standard deviation of a row of weight one.
    """

    size: Array
    scale: Array
    noise: Array
    log_likelihood: float


@dataclass(frozen=True)
class _Reduced:
    """Columns Z (r, p) and outputs y (r, c) in the span of Z, `rest` (c,): squares outside of it with `rest_dof`."""

    Z: Array
    y: Array
    rest: Array
    rest_dof: int
    membership: Array


def estimate_variance_components(
    fixed: Array, random: Array, family: Index, y: Array, scale: Array, rows_less_zeros: int
) -> VarianceComponents:
    """Estimate the size of each family and the noise of each output.

    `fixed` (m, k), `random` (m, p) and `y` (m, c): weighted rows less the means of their blocks; `family` (p,): number
    of the family of each random column; `scale` (c,): what the sizes refer to.
    """
    from scipy.optimize import minimize

    reduced = _reduce(fixed, random, family, y / scale, rows_less_zeros)
    families = reduced.membership.shape[1]
    power = (np.sum(reduced.y**2, axis=0) + reduced.rest) / rows_less_zeros
    floor = NOISE_FLOOR * np.mean((y / scale) ** 2, axis=0) + np.finfo(float).tiny
    noise = np.maximum(power, floor)
    start = np.r_[np.full(families, np.log(START_SIZE)), 0.5 * np.log(noise)]
    low, high = np.log(SIZE_LIMITS)
    of_noise = [(0.5 * np.log(f), 0.5 * np.log(4.0 * v)) for f, v in zip(floor, noise, strict=True)]
    bounds = [(low, high)] * families + of_noise
    best = minimize(
        _deviance, start, (reduced,), "L-BFGS-B", jac=True, bounds=bounds, options={"maxiter": MAX_ITERATIONS}
    )
    size, sigma = np.exp(best.x[:families]), np.exp(best.x[families:])
    log_scale = float(np.sum(np.log(scale))) * (rows_less_zeros - fixed.shape[1])
    size = np.where(size > 2.0 * SIZE_LIMITS[0], size, 0.0)
    return VarianceComponents(size, scale, sigma * scale, -float(best.fun) - log_scale)


def _reduce(fixed: Array, random: Array, family: Index, y: Array, rows_less_zeros: int) -> _Reduced:
    """Project the columns and the outputs on what the fixed columns do not explain, then on the span of the columns."""
    Q = np.linalg.qr(fixed)[0]
    Z, left = random - Q @ (Q.T @ random), y - Q @ (Q.T @ y)
    U, s, Vt = np.linalg.svd(Z, full_matrices=False)
    rank = int(np.count_nonzero(s > MIN_SHARE * s[0])) if s.size else 0
    inside = U[:, :rank].T @ left
    rest = np.maximum(np.sum(left**2, axis=0) - np.sum(inside**2, axis=0), 0.0)
    membership = np.eye(int(family.max()) + 1)[family]
    return _Reduced(s[:rank, None] * Vt[:rank], inside, rest, rows_less_zeros - fixed.shape[1] - rank, membership)


def _deviance(parameters: Array, reduced: _Reduced) -> tuple[float, Array]:
    """Half the restricted deviance, and its gradient, at the logarithms of the sizes (f,) and of the noises (c,).

    With the eigenvalues w and vectors W of Z diag(t^2) Z' all channels are diagonal at once.
    """
    families = reduced.membership.shape[1]
    t2, s2 = np.exp(2.0 * parameters[:families]), np.exp(2.0 * parameters[families:])
    w, W = np.linalg.eigh((reduced.Z * (reduced.membership @ t2)) @ reduced.Z.T)
    u = W.T @ reduced.y
    v = np.maximum(w, 0.0)[:, None] + s2
    value = 0.5 * float(np.sum(np.log(v) + u**2 / v) + np.sum(reduced.rest_dof * np.log(s2) + reduced.rest / s2))
    along = reduced.Z.T @ W
    trace = (reduced.membership.T @ along**2) @ (1.0 / v)
    explained = reduced.membership.T @ (along @ (u / v)) ** 2
    by_size = np.sum(trace - explained, axis=1) * t2
    by_noise = (np.sum(1.0 / v - (u / v) ** 2, axis=0) + reduced.rest_dof / s2 - reduced.rest / s2**2) * s2
    return value, np.r_[by_size, by_noise]
