"""Least squares on the equation error (paper, section 6): linear in the parameters, fast, biased by noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.paper.equations import Coefficients, coefficients_from_table, regressors
from balance_cli.estimation.paper.spectra import SensorSpectra
from balance_cli.io.errors import UserError

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

RANK_TOLERANCE = 1e-10
"""Singular values of the scaled regressors below this fraction of the largest count as none."""


@dataclass(frozen=True)
class EquationErrorFit:
    """The coefficients, the covariance (p, p) of their free entries, and the mean e e* (n, n) of the equation error.

    The covariance assumes exact regressors; it does not include the bias.
    """

    model: Coefficients
    covariance: Array
    residual_covariance: ComplexArray


def fit_linear_equations(
    spectra: SensorSpectra, free: NDArray[np.bool_], weight: Array | None = None
) -> EquationErrorFit:
    """Minimize sum |w e|^2, e = -omega^2 s - [D, K, B_F] phi(s, u), over all runs and lines (paper, eq. 1).

    Every row is a least-squares problem of its own, so the scale of a sensor does not matter; columns are scaled to
    unit length before solving. `weight` (N,) per line; the paper has none. The rows s' = j omega s of the paper's
    first-order form hold by construction and add no information.

    Raises UserError where there are fewer lines than parameters, or the runs do not excite all freedoms of the plate.
    """
    w = np.ones(len(spectra.frequency)) if weight is None else weight / np.max(weight)
    phi = w[:, None] * regressors(spectra.frequency, spectra.s, spectra.u)
    target = -w[:, None] * (2 * np.pi * spectra.frequency[:, None]) ** 2 * spectra.s
    if 2 * len(phi) < np.max(free.sum(axis=1)) + 2:
        raise UserError(
            f"{len(phi)} lines in the band are too few for {int(np.max(free.sum(axis=1)))} coefficients per sensor",
            remedy="Widen the band or give more sweeps",
        )
    table = np.zeros(free.shape)
    for row, free_columns in enumerate(free):
        table[row, free_columns] = _real_least_squares(phi[:, free_columns], target[:, row])
    error = target - phi @ table.T
    S = error.T @ np.conj(error) / (len(phi) - 0.5 * np.mean(free.sum(axis=1)))
    return EquationErrorFit(coefficients_from_table(table), _covariance(phi, free, S), S)


def _real_least_squares(phi: ComplexArray, target: ComplexArray) -> Array:
    A, b = np.vstack([phi.real, phi.imag]), np.concatenate([target.real, target.imag])
    scale = np.linalg.norm(A, axis=0)
    scale[scale == 0.0] = 1.0
    solution, _, rank, _ = np.linalg.lstsq(A / scale, b, rcond=RANK_TOLERANCE)
    if rank < A.shape[1]:
        raise UserError(
            "the runs do not excite every freedom of the plate, so its equations are not determined",
            remedy="Give sweeps of Fx, Fy, Fz, Mx and My",
        )
    return np.asarray(solution / scale)


def _covariance(phi: ComplexArray, free: NDArray[np.bool_], S: ComplexArray) -> Array:
    """cov(theta_a, theta_b) = N_a^-1 Re(S_ab Phi_a* Phi_b) N_b^-1 / 2, with N_a = Re Phi_a* Phi_a."""
    scale = np.linalg.norm(phi, axis=0)
    gram = np.conj(phi / scale).T @ (phi / scale)
    columns = [np.flatnonzero(free_columns) for free_columns in free]
    inverse = [np.linalg.inv(gram[np.ix_(c, c)].real) / scale[c] for c in columns]
    blocks = [
        [
            0.5 * inverse[a].T @ (S[a, b] * gram[np.ix_(columns[a], columns[b])]).real @ inverse[b]
            for b in range(len(free))
        ]
        for a in range(len(free))
    ]
    return np.block(blocks)
