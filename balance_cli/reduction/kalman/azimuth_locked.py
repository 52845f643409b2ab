"""The filter of loads with rotor harmonics: oscillators locked to the measured azimuth.

From one sample to the next the oscillators of harmonic n rotate by n times the measured step of azimuth, whatever the
speed does. In coordinates that rotate with the oscillators the model depends on the speed only, and changes slowly. Its
gain is therefore the steady one of the current speed, interpolated on a grid of speeds (gain scheduling). The state
equation is exact at every speed; only the gain lags behind a changing speed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman.channel_filter import FilterBlock, MarkedOutputs, Outputs
from balance_cli.reduction.kalman.steady_filter import SteadyFilter
from balance_cli.reduction.kalman.steady_matrices import SteadyMatrices

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

MAX_PHASE_DEVIATION = 0.2
"""Deviation [rad] of the fastest oscillator from uniform rotation within a part: the phase error costs 2 % of the
coherent sum of its information (1 - cos 0.2)."""
MIN_PART_SAMPLES = 64
"""Samples below which a part is not halved further; a speed hardly changes within 0.1 s."""
SPEED_SUBDIVISIONS = 32
"""Interpolated matrices for each interval of the speed grid: 0.01 Hz apart for the grid of `run_filters`, so that few
distinct matrices serve all samples."""


@dataclass(frozen=True)
class OscillatorStates:
    """Oscillators among the states: pairs from state `first` on, of harmonics `orders` (h,), in units of `size` (2 h,).

    `azimuth` returns psi [rad] at sample numbers, also slightly outside the record; `step` [s] between samples.
    """

    first: int
    orders: Array
    size: Array
    azimuth: Callable[[Array], Array]
    step: float

    @property
    def states(self) -> slice:
        """Slice of the pairs."""
        return slice(self.first, self.first + 2 * len(self.orders))

    def phasors(self, first: int, count: int) -> ComplexArray:
        """Return the factors (count, h) on p + j q of each pair from each sample to the next."""
        steps = np.diff(self.azimuth(np.arange(first, first + count + 1, dtype=float)))
        return np.asarray(np.exp(-1j * steps[:, None] * self.orders), complex)

    def speed(self, first: int, count: int) -> Array:
        """Return the mean speed (count,) [Hz] from each sample to the next."""
        steps = np.diff(self.azimuth(np.arange(first, first + count + 1, dtype=float)))
        return np.asarray(steps / (2 * np.pi * self.step))


def rotation_matrix(phasors: ComplexArray) -> Array:
    """Return the block diagonal matrix (2 h, 2 h) that multiplies the pairs p + j q by the phasors (h,)."""
    blocks = np.zeros((2 * len(phasors),) * 2)
    even = np.arange(0, 2 * len(phasors), 2)
    blocks[even, even], blocks[even, even + 1] = phasors.real, -phasors.imag
    blocks[even + 1, even], blocks[even + 1, even + 1] = phasors.imag, phasors.real
    return blocks


class _InterpolatedMatrices:
    """Matrices (a, b) at steps of speed, interpolated linearly between those (g, a, b) of the grid at first use."""

    def __init__(self, matrices: Array) -> None:
        self._matrices = matrices
        self._cache: dict[int, Array] = {}

    def __getitem__(self, step: int) -> Array:
        matrix = self._cache.get(step)
        if matrix is None:
            interval, part = divmod(step, SPEED_SUBDIVISIONS)
            matrix = self._matrices[interval]
            if part:
                matrix = matrix + part / SPEED_SUBDIVISIONS * (self._matrices[interval + 1] - matrix)
            self._cache[step] = matrix
        return matrix


@dataclass(frozen=True)
class AzimuthLockedFilter:
    """Steady filters (g,) of one set of channels at increasing `speeds` (g,) [Hz], and the states of the oscillators.

    The pairs of the oscillators are outputs at the samples `marked` only, in increasing order.
    """

    filters: tuple[SteadyFilter, ...]
    speeds: Array
    oscillator_states: OscillatorStates
    marked: Index

    @property
    def outputs(self) -> Array:
        """U (m, N), the same at all speeds."""
        return self.filters[0].outputs

    @property
    def time_invariant(self) -> bool:
        """Always false: the matrices follow the azimuth."""
        return False

    def at(self, first: int, count: int = 1) -> SteadyMatrices:
        """Return the matrices of the grid speed nearest to the mean speed; in L the pairs rotate by the mean step."""
        turn = (self.oscillator_states.azimuth(np.array([first, first + count], float)) @ [-1.0, 1.0]) / count
        near = int(np.argmin(np.abs(self.speeds - turn / (2 * np.pi * self.oscillator_states.step))))
        L, s = self._transition_without_rotation[near].copy(), self.oscillator_states.states
        L[s, s] += rotation_matrix(np.exp(-1j * turn * self.oscillator_states.orders))
        return replace(self.filters[near].matrices, L=L)

    def quasi_steady_parts(self, first: int, count: int) -> list[tuple[int, int]]:
        """Halve repeatedly until no oscillator deviates from uniform rotation by more than `MAX_PHASE_DEVIATION`."""
        psi = self.oscillator_states.azimuth(np.arange(first, first + count + 1, dtype=float))
        uniform = np.linspace(psi[0], psi[-1], count + 1)
        deviation = np.abs(psi - uniform).max() * self.oscillator_states.orders.max()
        if deviation <= MAX_PHASE_DEVIATION or count < 2 * MIN_PART_SAMPLES:
            return [(first, count)]
        half = count // 2
        return self.quasi_steady_parts(first, half) + self.quasi_steady_parts(first + half, count - half)

    @cached_property
    def _transition_without_rotation(self) -> Array:
        """L (g, N, N) without the rotation of the pairs, which is applied sample by sample."""
        s = self.oscillator_states.states
        transitions = np.stack([item.matrices.L for item in self.filters])
        transitions[:, s, s] -= np.stack([item.model.F[s, s] for item in self.filters])
        return transitions

    def _grid_steps(self, first: int, count: int) -> Index:
        """Return the index (count,) of the speed at each sample in the grid that `SPEED_SUBDIVISIONS` refines."""
        place = np.interp(
            self.oscillator_states.speed(first, count), self.speeds, np.arange(len(self.speeds), dtype=float)
        )
        return np.asarray(np.rint(SPEED_SUBDIVISIONS * place), np.intp)

    @cached_property
    def _transitions(self) -> _InterpolatedMatrices:
        return _InterpolatedMatrices(self._transition_without_rotation)

    def _apply_scheduled_gain(self, rows: Array, first: int, matrices: Array) -> Array:
        """Return rows (n, a) times the matrices (g, a, b) interpolated at the speed of each sample: (n, b)."""
        steps, interpolated = self._grid_steps(first, len(rows)), _InterpolatedMatrices(matrices)
        distinct = np.unique(steps)
        if len(distinct) == 1:
            return np.asarray(rows @ interpolated[int(distinct[0])])
        products = np.empty((len(rows), matrices.shape[2]))
        for step in distinct:
            at_step = steps == step
            products[at_step] = rows[at_step] @ interpolated[int(step)]
        return products

    def forward_pass(self, first: int, y: Array, start: Array) -> FilterBlock:
        """Return innovations (n, c) and predicted outputs, sample by sample."""
        inputs = self._apply_scheduled_gain(y, first, np.stack([item.matrices.K.T for item in self.filters]))
        states = self._run_forward(first, inputs, start)
        H = self.filters[0].model.H
        marked = states[self._marked_rows(first, len(y))] @ self._oscillator_rows.T
        # A copy: a view would keep the states of all samples alive as long as the block.
        return FilterBlock(first, y - states[:-1] @ H.T, states[:-1] @ self.outputs.T, states[-1].copy(), marked)

    def _marked_rows(self, first: int, count: int) -> Index:
        low, high = np.searchsorted(self.marked, [first, first + count])
        return self.marked[low:high] - first

    @cached_property
    def _oscillator_rows(self) -> Array:
        """Rows (2 h, N) of the pairs."""
        rows = np.eye(self.filters[0].model.order)[self.oscillator_states.states]
        return np.asarray(self.oscillator_states.size[:, None] * rows)

    def marked_outputs(self, first: int, count: int) -> MarkedOutputs | None:
        """Return the samples at which the pairs are outputs."""
        rows = self._oscillator_rows
        return MarkedOutputs(self._marked_rows(first, count), rows, *self.at(first).output_variances(rows))

    def _run_forward(self, first: int, inputs: Array, start: Array) -> Array:
        """Return the states (n + 1, N)."""
        steps, transitions = self._grid_steps(first, len(inputs)).tolist(), self._transitions
        phasors, pairs = self.oscillator_states.phasors(first, len(inputs)), self.oscillator_states.states
        states = np.empty((len(inputs) + 1, len(start)))
        states[0] = start
        for k, step in enumerate(steps):
            x = states[k]
            new = transitions[step] @ x
            new += inputs[k]
            new[pairs] += (phasors[k] * x[pairs].view(complex)).view(float)
            states[k + 1] = new
        return states

    def filtered_outputs(self, filter_block: FilterBlock) -> Outputs:
        """Return the outputs at each sample, given y up to that sample."""
        gains = np.stack([(item.outputs @ item.matrices.update_gain).T for item in self.filters])
        loads = filter_block.predicted + self._apply_scheduled_gain(filter_block.innovation, filter_block.first, gains)
        assert filter_block.marked is not None
        marked_rows = self._marked_rows(filter_block.first, len(loads))
        gain = self._oscillator_rows @ self.at(filter_block.first).update_gain
        return Outputs(loads, filter_block.marked + filter_block.innovation[marked_rows] @ gain.T)

    def backward_pass(self, filter_block: FilterBlock, adjoint_after: Array) -> tuple[Outputs, Array]:
        """Return the smoothed outputs, and rho at the first sample."""
        weighted_innovations = self._weighted_innovations(filter_block)
        adjoint = self._run_backward(filter_block.first, weighted_innovations, adjoint_after)
        return self._smooth_outputs(filter_block, adjoint), adjoint[0].copy()

    def fixed_lag_pass(self, filter_block: FilterBlock, count: int, lag: int) -> Outputs:
        """Return the outputs given `lag` to twice as many innovations after each sample: `lag` samples at a time."""
        weighted_innovations = self._weighted_innovations(filter_block)
        adjoint = np.empty((count, weighted_innovations.shape[1]))
        for start in range(0, count, lag):
            stop = min(start + lag, count)
            back = self._run_backward(
                filter_block.first + start,
                weighted_innovations[start : stop + lag],
                np.zeros(weighted_innovations.shape[1]),
            )
            adjoint[start:stop] = back[: stop - start]
        return self._smooth_outputs(filter_block, adjoint)

    def _weighted_innovations(self, filter_block: FilterBlock) -> Array:
        """Return H' S^-1 e (n, N)."""
        weights = np.stack([item.matrices.weighted_output_matrix for item in self.filters])
        return self._apply_scheduled_gain(filter_block.innovation, filter_block.first, weights)

    def _smooth_outputs(self, filter_block: FilterBlock, adjoint: Array) -> Outputs:
        """Return the outputs of x + P rho."""
        spread = np.stack([(item.outputs @ item.matrices.P).T for item in self.filters])
        loads = filter_block.predicted + self._apply_scheduled_gain(adjoint, filter_block.first, spread)
        assert filter_block.marked is not None
        marked_rows = self._marked_rows(filter_block.first, len(loads))
        marked_spread = self._oscillator_rows @ self.at(filter_block.first).P
        return Outputs(loads, filter_block.marked + adjoint[marked_rows] @ marked_spread.T)

    def _run_backward(self, first: int, weighted_innovations: Array, adjoint_after: Array) -> Array:
        """Return rho (n, N) at each sample."""
        count = len(weighted_innovations)
        steps, transitions = self._grid_steps(first, count).tolist(), self._transitions
        phasors, pairs = self.oscillator_states.phasors(first, count).conj(), self.oscillator_states.states
        adjoint = np.empty((count, len(adjoint_after)))
        rho = adjoint_after
        for k in range(count - 1, -1, -1):
            new = rho @ transitions[steps[k]]
            new += weighted_innovations[k]
            new[pairs] += (phasors[k] * rho[pairs].view(complex)).view(float)
            adjoint[k] = rho = new
        return adjoint

    def variance(self, first: int, count: int, smoothed: bool) -> Array:
        """Return the variance (count, m), interpolated at the speed of each sample."""
        variances = np.stack([item.variance(first, 1, smoothed) for item in self.filters])
        return self._apply_scheduled_gain(np.ones((count, 1)), first, variances)

    def whiten_innovations(self, filter_block: FilterBlock) -> Array:
        """Return V e (n, c), with V interpolated at the speed of each sample."""
        whitening = np.stack([item.whitening_matrix.T for item in self.filters])
        return self._apply_scheduled_gain(filter_block.innovation, filter_block.first, whitening)
