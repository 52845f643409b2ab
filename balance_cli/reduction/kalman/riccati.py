"""Steady covariances by doubling: each step covers twice the time of the one before.

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
"""Relative change of the variances at which doubling ends: the rounding error of their sums."""
MAX_DOUBLINGS = 60
"""Doublings at most: after 2^60 steps any stable system is steady."""


def steady_covariance(F: Array, Q: Array, H: Array) -> Array:
    """Solve P = F (P - P H' (H P H' + I)^-1 H P) F' + Q (n, n), the covariance of x[k] given y up to k - 1.

    F, Q (n, n), H (c, n) in units of the noise of y, which is white. LinAlgError where there is no steady solution.
    """
    A, G, P = F.T.copy(), H.T @ H, symmetrize(Q)
    for _ in range(MAX_DOUBLINGS):
        W = np.eye(len(F)) + G @ P
        solved = cast(Array, scipy.linalg.solve(W, np.hstack([A, G]), check_finite=False))
        WA, WG = solved[:, : len(F)], solved[:, len(F) :]
        # A state that grows and is not observable overflows; it is detected below.
        with np.errstate(over="ignore", invalid="ignore"):
            increment = symmetrize(A.T @ P @ WA)
            G = symmetrize(G + A @ WG @ A.T)
            A, P = A @ WA, P + increment
        if not all(np.isfinite(matrix).all() for matrix in (A, G, P)):
            break
        if np.all(np.abs(np.diag(increment)) <= DOUBLING_TOLERANCE * np.diag(P)):
            return P
    raise np.linalg.LinAlgError("the Riccati equation has no steady solution")


def discrete_gramian(L: Array, W: Array, steps: float = np.inf) -> Array:
    """Return sum_j L^j' W L^j (n, n) over j = 0 .. steps - 1, by default over all j."""
    return _infinite_gramian(L, W) if not np.isfinite(steps) else _finite_gramian(L, W, int(steps))


def _infinite_gramian(L: Array, W: Array) -> Array:
    power, total = L, symmetrize(W)
    for _ in range(MAX_DOUBLINGS):
        increment = power.T @ total @ power
        total, power = symmetrize(total + increment), power @ power
        if np.all(np.abs(np.diag(increment)) <= DOUBLING_TOLERANCE * np.diag(total)):
            break
    return total


def _finite_gramian(L: Array, W: Array, steps: int) -> Array:
    """Add the sums over 1, 2, 4, ... terms that make up the binary number `steps`."""
    power, partial, terms = L, symmetrize(W), 1
    total: Array = np.zeros_like(partial)
    shift: Array = np.eye(len(L))
    while steps:
        if steps & terms:
            total = total + shift.T @ partial @ shift
            shift = shift @ power
            steps -= terms
        partial, power, terms = symmetrize(partial + power.T @ partial @ power), power @ power, 2 * terms
    return symmetrize(total)


def symmetrize(matrix: Array) -> Array:
    """Return the symmetric part of a matrix that rounding made slightly asymmetric."""
    return np.asarray(0.5 * (matrix + matrix.T))


def positive_root(matrix: Array) -> Array:
    """Return S (n, n) with S S' the matrix, which is positive but for rounding."""
    size, vectors = np.linalg.eigh(matrix)
    return np.asarray(vectors * np.sqrt(np.maximum(size, 0.0)))


def inverse_sum(first: Array, second: Array) -> Array:
    """Return R (n, n) with R R' = (A^-1 + B)^-1 for positive A and B (n, n), of which A may be singular.

    With A = S S' it is S C'^-1, where C C' = 1 + S' B S. No difference is formed, so that it holds where A B is larger
    than one by as many orders as a number has digits.
    """
    S = positive_root(first)
    C = np.linalg.cholesky(np.eye(len(S)) + symmetrize(S.T @ second @ S))
    return np.asarray(np.linalg.solve(C, S.T).T)
