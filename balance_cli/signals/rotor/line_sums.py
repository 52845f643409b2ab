"""Lines of the order spectrum of a record, whose samples are not evenly spaced over azimuth.

The sums are those of the nonuniform fast Fourier transform (Dutt and Rokhlin, SIAM J. Sci. Comput. 14, 1993, 1368):
each sample is spread over the nearest points of an even grid of azimuth, the grid is transformed, and the result is
divided by the transform of the kernel. The kernel is that of Barnett, Magland and af Klinteberg (SIAM J. Sci. Comput.
41, 2019, C479). The error is a few 1e-14 of the sum of the magnitudes, that of the rounding of the sums themselves.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Integers = NDArray[np.int64]

KERNEL_WIDTH = 14
"""Grid points over which a sample is spread: the error is about 10^(1 - width)."""
KERNEL_SHAPE = 2.30 * KERNEL_WIDTH
"""Exponent of the kernel, for a grid of twice the points that the lines need."""
OVERSAMPLING = 2
TRANSFORMED_POINTS = 2**22
"""Points of the grid that are transformed at once, 34 MB: all columns, unless the record lasts some minutes."""
QUADRATURE_NODES = 40
"""Nodes of Gauss and Legendre for the transform of the kernel, which is smooth: 28 give 15 digits."""
TRANSFORM_DEGREE = 14
"""Degree of the polynomial in the square of frequency that stands for the transform of the kernel: its error, 7e-15,
is that of rounding from degree 12 on."""
KERNEL_DEGREE = 16
"""Degree of the polynomials that stand for the kernel between two grid points: their error, 4e-15, is that of rounding,
from degree 14 on."""


class LineSums:
    """Sums over samples of values times exp(-2 pi i j u), for whole j up to `highest`; u is a share of the interval.

    The memory is that of a grid of four times `highest` points for each of the columns.
    """

    def __init__(self, highest: int, columns: int) -> None:
        from scipy.fft import next_fast_len

        points = max(2 * OVERSAMPLING * highest, 2 * KERNEL_WIDTH)
        self._grid = np.zeros((next_fast_len(points, real=True), columns))

    def add(self, fraction: Array, values: Array, columns: Integers | slice = slice(None)) -> None:
        """Add samples of values (m, k), by default all columns, at shares (m,) of the interval, in ascending order."""
        position = fraction * len(self._grid)
        first = np.ceil(position - KERNEL_WIDTH / 2).astype(np.int64)
        spread = _spreading_matrix(position, first)
        part, place, begin = spread.T @ values, int(first[0]) % len(self._grid), 0
        while begin < len(part):  # a block may go round the whole grid
            count = min(len(part) - begin, len(self._grid) - place)
            self._grid[place : place + count, columns] += part[begin : begin + count]
            place, begin = 0, begin + count

    def at(self, lines: Integers) -> ComplexArray:
        """Return the sums (..., columns) at whole numbers j."""
        from scipy.fft import rfft

        at_once = max(TRANSFORMED_POINTS // len(self._grid), 1)
        parts = np.split(self._grid, range(at_once, self._grid.shape[1], at_once), axis=1)
        # Transforms of neighboring columns run side by side, in a quarter of the time of rows.
        spectrum = np.concatenate([rfft(part, axis=0)[np.abs(lines)] for part in parts], axis=-1)
        sums = np.where((lines < 0)[..., None], spectrum.conj(), spectrum)
        return np.asarray(sums / _kernel_transform(lines / len(self._grid))[..., None])


def _spreading_matrix(position: Array, first: Integers) -> csr_array:
    """Return the kernel at the grid points around each position, points counted from the first one of all."""
    from scipy.sparse import csr_array

    near = np.arange(KERNEL_WIDTH, dtype=np.int32)  # the matrix would convert wider indices
    index = ((first - first[0]).astype(np.int32)[:, None] + near).ravel()
    starts = np.arange(len(position) + 1, dtype=np.int32) * KERNEL_WIDTH
    values = _chebyshev(1.0 - 2.0 * (first - position + KERNEL_WIDTH / 2)).T @ _kernel_polynomials()
    return csr_array((values.ravel(), index, starts), shape=(len(position), int(index[-1]) + 1))


@functools.cache
def _kernel_polynomials() -> Array:
    """Return the Chebyshev coefficients (degree + 1, width) of the kernel at each of the points around a position.

    Their variable runs from 1 to -1 where the first point moves by one from the edge of the kernel inward.
    """
    nodes = np.polynomial.chebyshev.chebpts1(2 * KERNEL_DEGREE)
    inward = 0.5 * (1.0 - nodes)
    offset = (inward[:, None] - KERNEL_WIDTH / 2 + np.arange(KERNEL_WIDTH)) * (2.0 / KERNEL_WIDTH)
    return np.asarray(np.polynomial.chebyshev.chebfit(nodes, _kernel(offset), KERNEL_DEGREE))


def _chebyshev(x: Array) -> Array:
    """Return the Chebyshev polynomials (degree + 1, m) at points (m,)."""
    values = np.ones((KERNEL_DEGREE + 1, len(x)))
    values[1] = x
    for k in range(2, KERNEL_DEGREE + 1):
        np.multiply(2.0 * x, values[k - 1], out=values[k])
        values[k] -= values[k - 2]
    return values


def _kernel(offset: Array) -> Array:
    """Return the kernel at offsets from -1 to 1."""
    return np.asarray(np.exp(KERNEL_SHAPE * (np.sqrt(np.maximum(1.0 - offset**2, 0.0)) - 1.0)))


def _kernel_transform(frequency: Array) -> Array:
    """Return the transform of the kernel at frequencies in cycles per grid point, up to 1 / (2 OVERSAMPLING)."""
    transform = np.polynomial.chebyshev.chebval(2.0 * (2.0 * OVERSAMPLING * frequency) ** 2 - 1.0, _transform_series())
    return np.asarray(transform)


@functools.cache
def _transform_series() -> Array:
    """Return the Chebyshev coefficients of the kernel's transform, an even function of frequency, over its square."""
    squares = np.polynomial.chebyshev.chebpts1(2 * TRANSFORM_DEGREE)
    frequency = np.sqrt(0.5 * (squares + 1.0)) / (2.0 * OVERSAMPLING)
    node, weight = np.polynomial.legendre.leggauss(QUADRATURE_NODES)
    cosine = np.cos(np.pi * KERNEL_WIDTH * frequency[:, None] * node)
    transform = 0.5 * KERNEL_WIDTH * (cosine @ (weight * _kernel(node)))
    return np.asarray(np.polynomial.chebyshev.chebfit(squares, transform, TRANSFORM_DEGREE))


def unit_powers(angle: Array, highest: int) -> ComplexArray:
    """Return exp(j k angle) (highest + 1, m) for k = 0 to `highest`, at least 1, each the product of lower powers.

    This takes a tenth of the time of so many sines and cosines; the rounding error of a power is proportional to k.
    """
    powers = np.ones((highest + 1, len(angle)), complex)
    powers[1] = np.exp(1j * angle)
    for k in range(2, highest + 1):
        np.multiply(powers[k // 2], powers[k - k // 2], out=powers[k])
    return powers


def trigonometric_basis(angle: Array, highest: int, further: Array | None = None) -> Array:
    """Return cos(0 .. F angle), sin(1 .. F angle) for F = `highest`, as `unit_powers` does, and `further` (e, m).

    The rows (2 F + 1 + e, m) are the columns of a regression.
    """
    count = 0 if further is None else len(further)
    basis = np.empty((2 * highest + 1 + count, len(angle)))
    basis[0] = 1.0
    if further is not None:
        basis[2 * highest + 1 :] = further
    cosine, sine = basis[: highest + 1], basis[highest : 2 * highest + 1]  # sine[k] from k = 1 on
    if highest:
        np.cos(angle, out=cosine[1])
        np.sin(angle, out=sine[1])
    product = np.empty(len(angle))
    for k in range(2, highest + 1):
        a, b = k // 2, k - k // 2
        np.multiply(cosine[a], cosine[b], out=cosine[k])
        cosine[k] -= np.multiply(sine[a], sine[b], out=product)
        np.multiply(sine[a], cosine[b], out=sine[k])
        sine[k] += np.multiply(cosine[a], sine[b], out=product)
    return basis
