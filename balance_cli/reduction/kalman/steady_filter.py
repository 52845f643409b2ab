"""The filter and smoother of a time-invariant model, at their steady gain.

    innovation    e[k] = y[k] - H x[k],      S = H P H' + 1
    prediction    x[k+1] = F x[k] + K e[k] = L x[k] + K y[k],      K = F P H' S^-1,   L = F - K H
    smoother      rho[k] = L' rho[k+1] + H' S^-1 e[k],             x[k] + P rho[k] given all of y
    fixed lag     the same with rho[k] - L'^(d+1) rho[k+d+1], which depends on no y after k + d

In the eigenvectors of L both recursions are first-order filters, one for each mode: triangular equations with two
diagonals, which BLAS solves.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dtbsv, ztbsv

from balance_cli.reduction.kalman.channel_filter import FilterBlock, MarkedOutputs, Outputs
from balance_cli.reduction.kalman.discretization import SampledModel
from balance_cli.reduction.kalman.steady_matrices import SteadyMatrices, steady_matrices

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class SteadyFilter:
    """The time-invariant filter of a model whose channels are in units of their noise."""

    model: SampledModel

    @cached_property
    def matrices(self) -> SteadyMatrices:
        """Gains and covariances. LinAlgError where the Riccati equation has no steady solution."""
        return steady_matrices(self.model)

    @cached_property
    def modes(self) -> _Modes:
        """Eigenvalues and eigenvectors of L."""
        return _modes(self.matrices.L)

    @property
    def outputs(self) -> Array:
        """The matrix U (o, N) from the state to the outputs."""
        return self.model.U

    @property
    def time_invariant(self) -> bool:
        """Always true: the matrices are the same at every sample."""
        return True

    def at(self, first: int, count: int = 1) -> SteadyMatrices:
        """Return the matrices, the same at all times."""
        return self.matrices

    def quasi_steady_parts(self, first: int, count: int) -> list[tuple[int, int]]:
        """Return a single part."""
        return [(first, count)]

    def forward_pass(self, first: int, y: Array, start: Array) -> FilterBlock:
        """Return innovations (n, c) and predicted outputs; every mode is one compiled recursion."""
        modes = self.modes
        inputs = np.concatenate([(modes.left @ start)[None], y @ (modes.left @ self.matrices.K).T])
        states = _run_recursions(modes.values, inputs)
        innovation = y - _real_product(states[:-1], self.model.H @ modes.right)
        predicted = _real_product(states[:-1], self.outputs @ modes.right)
        return FilterBlock(first, innovation, predicted, _real_product(states[-1:], modes.right)[0])

    def filtered_outputs(self, filter_block: FilterBlock) -> Outputs:
        """Return U x[k] given y up to y[k]."""
        gain = self.outputs @ self.matrices.update_gain
        return Outputs(filter_block.predicted + filter_block.innovation @ gain.T)

    def backward_pass(self, filter_block: FilterBlock, adjoint_after: Array) -> tuple[Outputs, Array]:
        """Return the smoothed loads, and rho at the first sample."""
        adjoint, modes = self._adjoint(filter_block, adjoint_after), self.modes
        correction = _real_product(adjoint[:-1], self.outputs @ self.matrices.P @ modes.left.T)
        return Outputs(filter_block.predicted + correction), _real_product(adjoint[:1], modes.left.T)[0]

    def fixed_lag_pass(self, filter_block: FilterBlock, count: int, lag: int) -> Outputs:
        """Return the loads with rho[k] - L'^(lag+1) rho[k+lag+1] in place of rho[k]."""
        modes = self.modes
        adjoint = self._adjoint(filter_block, np.zeros(self.model.order))
        within_lag, beyond = adjoint[:count].copy(), adjoint[lag + 1 : lag + 1 + count]
        within_lag[: len(beyond)] -= modes.values ** (lag + 1) * beyond
        correction = _real_product(within_lag, self.outputs @ self.matrices.P @ modes.left.T)
        return Outputs(filter_block.predicted + correction)

    def marked_outputs(self, first: int, count: int) -> MarkedOutputs | None:
        """Return None: this filter has no further outputs."""
        return None

    def _adjoint(self, filter_block: FilterBlock, adjoint_after: Array) -> ComplexArray:
        """Return the adjoint in modes (n + 1, modes), V' rho[k]; the last row is that after the block."""
        modes = self.modes
        weighted_innovations = filter_block.innovation @ (self.matrices.weighted_output_matrix @ modes.right)
        inputs = np.concatenate([(adjoint_after @ modes.right)[None], weighted_innovations[::-1]])
        return _run_recursions(modes.values, inputs)[::-1]

    @cached_property
    def _variances(self) -> tuple[Array, Array]:
        """Variances of the outputs (o,), filtered and smoothed."""
        return self.matrices.output_variances(self.outputs)

    def variance(self, first: int, count: int, smoothed: bool) -> Array:
        """Return the variance (count, o), the same at all times."""
        return np.tile(self._variances[int(smoothed)], (count, 1))

    @cached_property
    def whitening_matrix(self) -> Array:
        """V (c, c) with V S V' = 1."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.matrices.S)), float)

    def whiten_innovations(self, filter_block: FilterBlock) -> Array:
        """Return V e (n, c)."""
        return np.asarray(filter_block.innovation @ self.whitening_matrix.T)


@dataclass(frozen=True)
class _Modes:
    """L = Re sum of values_i right_i left_i over one of each conjugate pair; x = Re(right (left x)).

    `values` (m,), `right` (N, m), `left` (m, N).
    """

    values: ComplexArray
    right: ComplexArray
    left: ComplexArray


def _modes(L: Array) -> _Modes:
    values, vectors = np.linalg.eig(L)
    left = np.linalg.inv(vectors)
    upper_half = values.imag >= 0
    weight = np.where(values.imag[upper_half] > 0, 2.0, 1.0)
    # The weight of a pair is split evenly, so that the transposed recursion has the same form.
    root = np.sqrt(weight)
    return _Modes(values[upper_half].astype(complex), vectors[:, upper_half] * root, left[upper_half] * root[:, None])


def _run_recursions(values: ComplexArray, inputs: ComplexArray) -> ComplexArray:
    """Return s[0] = inputs[0], s[k] = value s[k-1] + inputs[k] by mode (column), real modes in real arithmetic."""
    rows = np.ascontiguousarray(inputs.T, dtype=complex)
    diagonals = np.ones((2, len(inputs)), complex, order="F")  # the main diagonal, and the one below it
    real_diagonals = diagonals.real.copy(order="F")
    for row, value in zip(rows, values, strict=True):
        if value.imag:
            diagonals[1] = -value
            row[:] = ztbsv(1, diagonals, row, lower=1, diag=1)
        else:
            real_diagonals[1] = -value.real
            row[:] = dtbsv(1, real_diagonals, row.real, lower=1, diag=1)
    return rows.T


def _real_product(states: ComplexArray, rows: ComplexArray) -> Array:
    """Return Re(states rows') (n, o) as one real product."""
    return np.asarray(states.real @ rows.real.T - states.imag @ rows.imag.T)
