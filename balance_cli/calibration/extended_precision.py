"""Extended-precision linear algebra: compensated inner products, QR decomposition and triangular inverse."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ExtendedArray = NDArray[np.longdouble]

# Veltkamp's constant, 2^ceil(p/2) + 1: the products of two numbers with half the digits are exact (Dekker, 1971).
SPLIT_FACTOR = np.longdouble(2.0) ** ((np.finfo(np.longdouble).nmant + 2) // 2) + 1


def gram_schmidt(A: ExtendedArray) -> tuple[ExtendedArray, ExtendedArray]:
    """Decompose A = Q R in extended precision by modified Gram-Schmidt, without pivoting."""
    Q, R = A.copy(), np.zeros((A.shape[1], A.shape[1]), np.longdouble)
    for j in range(A.shape[1]):
        R[j, j] = np.sqrt(np.sum(Q[:, j] ** 2))
        Q[:, j] /= R[j, j]
        R[j, j + 1 :] = Q[:, j] @ Q[:, j + 1 :]
        Q[:, j + 1 :] -= np.outer(Q[:, j], R[j, j + 1 :])
    return Q, R


def triangular_inverse(R: ExtendedArray) -> ExtendedArray:
    """Invert an upper triangular matrix in extended precision."""
    inverse = np.zeros_like(R)
    for j in reversed(range(len(R))):
        row = -(R[j, j + 1 :] @ inverse[j + 1 :])
        row[j] += 1.0
        inverse[j] = row / R[j, j]
    return inverse


def inner_products(A: NDArray[np.floating], r: NDArray[np.floating]) -> NDArray[np.floating]:
    """Compute A'r; for extended precision as a compensated dot product (Ogita, Rump and Oishi, 2005)."""
    if A.dtype != np.longdouble:
        return np.asarray(A.T @ r)
    halves = _veltkamp_split(A)
    return np.column_stack([_compensated_sum(*_two_products(A, halves, column[:, None])) for column in r.T])


def _two_products(
    A: ExtendedArray, halves: tuple[ExtendedArray, ExtendedArray], b: ExtendedArray
) -> tuple[ExtendedArray, ExtendedArray]:
    """Products of A and b (m, p) and their rounding errors (Dekker, 1971)."""
    (a1, a2), (b1, b2) = halves, _veltkamp_split(b)
    products = A * b
    return products, ((a1 * b1 - products) + a1 * b2 + a2 * b1) + a2 * b2


def _compensated_sum(values: ExtendedArray, rounding_errors: ExtendedArray) -> ExtendedArray:
    """Sum (p,) values (m, p) and their rounding errors pairwise, compensating the error of each addition (Knuth)."""
    correction = np.sum(rounding_errors, axis=0)
    while len(values) > 1:
        even = len(values) // 2 * 2
        a, b = values[0:even:2], values[1:even:2]
        sums = a + b
        b_rounded = sums - a
        correction += np.sum((a - (sums - b_rounded)) + (b - b_rounded), axis=0)
        values = np.concatenate([sums, values[even:]])
    return np.asarray(values[0] + correction)


def _veltkamp_split(x: ExtendedArray) -> tuple[ExtendedArray, ExtendedArray]:
    """Split x into a high and a low part of half the digits, whose products are exact (Veltkamp)."""
    scaled = x * SPLIT_FACTOR
    high = scaled - (scaled - x)
    return high, x - high
