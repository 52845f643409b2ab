"""Hub loads from channel amplitudes: least squares weighted by noise, with the error of the response in sigma.

For each harmonic y = T f + e with covariance C_noise + C_T(f). The weights come from the noise alone. C_T grows with
the loads at which it is evaluated, so that a wrong response would set its own weights: with the computed model of the
sample balance, whose tolerances shift resonances by several half-widths, such a scheme diverges. Where the noise of the
channels is known by itself, it also replaces the noise of the record at the harmonic. The latter contains fluctuating
loads as the true response transmits them; a direction in which a slightly wrong response leaves a residual would then
count as free of noise and get all the weight (signal cancellation; Cox, J. Acoust. Soc. Am. 54, 1973, 771). Sigma and
the residual test use the full covariance. More channels than loads leave redundant equations; wind-on, where the true
loads are unknown, their residual test is the only evidence that the response still holds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals import distributions as stats
from balance_cli.signals.covariance_pooling import inverse_bias_factor

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

REDUNDANCY_CONFIDENCE = 0.999
"""Confidence of the residual test, fixed by the file contract: noise alone exceeds the limit once in a thousand."""
DOF_PER_REDUNDANT_EQUATION = 2.0
"""Degrees of freedom of the noise for each redundant equation, below which only its size in all of them is used.

The inverse of a covariance that is estimated with fewer is dominated by its smallest eigenvalues, and does not exist
below one (Ledoit and Wolf, J. Multivariate Analysis 88, 2004, 365).
"""


@dataclass(frozen=True)
class LoadEquations:
    """Readings (h, a) = T (h, a, b) times loads, their covariance (h, a, a), and the estimator G (h, b, a)."""

    T: Array
    readings: Array
    covariance: Array
    estimator: Array

    @cached_property
    def redundant(self) -> Array:
        """The directions of the readings that no load reaches, which several tests need."""
        return redundant_directions(self.T)


@dataclass(frozen=True)
class SolvedLoads:
    """Complex loads (h, m) of m components at h harmonics.

    covariance (h, 2m, 2m) of [Re, Im], not inflated; model_covariance the same from what the response is known to
    miss; noise_covariance the same from the noise of the record alone, as if the response were exact; redundancy_chi2
    (h,) chi-square per degree of freedom of the residual test; degrees (h,) of freedom; limit (h,) its 99.9 % point;
    condition (h,); equations that they solve.
    """

    loads: ComplexArray
    covariance: Array
    model_covariance: Array
    noise_covariance: Array
    redundancy_chi2: Array
    degrees: Array
    limit: Array
    condition: Array
    equations: LoadEquations

    @property
    def misfit(self) -> NDArray[np.bool_]:
        """Harmonics (h,) at which the residual test rejects the response."""
        return np.asarray(self.redundancy_chi2 > self.limit)

    @property
    def inflated_covariance(self) -> Array:
        """The covariance with the known error of the response.

        Where the residual test rejects the response, the covariance is multiplied by its chi-square as far as the
        known error does not explain that already.
        """
        factor = np.where(self.misfit, self.redundancy_chi2, 1.0)[:, None, None]
        inflated = self.covariance * factor
        explained = np.trace(self.model_covariance, axis1=1, axis2=2) > np.trace(inflated, axis1=1, axis2=2)
        return np.asarray(np.where(explained[:, None, None], self.covariance, inflated) + self.model_covariance)


def solve_loads(
    T: Array,
    y: Array,
    noise: Array,
    dof: Array,
    response_covariance: Callable[[Array], Array],
    scale: Array,
    weighting_covariance: Array | None = None,
    known_error: Callable[[Array], Array] | None = None,
) -> SolvedLoads:
    """Solve h systems at once in real form (`response_sources.stacked_real`).

    T (h, a, b), y (h, a), noise (h, a, a) estimated with `dof` (h,) complex degrees of freedom; `response_covariance`
    returns the covariance (h, a, a) of T f for loads (h, b); `scale` (b,) times the loads makes these comparable, for
    the condition. `weighting_covariance` (h, a, a) gives the weights, up to a factor, where the noise of the channels
    is known by itself; by default the weights come from `noise`. `known_error` returns the covariance (h, a, a) of
    what the response is known to miss of T f; it enters the errors of the loads, not the residual test, which is to
    find it.
    """
    a, b = T.shape[1:]
    few, N = dof < DOF_PER_REDUNDANT_EQUATION * (a - b) / 2, redundant_directions(T)
    scaled, directions = _scaled_shape(N, noise, weighting_covariance)
    tested_noise = np.where(few[:, None, None], scaled, noise)
    G, noise_covariance = weighted_inverse(T, tested_noise if weighting_covariance is None else weighting_covariance)
    # Weights that are not the inverse of the noise's covariance: the errors of the loads are those of the noise itself.
    propagated = few | (weighting_covariance is not None)
    factor = _estimated_weights_factor(np.where(propagated, np.inf, dof), a - b)[:, None, None]
    noise_covariance = np.where(propagated[:, None, None], _propagate(G, noise), noise_covariance * factor)
    noise_covariance *= stats.student_widening(2.0 * dof)[:, None, None]
    loads = np.einsum("hba,ha->hb", G, y)
    response_error = response_covariance(loads)
    total = tested_noise + response_error
    covariance = noise_covariance + G @ response_error @ np.swapaxes(G, 1, 2)
    equations = LoadEquations(T, y, total, G)
    chi2 = residual_chi2(equations.redundant, y[:, :, None], total)[:, 0]
    share, degrees = _noise_share(equations.redundant, tested_noise, total), np.full(len(T), float(a - b))
    bias, limit = _residual_test_limit(share, dof, a - b, np.where(few, directions, np.inf))
    per_degree = np.where(degrees > 0, chi2 * bias / np.maximum(degrees, 1.0), np.nan)
    return SolvedLoads(
        loads=loads[:, : b // 2] + 1j * loads[:, b // 2 :],
        covariance=covariance,
        model_covariance=_propagate(G, known_error(loads)) if known_error else np.zeros_like(covariance),
        noise_covariance=noise_covariance,
        redundancy_chi2=per_degree,
        degrees=degrees,
        limit=limit,
        condition=_condition(T, noise, scale),
        equations=equations,
    )


def weighted_inverse(T: Array, covariance: Array) -> tuple[Array, Array]:
    """Return G = (T' C^-1 T)^-1 T' C^-1 and the covariance (T' C^-1 T)^-1 of G y."""
    weighted = np.linalg.solve(covariance, T)
    inverse = np.linalg.inv(np.swapaxes(T, 1, 2) @ weighted)
    return np.asarray(inverse @ np.swapaxes(weighted, 1, 2)), np.asarray(inverse)


def _propagate(G: Array, covariance: Array) -> Array:
    """Return the covariance (h, b, b) of the loads from that of the channels (h, a, a)."""
    return np.asarray(G @ covariance @ np.swapaxes(G, 1, 2))


def residual_chi2(N: Array, readings: Array, total: Array) -> Array:
    """Return the least chi-square (h, s) that any loads leave of s readings (h, a, s), by their covariance `total`.

    It is that of the `redundant_directions` N. A covariance from fewer lines than channels is singular, and regular in
    these directions alone.
    """
    residual = N @ readings
    covariance = N @ total @ np.swapaxes(N, 1, 2)
    return np.asarray(np.einsum("has,has->hs", residual, np.linalg.solve(covariance, residual)))


def redundant_directions(T: Array) -> Array:
    """Return the orthonormal rows N (h, a - b, a) with N T = 0."""
    return np.asarray(np.swapaxes(np.linalg.qr(T, mode="complete").Q[:, :, T.shape[2] :], 1, 2))


def _scaled_shape(N: Array, noise: Array, known: Array | None) -> tuple[Array, Array]:
    """Return the noise (h, a, a) of the channels scaled to that in the redundant directions N, and their number.

    It is the `known` covariance (h, a, a), or has the variances of `noise` where there is none.

    Loads that fluctuate do not reach these directions, so that they hold the noise of the channels alone. The number
    (h,) of complex directions counts those with less noise than others in part (Satterthwaite, Biometrics Bull. 2,
    1946, 110); an estimate from few lines is too low, which widens the limit of the test.
    """
    shape = noise * np.eye(noise.shape[1]) if known is None else known
    noise_there, shape_there = (N @ part @ np.swapaxes(N, 1, 2) for part in (noise, shape))
    ratio = np.linalg.solve(shape_there, noise_there)
    total = np.trace(ratio, axis1=1, axis2=2)
    square = np.einsum("hij,hji->h", ratio, ratio)
    scale = np.maximum(total / max(N.shape[1], 1), np.finfo(float).tiny)
    directions = np.maximum(0.5 * total**2 / np.maximum(square, np.finfo(float).tiny), 1.0)
    return np.asarray(scale[:, None, None] * shape), np.asarray(directions)


def _noise_share(N: Array, noise: Array, total: Array) -> Array:
    """Return the share (h,) of the noise in the covariance `total` of the redundant directions N."""
    noise, total = (N @ part @ np.swapaxes(N, 1, 2) for part in (noise, total))
    return np.asarray(np.trace(np.linalg.solve(total, noise), axis1=1, axis2=2) / max(N.shape[1], 1))


def _estimated_weights_factor(dof: Array, degrees: int) -> Array:
    """Return the factor (h,) on the covariance of an estimate whose weights have `dof` complex degrees of freedom.

    With q redundant complex equations (T' C^-1 T)^-1 is too small by (dof - q) / dof, and the estimate scatters more
    than with the true weights by dof / (dof - q) (Rao, Proc. 5th Berkeley Symposium 1, 1967).
    """
    share = np.array([inverse_bias_factor(float(d), degrees // 2) for d in dof])
    return np.asarray(1.0 / share**2)


def _residual_test_limit(share: Array, dof: Array, degrees: int, directions: Array) -> tuple[Array, Array]:
    """Return the factor that removes the bias of the residual chi-square, and its 99.9 % point per degree of freedom.

    With noise alone, estimated with dof complex degrees of freedom, q redundant complex equations follow Hotelling's
    distribution: chi2 (dof - q + 1) / (2 q dof) is F with 2 q and 2 (dof - q + 1) degrees of freedom. Both corrections
    apply in proportion to the `share` of the noise in the covariance. Where only the size of the noise in so many
    `directions` (h,) was estimated (infinite elsewhere), they count as one equation of as many real degrees of freedom.
    """
    if degrees <= 0:
        return np.ones_like(share), np.full_like(share, np.inf)
    is_size = np.isfinite(directions)
    q, known = np.where(is_size, 1, degrees // 2), np.isinf(dof)
    dof = dof * np.where(is_size, directions, 1.0)
    unbiased = np.array([inverse_bias_factor(float(d), int(n)) for d, n in zip(dof, q, strict=True)])
    # The bounds keep the quotient finite where the covariance holds no noise.
    second = np.minimum(2.0 * (dof - q + 1.0) / np.maximum(share, 1e-9), 1e9)
    first = np.where(is_size, np.minimum(2.0 * directions, degrees), degrees)
    limit = stats.f.ppf(REDUNDANCY_CONFIDENCE, first, second)
    hotelling = np.where(known, 1.0, (dof - q) / np.where(known, 1.0, dof - q + 1.0))
    return 1.0 - share * (1.0 - unbiased), np.asarray(limit * (1.0 - share * (1.0 - hotelling)))


def _condition(T: Array, noise: Array, scale: Array) -> Array:
    """Return the condition (h,) of T with every channel in units of its noise and every load in units of force."""
    sigma = np.sqrt(np.diagonal(noise, axis1=1, axis2=2))
    singular = np.linalg.svd(T / sigma[:, :, None] / scale, compute_uv=False)
    return np.asarray(singular[:, 0] / singular[:, -1])
