"""Noise covariance of repeated spectra, pooled over neighboring lines, robust against lines with more than noise."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.rotor.spectral_floor import row_medians

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Counts = NDArray[np.intp]

LEAST_POOLED_DOF = 150
"""Complex degrees of freedom: about ten for each signal of a balance, so that the bias of the inverse is a tenth."""
OUTLIER_PROBABILITY = 1e-3
"""Probability with which noise alone exceeds the bound from which a line gets less weight (Huber)."""
STEPS_PER_WINDOW = 8
"""Covariances computed for each pooling window; a smooth noise spectrum changes little within an eighth of it."""
ROBUST_ITERATIONS = 3
"""Passes of the robust weighting; each one removes from the covariance what outliers added in the one before."""
INITIAL_POWER_LIMIT = 20.0
"""Power over the median from which a line gets less weight at first: a probability of 1e-6 for one period of noise."""
MEDIAN_LINES = 75
"""Lines whose median power is the reference of the initial weights: of three periods, LEAST_POOLED_DOF in all."""
MIN_DOF_PER_SIGNAL = 2.0
"""Degrees of freedom per signal below which a covariance is not inverted. With nu = 2n the inverse of an n x n sample
covariance is already too large by a factor of two in the mean (complex Wishart)."""
RELATIVE_NOISE_FLOOR = 1e-7
"""Least noise, relative to the signal: the rounding error of single precision."""


def inverse_bias_factor(dof: float, n: int) -> float:
    """Return the factor (dof - n) / dof that removes the bias of the inverse of an estimated covariance of n signals.

    A sample covariance with `dof` complex degrees of freedom is complex Wishart; the mean of its inverse is
    dof / (dof - n) times the true inverse (Maiwald and Kraus, IEE Proc. Radar 147, 2000). Without the factor every
    chi-square weighted by the estimated covariance is too large. Raises ValueError where dof <= n.
    """
    if np.isinf(dof):
        return 1.0
    if dof <= n:
        raise ValueError(f"a covariance of {n} signals from {dof:g} degrees of freedom has no inverse")
    return (dof - n) / dof


def window_sums(values: NDArray[Any], width: int, step: int = 1) -> NDArray[Any]:
    """Return sums over windows of `width` entries of `values` (K, ...) along axis 0, for every `step`-th entry.

    The window is centered on its entry; at the edges it keeps its width and is shifted inward.
    """
    K = len(values)
    start = _window_starts(K, width, step)
    total = np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])
    return np.asarray(total[start + min(width, K)] - total[start])


def _window_starts(count: int, width: int, step: int) -> NDArray[np.int64]:
    width = min(width, count)
    return np.clip(np.arange(0, count, step) - width // 2, 0, count - width)


def variance_floor(spectra: ComplexArray, channels: int) -> Array:
    """Return the least variance (n,) that is assumed for the noise of signals (..., n), the first of them channels.

    A computed record has no noise, so that without a floor its covariance would have no inverse. A signal that is zero
    has the floor of a weak one: weak beside those of its own unit, for the ratio of volts to newtons is arbitrary.
    """
    power = np.mean(spectra.real**2 + spectra.imag**2, axis=tuple(range(spectra.ndim - 1)))
    is_channel = np.arange(len(power)) < channels
    strongest = [power.max(initial=0.0, where=kind) for kind in (~is_channel, is_channel)]
    weak = RELATIVE_NOISE_FLOOR * np.array(strongest)[is_channel.astype(int)]
    return np.asarray(RELATIVE_NOISE_FLOOR**2 * np.maximum(power, weak) + np.finfo(float).tiny, float)


@dataclass(frozen=True)
class PooledCovariance:
    """Noise covariance of one degree of freedom at neighboring lines, piecewise constant.

    Each of `lines` has the covariance of the nearest of `knots` (B, n, n), which lie at every `step`-th line and have
    these `inverses`. `dof` are its complex degrees of freedom.
    """

    knots: ComplexArray
    inverses: ComplexArray
    step: int
    lines: int
    dof: float

    @functools.cached_property
    def nearest(self) -> NDArray[np.int64]:
        """The knot (lines,) of each line."""
        return np.minimum((np.arange(self.lines) + self.step // 2) // self.step, len(self.knots) - 1)

    @property
    def at_lines(self) -> ComplexArray:
        """The covariance (lines, n, n) at every line."""
        return self.knots[self.nearest]

    def solve(self, vectors: ComplexArray) -> ComplexArray:
        """Return the inverse covariance times vectors (lines, v, n), with one product for each knot."""
        _, v, n = vectors.shape
        before = self.step // 2
        blocks = -(-(before + self.lines) // self.step)
        padded = np.zeros((blocks * self.step, v, n), complex)
        padded[before : before + self.lines] = vectors
        inverses = self.inverses[np.minimum(np.arange(blocks), len(self.knots) - 1)]
        weighted = np.matmul(padded.reshape(blocks, -1, n), inverses.swapaxes(1, 2))
        return np.asarray(weighted.reshape(-1, v, n)[before : before + self.lines])

    def distances(self, vectors: ComplexArray) -> Array:
        """Return the squared Mahalanobis distance (K, v) of vectors (K, v, n); its mean is n for noise."""
        n = vectors.shape[2]
        parts = (np.ascontiguousarray(item).view(float) for item in (vectors, self.solve(vectors)))
        squared = np.einsum("kvp,kvp->kv", *parts)
        return np.asarray(squared * inverse_bias_factor(max(self.dof, n + 1), n), float)


def pooled_covariance(
    deviations: ComplexArray, counts: Array, least_dof: float = LEAST_POOLED_DOF, floor: Array | float = 0.0
) -> PooledCovariance:
    """Estimate the noise covariance of one degree of freedom at every line, pooled over neighboring lines.

    The sum of the outer products of the `deviations` (K, v, n) of a line with themselves has `counts` (K,) complex
    degrees of freedom. The window is the narrowest that gives `least_dof` at every line (or holds all lines), so that
    the covariance follows the spectrum of the noise and can still be inverted. Lines whose deviations are improbably
    large (residual transients, mains interference) get less weight (Huber's weights on the Mahalanobis distance).
    `floor` (n,) or one number is added to the variances.
    """
    K, _, n = deviations.shape
    deviations = np.ascontiguousarray(deviations, complex)
    floor = np.broadcast_to(np.asarray(floor, float), n)
    width = _pooling_width(counts, least_dof)
    step = max(width // STEPS_PER_WINDOW, 1)
    starts = _window_starts(K, width, step)
    dof = float(np.median(window_sums(counts, width)))
    bound = outlier_bound(counts, n)
    weights = _initial_weights(deviations, counts, floor)
    products = _WindowProducts(deviations, min(width, K), step)
    knots, inverses = (np.empty((len(starts), n, n), complex) for _ in range(2))
    for remaining in reversed(range(ROBUST_ITERATIONS)):
        total = np.maximum(window_sums(weights * counts, width, step), 1e-300)
        changed = products.weigh(weights)
        knots[changed] = products.sums[changed] / total[changed, None, None] + np.diag(floor)
        inverses[changed] = np.linalg.inv(knots[changed])
        pooled = PooledCovariance(knots, inverses, step, K, dof)
        if remaining:
            weights = np.minimum(1.0, bound / mean_distances(pooled, deviations, counts, floor))
    return pooled


class _WindowProducts:
    """Weighted `sums` (B, n, n) of outer products of deviations (K, v, n) over windows of `width` lines.

    Windows overlap. Away from the edges of the spectrum each is a number of whole blocks of `step` lines, and the head
    of a block: the products of heads and tails of all blocks are computed once, and again only where weights have
    changed, which are those of a few lines. The windows at the two edges are summed by themselves.
    """

    def __init__(self, deviations: ComplexArray, width: int, step: int) -> None:
        K, v, n = deviations.shape
        self._deviations, self._width, self._head = deviations, width, width % step
        self._starts = _window_starts(K, width, step)
        offset, unclipped = -(width // 2) % step, np.arange(0, K, step) - width // 2
        inner = np.flatnonzero(self._starts == unclipped)
        self._inner = slice(int(inner[0]), int(inner[-1]) + 1) if len(inner) else slice(0, 0)
        self._first = (int(unclipped[self._inner.start]) - offset) // step
        self._edges = np.unique(self._starts[self._starts != unclipped]).tolist()
        self._padding = (-(K - offset)) % step
        padded = np.concatenate([deviations[offset:], np.zeros((self._padding, v, n))])
        self._rows, self._offset = padded.reshape(-1, step, v, n), offset
        self._weights = np.full(K, np.nan)
        self._heads, self._tails = (np.zeros((len(self._rows) + 1, n, n), complex) for _ in range(2))
        self.sums = np.empty((len(self._starts), n, n), complex)

    def weigh(self, weights: Array) -> NDArray[np.int64]:
        """Take weights (K,), and return the windows whose sums have changed."""
        different, self._weights = weights != self._weights, weights
        self._update_blocks(weights, different)
        lines = np.concatenate([[0], np.cumsum(different)])
        windows = np.flatnonzero(lines[self._starts + self._width] > lines[self._starts])
        count, whole, first = self._inner.stop - self._inner.start, self._width // self._rows.shape[1], self._first
        parts = (self._heads + self._tails)[first : first + count + whole - 1]
        if count:
            np.add(_sliding_sums(parts, whole), self._heads[first + whole :][:count], out=self.sums[self._inner])
        for edge in self._edges:
            own = slice(edge, edge + self._width)
            self.sums[self._starts == edge] = _outer_products(self._deviations[None, own], weights[None, own])
        return windows

    def _update_blocks(self, weights: Array, different: NDArray[np.bool_]) -> None:
        """Compute the products of the blocks in which weights are different."""
        count, step = self._rows.shape[:2]
        nothing = np.zeros(self._padding)
        split = np.concatenate([weights[self._offset :], nothing]).reshape(count, step)
        changed = np.concatenate([different[self._offset :], nothing]).reshape(count, step)
        blocks = np.flatnonzero(changed.any(axis=1))
        rows, weight, head = self._rows[blocks], split[blocks], self._head
        if head:
            self._heads[blocks] = _outer_products(rows[:, :head], weight[:, :head])
        self._tails[blocks] = _outer_products(rows[:, head:], weight[:, head:])


def _outer_products(rows: ComplexArray, weights: Array) -> ComplexArray:
    """Return the sums (b, n, n) of outer products of vectors (b, s, v, n), weighted by (b, s)."""
    b, s, v, n = rows.shape
    weighted = rows.conj() * weights[:, :, None, None]
    return np.asarray(np.matmul(rows.reshape(b, s * v, n).swapaxes(1, 2), weighted.reshape(b, s * v, n)))


def _sliding_sums(parts: ComplexArray, width: int) -> ComplexArray:
    """Return the sums (b - width + 1, ...) of `width` successive parts (b, ...), at least one.

    Sums over as many parts as the binary digits of the width say are added: no difference of sums loses digits.
    """
    total, doubled, done, count = np.zeros_like(parts[: len(parts) - width + 1]), parts, 0, len(parts) - width + 1
    for digit in range(width.bit_length()):
        if digit:
            doubled = doubled[: -(1 << digit - 1)] + doubled[1 << digit - 1 :]
        if width >> digit & 1:
            total += doubled[done : done + count]
            done += 1 << digit
    return total


def mean_distances(
    covariance: PooledCovariance, deviations: ComplexArray, counts: Array, floor: Array | float = 0.0
) -> Array:
    """Return the Mahalanobis distance per degree of freedom (K,) of deviations (K, v, n), of mean 1 for noise.

    `floor` (n,) is a variance that the deviations lack.
    """
    n = deviations.shape[2]
    squared = covariance.distances(deviations).sum(axis=1)
    lacking = np.einsum("bii,i->b", covariance.inverses, np.broadcast_to(floor, n)).real
    lacking = lacking * inverse_bias_factor(max(covariance.dof, n + 1), n)
    squared = squared + counts * lacking[covariance.nearest]
    return np.asarray(np.maximum(squared / (n * np.maximum(counts, 1e-12)), 1e-300), float)


def invert_pooled(covariance: ComplexArray) -> ComplexArray:
    """Return the inverses (K, n, n) of covariances at neighboring lines, each computed once where several are equal."""
    changed = np.ones(len(covariance), bool)
    changed[1:] = np.any(covariance[1:] != covariance[:-1], axis=(1, 2))
    return np.asarray(np.linalg.inv(covariance[changed])[np.cumsum(changed) - 1], complex)


def outlier_bound(counts: Array, n: int, probability: float = OUTLIER_PROBABILITY) -> Array:
    """Return the distance (K,) that noise of n signals exceeds with this probability at one line (chi-square)."""
    from scipy.special import gammainccinv

    half, place = np.unique(n * np.maximum(counts, 1.0), return_inverse=True)
    return np.asarray((gammainccinv(half, probability) / half)[place])


def _pooling_width(counts: Array, least_dof: float) -> int:
    """Least odd number of lines that gives `least_dof` at every line (by bisection), or all lines."""
    total = np.concatenate([[0.0], np.cumsum(counts)])
    low, high = 0, (len(counts) - 1) // 2
    while low < high:
        middle = (low + high) // 2
        enough = np.min(total[2 * middle + 1 :] - total[: -2 * middle - 1]) >= least_dof
        low, high = (low, middle) if enough else (middle + 1, high)
    return 2 * low + 1


def _initial_weights(deviations: ComplexArray, counts: Array, floor: Array) -> Array:
    """Weights from the diagonal alone: the power of each signal at a line against the median of its neighbors."""
    parts = deviations.view(float)
    squares = np.einsum("kvp,kvp->kp", parts, parts)
    power = (squares[:, ::2] + squares[:, 1::2]) / np.maximum(counts, 1e-12)[:, None] + floor
    blocks = np.array_split(power, max(len(power) // MEDIAN_LINES, 1))
    typical = np.concatenate([np.broadcast_to(row_medians(block.T), block.shape) for block in blocks])
    largest = np.max(power / np.maximum(typical, 1e-300), axis=1)
    return np.asarray(np.minimum(1.0, INITIAL_POWER_LIMIT / np.maximum(largest, 1e-300)), float)
