"""Steady covariances by doubling: each step goes twice as far in time as the one before.

The structure-preserving doubling algorithm for the discrete Riccati equation, Chu, Fan, Lin and Wang, Int. J. Control
77 (2004) 767; Anderson, Int. J. Control 28 (1978) 295.
"""

from __future__ import annotations

from typing import cast

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

Array = NDArray[np.float64]

DOUBLING_TOLERANCE = 1e-13
"""Relative change of a covariance at which doubling ends."""
MAX_DOUBLINGS = 60


def steady_covariance(F: Array, Q: Array, H: Array) -> Array:
    """P = F (P - P H' (H P H' + I)^-1 H P) F' + Q (n, n): covariance of x[k] given y up to k - 1, noise of y white.

    F, Q (n, n), H (c, n) in units of that noise. LinAlgError where nothing steady is reached.
    """
    A, G, P = F.T.copy(), H.T @ H, symmetrize(Q)
    for _ in range(MAX_DOUBLINGS):
        W = np.eye(len(F)) + G @ P
        solved = cast(Array, scipy.linalg.solve(W, np.hstack([A, G]), check_finite=False))
        WA, WG = solved[:, : len(F)], solved[:, len(F) :]
        # What grows unseen does so without bound: found out below.
        with np.errstate(over="ignore", invalid="ignore"):
            gained = symmetrize(A.T @ P @ WA)
            G = symmetrize(G + A @ WG @ A.T)
            A, P = A @ WA, P + gained
        if not all(np.isfinite(matrix).all() for matrix in (A, G, P)):
            break
        if np.all(np.abs(np.diag(gained)) <= DOUBLING_TOLERANCE * np.diag(P)):
            return P
    raise np.linalg.LinAlgError("the Riccati equation has no steady solution")


def discrete_gramian(L: Array, W: Array, steps: float = np.inf) -> Array:
    """sum_j L^j' W L^j (n, n) over j = 0 .. steps - 1, by default without end."""
    power, total, done = L, symmetrize(W), 1
    if not np.isfinite(steps):
        for _ in range(MAX_DOUBLINGS):
            gained = power.T @ total @ power
            total, power = symmetrize(total + gained), power @ power
            if np.all(np.abs(np.diag(gained)) <= DOUBLING_TOLERANCE * np.diag(total)):
                break
        return total
    whole: Array = np.zeros_like(total)
    shift: Array = np.eye(len(L))
    left = int(steps)
    while left:
        if left & done:
            whole = whole + shift.T @ total @ shift
            shift = shift @ power
            left -= done
        total, power, done = symmetrize(total + power.T @ total @ power), power @ power, 2 * done
    return symmetrize(whole)


def symmetrize(matrix: Array) -> Array:
    """The symmetric part, which rounding takes away."""
    return np.asarray(0.5 * (matrix + matrix.T))
