"""Hub loads from channel amplitudes: least squares weighted by noise, with the error of the response carried along.

For each harmonic y = T f + e with covariance C_noise + C_T(f). The estimate weighs by the noise alone: C_T grows with
the loads that it is evaluated at, and a response that is wrong would choose its own weights (with the computed model
of the sample balance, whose tolerances shift resonances by several half-widths, such a scheme diverges). Nor is it the
noise of the record at the harmonic where that of the channels is known apart: the record's holds loads that fluctuate,
through the true response, and what a response that is slightly wrong leaves beside them would count as free of noise
and get all the weight (signal cancellation; Cox, J. Acoust. Soc. Am. 54, 1973, 771). Sigma and the test of the surplus
take all of it. More channels than loads leave that surplus: wind-on nobody knows the true loads, and it is the only
evidence that the response still holds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from balance_cli.signals.covariance_pooling import inverse_bias_factor

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# The chi-square of the surplus is exceeded by chance once in a thousand (contract, `redundancy`).
REDUNDANCY_CONFIDENCE = 0.999


@dataclass(frozen=True)
class SolvedLoads:
    """Loads (h, m) complex of the m components asked for, at h harmonics.

    covariance (h, 2m, 2m) of [Re, Im], not yet widened; noise_covariance the same from the record's noise alone, as if
    the response were exact; surplus (h,) chi-square per degree of freedom; degrees (h,); limit (h,) its 99.9 % point;
    condition (h,).
    """

    loads: ComplexArray
    covariance: Array
    noise_covariance: Array
    redundancy_chi2: Array
    degrees: Array
    limit: Array
    condition: Array

    @property
    def misfit(self) -> NDArray[np.bool_]:
        """Where the surplus equations contradict the response."""
        return np.asarray(self.redundancy_chi2 > self.limit)

    @property
    def inflated_covariance(self) -> Array:
        """The covariance, times the surplus chi-square where that contradicts the response."""
        factor = np.where(self.misfit, self.redundancy_chi2, 1.0)
        return np.asarray(self.covariance * factor[:, None, None])


def solve_loads(
    T: Array,
    y: Array,
    noise: Array,
    dof: Array,
    response_covariance: Callable[[Array], Array],
    scale: Array,
    weighting_covariance: Array | None = None,
) -> SolvedLoads:
    """Solve h systems at once in real form (`responses.stacked_real`).

    T (h, a, b), y (h, a), noise (h, a, a) estimated with `dof` (h,) complex degrees of freedom; `response_covariance`
    takes loads (h, b) to the covariance (h, a, a) of T f; `scale` (b,) makes the columns comparable for the condition.
    `weighting_covariance` (h, a, a): the covariance by which the estimate weighs, up to a factor, where it is known
    apart; that
    of the noise otherwise.
    """
    a, b = T.shape[1:]
    G, noise_only = _weighted_inverse(T, noise if weighting_covariance is None else weighting_covariance)
    if weighting_covariance is None:
        noise_only = noise_only * _estimated_weights_factor(dof, a - b)[:, None, None]
    else:
        noise_only = G @ noise @ np.swapaxes(G, 1, 2)
    loads = np.einsum("hba,ha->hb", G, y)
    of_response = response_covariance(loads)
    total = noise + of_response
    covariance = noise_only + G @ of_response @ np.swapaxes(G, 1, 2)
    chi2 = _residual_chi2(T, y, total)
    share = np.trace(np.linalg.solve(total, noise), axis1=1, axis2=2) / a
    degrees = np.full(len(T), float(a - b))
    bias, limit = _residual_test_limit(share, dof, a - b)
    per_degree = np.where(degrees > 0, chi2 * bias / np.maximum(degrees, 1.0), np.nan)
    singular = np.linalg.svd(_normalize(T, noise, scale), compute_uv=False)
    return SolvedLoads(
        loads=loads[:, : b // 2] + 1j * loads[:, b // 2 :],
        covariance=covariance,
        noise_covariance=noise_only,
        redundancy_chi2=per_degree,
        degrees=degrees,
        limit=limit,
        condition=singular[:, 0] / singular[:, -1],
    )


def _weighted_inverse(T: Array, covariance: Array) -> tuple[Array, Array]:
    """G = (T' C^-1 T)^-1 T' C^-1 and the covariance (T' C^-1 T)^-1 of G y."""
    weighted = np.linalg.solve(covariance, T)
    inverse = np.linalg.inv(np.swapaxes(T, 1, 2) @ weighted)
    return np.asarray(inverse @ np.swapaxes(weighted, 1, 2)), np.asarray(inverse)


def _residual_chi2(T: Array, y: Array, total: Array) -> Array:
    """Least chi-square (h,) that any loads leave, weighted by noise and response error together."""
    G, _ = _weighted_inverse(T, total)
    residual = y - np.einsum("hab,hb->ha", T, np.einsum("hba,ha->hb", G, y))
    return np.asarray(np.einsum("ha,ha->h", residual, np.linalg.solve(total, residual[:, :, None])[:, :, 0]))


def _estimated_weights_factor(dof: Array, degrees: int) -> Array:
    """Factor (h,) on the covariance of an estimate whose weights come from `dof` complex degrees of freedom.

    With q complex surplus equations (T' C^-1 T)^-1 comes out too small by (dof - q) / dof, and the estimate scatters
    more than with the true weights by dof / (dof - q) (Rao, Proc. 5th Berkeley Symposium 1, 1967).
    """
    share = np.array([inverse_bias_factor(float(d), degrees // 2) for d in dof])
    return np.asarray(1.0 / share**2)


def _residual_test_limit(share: Array, dof: Array, degrees: int) -> tuple[Array, Array]:
    """Factor that takes the bias off the surplus chi-square, and its 99.9 % point per degree of freedom.

    With noise alone, estimated with dof complex degrees of freedom, q complex surplus equations follow Hotelling's
    law: chi2 (dof - q + 1) / (2 q dof) is F with 2 q and 2 (dof - q + 1) degrees. Both corrections matter only as far
    as noise makes up the covariance (`share`).
    """
    if degrees <= 0:
        return np.ones_like(share), np.full_like(share, np.inf)
    q = degrees // 2
    unbiased = np.array([inverse_bias_factor(float(d), q) for d in dof])
    second = np.minimum(2.0 * (dof - q + 1.0) / np.maximum(share, 1e-9), 1e9)
    limit = stats.f.ppf(REDUNDANCY_CONFIDENCE, degrees, second)
    known = np.isinf(dof)
    hotelling = np.where(known, 1.0, (dof - q) / np.where(known, 1.0, dof - q + 1.0))
    return 1.0 - share * (1.0 - unbiased), np.asarray(limit * (1.0 - share * (1.0 - hotelling)))


def _normalize(T: Array, noise: Array, scale: Array) -> Array:
    """T with every channel in units of its noise and every load in units of force."""
    sigma = np.sqrt(np.diagonal(noise, axis1=1, axis2=2))
    return np.asarray(T / sigma[:, :, None] / scale)
