"""Modal damping of the plate, including the derivatives of its eigenvectors."""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh

from balance_cli.model.mechanics.dual_numbers import Dual

DEGENERACY_TOLERANCE = 1e-9
"""Relative distance below which two eigenvalues are equal: far above rounding, far below any real separation."""


def modal_damping(M: Dual, K: Dual, zeta: Dual) -> Dual:
    """D = M Phi diag(2 zeta omega) Phi' M, with K Phi = M Phi diag(omega^2) and Phi' M Phi = I.

    M, K (n, n) and zeta (n,), in order of rising eigenfrequency. With dPhi = Phi A and Psi = Phi^-T = M Phi,
    dD = Psi (dg - A'g - gA) Psi', where A_ij = phi_i'(dK - lambda_j dM) phi_j / (lambda_j - lambda_i) and
    A_ii = -phi_i' dM phi_i / 2 (Fox and Kapoor, AIAA J. 6, 1968).
    """
    eigenvalues, Phi = eigh(K.value, M.value)
    omega = np.sqrt(np.maximum(eigenvalues, 0.0))
    g = 2.0 * zeta.value * omega
    Psi = M.value @ Phi
    dK, dM = Phi.T @ K.derivative @ Phi, Phi.T @ M.derivative @ Phi
    d_eigenvalues = np.diagonal(dK, axis1=1, axis2=2) - eigenvalues * np.diagonal(dM, axis1=1, axis2=2)
    d_omega = d_eigenvalues / np.where(omega > 0, 2.0 * omega, np.inf)
    dg = 2.0 * (zeta.derivative * omega + zeta.value * d_omega)
    inner = _rotation_terms(dK, dM, eigenvalues, g)
    index = np.arange(len(g))
    inner[:, index, index] += dg
    return Dual((Psi * g) @ Psi.T, Psi @ inner @ Psi.T)


def _rotation_terms(dK: np.ndarray, dM: np.ndarray, eigenvalues: np.ndarray, g: np.ndarray) -> np.ndarray:
    """-(A'g + gA) in closed form: off the diagonal a divided difference of g over the eigenvalues."""
    gap = eigenvalues[None, :] - eigenvalues[:, None]
    same = np.eye(len(g), dtype=bool)
    close = (np.abs(gap) <= DEGENERACY_TOLERANCE * np.max(np.abs(eigenvalues))) & ~same
    safe = np.where(close | same, 1.0, gap)
    difference = np.where(same, 0.0, (g[None, :] - g[:, None]) / safe)
    cross = np.where(same, g, (eigenvalues[None, :] * g[:, None] - eigenvalues[:, None] * g[None, :]) / safe)
    # In a degenerate plane the eigenvectors are arbitrary. With one damping ratio for both g = 2 zeta sqrt(lambda) is
    # smooth, and the limits are dg/dlambda = g / (2 lambda) and g - lambda dg/dlambda = g / 2.
    mean = 0.5 * (g[None, :] + g[:, None])
    limit = mean / (2.0 * np.where(close, eigenvalues, 1.0))
    return np.asarray(dK * np.where(close, limit, difference) + dM * np.where(close, 0.5 * mean, cross))
