"""Extended precision where double precision is not enough: products that keep what rounding takes, A = Q R."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ExtendedArray = NDArray[np.longdouble]

# Numbers of half as many digits have exact products.
SPLIT_FACTOR = np.longdouble(2.0) ** ((np.finfo(np.longdouble).nmant + 2) // 2) + 1


def gram_schmidt(A: ExtendedArray) -> tuple[ExtendedArray, ExtendedArray]:
    """A = Q R in extended precision (modified, columns in their order)."""
    Q, R = A.copy(), np.zeros((A.shape[1], A.shape[1]), np.longdouble)
    for j in range(A.shape[1]):
        R[j, j] = np.sqrt(np.sum(Q[:, j] ** 2))
        Q[:, j] /= R[j, j]
        R[j, j + 1 :] = Q[:, j] @ Q[:, j + 1 :]
        Q[:, j + 1 :] -= np.outer(Q[:, j], R[j, j + 1 :])
    return Q, R


def triangular_inverse(R: ExtendedArray) -> ExtendedArray:
    """Inverse of an upper triangular matrix in extended precision."""
    inverse = np.zeros_like(R)
    for j in reversed(range(len(R))):
        row = -(R[j, j + 1 :] @ inverse[j + 1 :])
        row[j] += 1.0
        inverse[j] = row / R[j, j]
    return inverse


def inner_products(A: NDArray[np.floating], r: NDArray[np.floating]) -> NDArray[np.floating]:
    """A'r, in extended precision with what rounding takes of products and sums (Ogita, Rump and Oishi, 2005)."""
    if A.dtype != np.longdouble:
        return np.asarray(A.T @ r)
    halves = _veltkamp_split(A)
    return np.column_stack([_compensated_sum(*_two_products(A, halves, one[:, None])) for one in r.T])


def _two_products(
    A: ExtendedArray, halves: tuple[ExtendedArray, ExtendedArray], b: ExtendedArray
) -> tuple[ExtendedArray, ExtendedArray]:
    """A times b (m, p), and what rounding takes of it."""
    (a1, a2), (b1, b2) = halves, _veltkamp_split(b)
    products = A * b
    return products, ((a1 * b1 - products) + a1 * b2 + a2 * b1) + a2 * b2


def _compensated_sum(values: ExtendedArray, lost: ExtendedArray) -> ExtendedArray:
    """Sums (p,) of values (m, p) and of what was lost of them, two by two, each with what rounding takes of it."""
    small = np.sum(lost, axis=0)
    while len(values) > 1:
        even = len(values) // 2 * 2
        one, other = values[0:even:2], values[1:even:2]
        both = one + other
        taken = both - one
        small += np.sum((one - (both - taken)) + (other - taken), axis=0)
        values = np.concatenate([both, values[even:]])
    return np.asarray(values[0] + small)


def _veltkamp_split(x: ExtendedArray) -> tuple[ExtendedArray, ExtendedArray]:
    """Two numbers of half as many digits, the products of which are exact."""
    far = x * SPLIT_FACTOR
    first = far - (far - x)
    return first, x - first
