"""Weighted regression with a zero for each block of rows and a penalty on each coefficient (ridge regression).

With penalties of the noise over the standard deviation of each coefficient this is the best linear unbiased prediction
of random coefficients (Henderson, Biometrics 31, 1975, 423), and the inverse of its normal matrix is the covariance of
their errors for unit noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from balance_cli.calibration.block_zeros import BlockZeros
from balance_cli.calibration.least_squares import LeastSquares

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def solve_penalized(X: Array, y: Array, block: Index, weight: Array, penalty: Array) -> LeastSquares:
    """Regress an output y (m,) on columns X (m, p) with a zero for each block (m,) of rows of `weight` (m,).

    The sum of squares of the residuals and of the coefficients times their `penalty` (p,) is minimized. The
    `dof` of the result are the rows less the zeros and the effective number of coefficients, the trace of the influence
    matrix; its errors of rows and blocks that are left out hold for given penalties.
    """
    zeros = BlockZeros.from_blocks(block, weight)
    A = np.asarray(zeros.subtract_means(X), float)
    target = np.asarray(zeros.subtract_means(y[:, None]), float)
    root = np.linalg.cholesky(A.T @ A + np.diag(penalty**2)).T
    Q = np.asarray(solve_triangular(root, A.T, trans="T")).T
    half = np.asarray(solve_triangular(root, np.eye(len(root))))
    coefficients = half @ (Q.T @ target)
    left = y[:, None] - X @ coefficients
    offsets = np.asarray(zeros.means(left * zeros.root[:, None]), float)
    return LeastSquares(
        coefficients=coefficients,
        zeros=offsets,
        residuals=left - offsets[zeros.place],
        leverage=np.sum(Q**2, axis=1) + weight / zeros.total[zeros.place],
        root=root,
        inverse=half @ half.T,
        weight=weight,
        block=zeros.place,
        dof=float(len(X) - len(zeros.total) - np.sum(Q**2)),
        Q=Q,
    )
