"""The filter and smoother of a model that does not change with time, at their steady gain.

    innovation    e[k] = y[k] - H x[k],      S = H P H' + 1
    prediction    x[k+1] = F x[k] + K e[k] = L x[k] + K y[k],      K = F P H' S^-1,   L = F - K H
    smoother      rho[k] = L' rho[k+1] + H' S^-1 e[k],             x[k] + P rho[k] given all of y
    fixed lag     the same with rho[k] - L'^(d+1) rho[k+d+1], which knows no y after k + d

(Anderson and Moore, Optimal Filtering, 1979, chapters 4 and 7; de Jong, J. Am. Stat. Assoc. 84, 1989, 1085). In the
eigenvectors of L both recursions are first-order filters, one for each mode, which scipy runs compiled.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.signal
from numpy.typing import NDArray

from balance_cli.reduction.kalman.discretization import SampledModel
from balance_cli.reduction.kalman.riccati import discrete_gramian, steady_covariance

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class FilterBlock:
    """Consecutive samples after the forward pass, from sample `first` on.

    `innovation` (n, c), `predicted` (n, m): the loads U x[k] before y[k] was known; `end` (N,): x after the last.
    `marked` (r, q): further outputs at some samples only, where the engine has such.
    """

    first: int
    innovation: Array
    predicted: Array
    end: Array
    marked: Array | None = None

    def with_innovations(self, later: Array) -> FilterBlock:
        """The same, known to be followed by these innovations (l, c)."""
        return replace(self, innovation=np.concatenate([self.innovation, later]))

    def superpose(self, other: FilterBlock) -> FilterBlock:
        """The sum of two: the recursions are linear."""
        marked = None if self.marked is None or other.marked is None else self.marked + other.marked
        innovation, predicted = self.innovation + other.innovation, self.predicted + other.predicted
        return FilterBlock(self.first, innovation, predicted, self.end + other.end, marked)


@dataclass(frozen=True)
class Outputs:
    """Loads (n, m) at every sample of a piece, `marked` (r, q) further outputs where there are any."""

    loads: Array
    marked: Array | None = None


@dataclass(frozen=True)
class MarkedOutputs:
    """Samples (r,), counted from the first of a piece, with further outputs of the states, `rows` (q, N), and their

    steady variance: `updated` and `smoothed` (q,).
    """

    samples: NDArray[np.intp]
    rows: Array
    updated: Array
    smoothed: Array


class ChannelFilter(Protocol):
    """A filter and its smoother for one set of channels, block by block; matrices are those at sample `first`."""

    @property
    def time_invariant(self) -> bool:
        """Whether the matrices are the same at all times."""
        ...

    def at(self, first: int, count: int = 1) -> SteadyFilter:
        """The steady filter whose matrices hold from sample `first` on, L those of so many samples' mean."""
        ...

    def quasi_steady_parts(self, first: int, count: int) -> list[tuple[int, int]]:
        """First sample and count of parts over each of which the matrices hardly change."""
        ...

    def forward_pass(self, first: int, y: Array, start: Array) -> FilterBlock:
        """Innovations of y (n, c) and predictions, from the state `start` (N,) at sample `first`."""
        ...

    def updated(self, filter_block: FilterBlock) -> Outputs:
        """Given y up to the sample itself."""
        ...

    def backward_pass(self, filter_block: FilterBlock, adjoint_after: Array) -> tuple[Outputs, Array]:
        """Given y after them too, and rho (N,) at the first sample, from rho `after` the last."""
        ...

    def fixed_lag_pass(self, filter_block: FilterBlock, count: int, lag: int) -> Outputs:
        """The `count` samples of a piece given `lag` innovations after each, as far as they go."""
        ...

    def variance(self, first: int, count: int, smoothed: bool) -> Array:
        """Steady variance (count, m) of the loads, given y up to the sample or after it too."""
        ...

    def marked_outputs(self, first: int, count: int) -> MarkedOutputs | None:
        """The samples with further outputs, and what these are."""
        ...

    def whiten_innovations(self, filter_block: FilterBlock) -> Array:
        """Innovations (n, c) in units in which their covariance is one."""
        ...


@dataclass(frozen=True)
class SteadyFilter:
    """The time-invariant filter of a model whose channels are in units of their noise."""

    model: SampledModel

    @cached_property
    def P(self) -> Array:
        """Covariance (N, N) of the prediction."""
        return steady_covariance(self.model.F, self.model.Q, self.model.H)

    @cached_property
    def S(self) -> Array:
        """Covariance (c, c) of an innovation."""
        H = self.model.H
        return np.asarray(H @ self.P @ H.T + np.eye(len(H)))

    @cached_property
    def update_gain(self) -> Array:
        """P H' S^-1 (N, c): what an innovation tells of the states at its own sample."""
        return np.asarray(np.linalg.solve(self.S, self.model.H @ self.P).T)

    @cached_property
    def K(self) -> Array:
        """Gain (N, c) of the prediction."""
        return np.asarray(self.model.F @ self.update_gain)

    @cached_property
    def L(self) -> Array:
        """F - K H (N, N)."""
        return np.asarray(self.model.F - self.K @ self.model.H)

    @cached_property
    def weighted(self) -> Array:
        """S^-1 H (c, N)."""
        return np.asarray(np.linalg.solve(self.S, self.model.H))

    @cached_property
    def modes(self) -> _Modes:
        """Eigenvalues and vectors of L."""
        return _modes(self.L)

    @property
    def outputs(self) -> Array:
        """U (o, N)."""
        return self.model.U

    @property
    def time_invariant(self) -> bool:
        """It is."""
        return True

    def at(self, first: int, count: int = 1) -> SteadyFilter:
        """Itself."""
        return self

    def quasi_steady_parts(self, first: int, count: int) -> list[tuple[int, int]]:
        """One."""
        return [(first, count)]

    def with_transition(self, L: Array) -> SteadyFilter:
        """The same filter, but that errors move on by L (N, N): gains and covariances are kept."""
        other = SteadyFilter(self.model)
        kept = ("P", "S", "update_gain", "K", "weighted", "information", "all_information")
        other.__dict__.update({name: getattr(self, name) for name in kept}, L=L)
        return other

    @cached_property
    def information(self) -> Array:
        """H' S^-1 H (N, N): what one innovation tells of the state."""
        return np.asarray(self.model.H.T @ self.weighted)

    @cached_property
    def all_information(self) -> Array:
        """O = sum L^j' H' S^-1 H L^j (N, N): what all innovations tell of the state at the first."""
        return discrete_gramian(self.L, self.information)

    def forward_pass(self, first: int, y: Array, start: Array) -> FilterBlock:
        """Innovations (n, c) and predicted outputs, every mode a compiled recursion."""
        modes = self.modes
        inputs = np.concatenate([(modes.left @ start)[None], y @ (modes.left @ self.K).T])
        states = _run_recursions(modes.values, inputs)
        innovation = y - _real_product(states[:-1], self.model.H @ modes.right)
        return FilterBlock(
            first,
            innovation,
            _real_product(states[:-1], self.outputs @ modes.right),
            _real_product(states[-1:], modes.right)[0],
        )

    def updated(self, filter_block: FilterBlock) -> Outputs:
        """U x[k] given y up to y[k]."""
        return Outputs(filter_block.predicted + filter_block.innovation @ (self.outputs @ self.update_gain).T)

    def backward_pass(self, filter_block: FilterBlock, adjoint_after: Array) -> tuple[Outputs, Array]:
        """Smoothed loads, and rho at the first sample."""
        adjoint = self._adjoint(filter_block, adjoint_after)
        modes = self.modes
        smoothed = filter_block.predicted + _real_product(adjoint[:-1], self.outputs @ self.P @ modes.left.T)
        return Outputs(smoothed), _real_product(adjoint[:1], modes.left.T)[0]

    def fixed_lag_pass(self, filter_block: FilterBlock, count: int, lag: int) -> Outputs:
        """Without what comes later: rho[k] - L'^(lag+1) rho[k+lag+1]."""
        modes = self.modes
        adjoint = self._adjoint(filter_block, np.zeros(self.model.order))
        early, later = adjoint[:count].copy(), adjoint[lag + 1 : lag + 1 + count]
        early[: len(later)] -= modes.values ** (lag + 1) * later
        return Outputs(filter_block.predicted + _real_product(early, self.outputs @ self.P @ modes.left.T))

    def marked_outputs(self, first: int, count: int) -> MarkedOutputs | None:
        """There are none."""
        return None

    def _adjoint(self, filter_block: FilterBlock, adjoint_after: Array) -> ComplexArray:
        """The adjoint in modes (n + 1, modes), V' rho[k], the last row that after the piece."""
        modes = self.modes
        told = filter_block.innovation @ (self.weighted @ modes.right)
        inputs = np.concatenate([(adjoint_after @ modes.right)[None], told[::-1]])
        return _run_recursions(modes.values, inputs)[::-1]

    def smoothed_covariance(self, lag: float = np.inf) -> Array:
        """Covariance (o, o) of the outputs given y up to `lag` samples after them (-1: before them)."""
        P, U = self.P, self.outputs
        told = discrete_gramian(self.L, self.information, lag + 1) if lag >= 0 else np.zeros_like(P)
        return np.asarray(U @ (P - P @ told @ P) @ U.T)

    @cached_property
    def _variances(self) -> tuple[Array, Array]:
        """Of the outputs (o,): updated, and smoothed."""
        return self.output_variances(self.outputs)

    def output_variances(self, rows: Array) -> tuple[Array, Array]:
        """Of outputs (q, N) of the states (q,): updated, and smoothed."""
        spread = rows @ self.P
        told = [np.sum((spread @ J) * spread, axis=1) for J in (self.information, self.all_information)]
        before = np.sum(spread * rows, axis=1)
        return before - told[0], before - told[1]

    def variance(self, first: int, count: int, smoothed: bool) -> Array:
        """The same at all times."""
        return np.tile(self._variances[int(smoothed)], (count, 1))

    @cached_property
    def whitening_matrix(self) -> Array:
        """V (c, c) with V S V' = 1."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.S)), float)

    def whiten_innovations(self, filter_block: FilterBlock) -> Array:
        """V e (n, c)."""
        return np.asarray(filter_block.innovation @ self.whitening_matrix.T)


@dataclass(frozen=True)
class _Modes:
    """L = Re sum of values_i right_i left_i over one of each conjugate pair, `right` (N, m) doubled for pairs.

    `left` (m, N), so that x = Re(right (left x)).
    """

    values: ComplexArray
    right: ComplexArray
    left: ComplexArray


def _modes(L: Array) -> _Modes:
    values, vectors = np.linalg.eig(L)
    left = np.linalg.inv(vectors)
    kept = values.imag >= 0
    weight = np.where(values.imag[kept] > 0, 2.0, 1.0)
    # The weight is split evenly, so that the transposed problem has the same form.
    root = np.sqrt(weight)
    return _Modes(values[kept].astype(complex), vectors[:, kept] * root, left[kept] * root[:, None])


def _run_recursions(values: ComplexArray, inputs: ComplexArray) -> ComplexArray:
    """s[0] = driven[0], s[k] = value s[k-1] + driven[k] for each mode (column); real modes in real arithmetic."""
    rows = np.ascontiguousarray(inputs.T, dtype=complex)
    for i, value in enumerate(values):
        row, decay = (rows[i], value) if value.imag else (rows[i].real.copy(), value.real)
        rows[i] = scipy.signal.lfilter([1.0], [1.0, -decay], row)
    return rows.T


def _real_product(states: ComplexArray, rows: ComplexArray) -> Array:
    """Re(states rows') (n, o) as one real product."""
    return np.asarray(states.real @ rows.real.T - states.imag @ rows.imag.T)
