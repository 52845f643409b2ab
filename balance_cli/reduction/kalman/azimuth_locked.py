"""The filter whose loads turn with the rotor: oscillators locked to the measured azimuth.

From one sample to the next the oscillators of harmonic n turn by n times the measured step of azimuth, whatever the
speed does. Seen from the turning oscillators the model changes with the speed alone, and slowly: its gain is the steady
one of the speed at hand, taken from a grid of speeds (gain scheduling). What the state does is exact at every speed;
only how its errors are weighed lags behind a speed that changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman.steady_filter import FilterBlock, MarkedOutputs, Outputs, SteadyFilter

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

MAX_PHASE_DEVIATION = 0.2
"""Departure [rad] of the fastest oscillator from an even turning that the information of a part is indifferent to."""
MIN_PART_SAMPLES = 64
"""Samples of a part."""
SPEED_SUBDIVISIONS = 32
"""Steps of speed for each of the grid of filters: matrices in between are on the straight line, but on no other."""


@dataclass(frozen=True)
class OscillatorStates:
    """Oscillators among the states: pairs from `first` on, of the harmonics `orders` (h,), in units of `size` (2 h,).

    `azimuth` gives psi [rad] at sample numbers, also a little beyond the record; `step` [s] between samples.
    """

    first: int
    orders: Array
    size: Array
    azimuth: Callable[[Array], Array]
    step: float

    @property
    def states(self) -> slice:
        """Where the pairs are."""
        return slice(self.first, self.first + 2 * len(self.orders))

    def phasors(self, first: int, count: int) -> ComplexArray:
        """What p + j q of each pair (count, h) is multiplied by from each sample to the next."""
        steps = np.diff(self.azimuth(np.arange(first, first + count + 1, dtype=float)))
        return np.asarray(np.exp(-1j * steps[:, None] * self.orders), complex)

    def speed(self, first: int, count: int) -> Array:
        """Speed (count,) [Hz] from each sample to the next."""
        steps = np.diff(self.azimuth(np.arange(first, first + count + 1, dtype=float)))
        return np.asarray(steps / (2 * np.pi * self.step))


def rotation_matrix(phasors: ComplexArray) -> Array:
    """Block diagonal matrix (2 h, 2 h) that multiplies each p + j q by one of the phasors (h,)."""
    blocks = np.zeros((2 * len(phasors),) * 2)
    even = np.arange(0, 2 * len(phasors), 2)
    blocks[even, even], blocks[even, even + 1] = phasors.real, -phasors.imag
    blocks[even + 1, even], blocks[even + 1, even + 1] = phasors.imag, phasors.real
    return blocks


class _InterpolatedMatrices:
    """Matrices (a, b) at every step of speed, from those (g, a, b) of the grid: made when they are first asked for."""

    def __init__(self, matrices: Array) -> None:
        self._matrices = matrices
        self._cache: dict[int, Array] = {}

    def __getitem__(self, step: int) -> Array:
        found = self._cache.get(step)
        if found is None:
            cell, share = divmod(step, SPEED_SUBDIVISIONS)
            found = self._matrices[cell]
            if share:
                found = found + share / SPEED_SUBDIVISIONS * (self._matrices[cell + 1] - found)
            self._cache[step] = found
        return found


@dataclass(frozen=True)
class AzimuthLockedFilter:
    """Steady filters (g,) at rising `speeds` (g,) [Hz] of one set of channels, and how the oscillators turn.

    The pairs of the oscillators are given out at the samples `marked` alone, in rising order.
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
        """It is not."""
        return False

    def at(self, first: int, count: int = 1) -> SteadyFilter:
        """The filter of the speed nearest to the mean of so many samples; its pairs turn by just what these turn."""
        turn = (self.oscillator_states.azimuth(np.array([first, first + count], float)) @ [-1.0, 1.0]) / count
        near = int(np.argmin(np.abs(self.speeds - turn / (2 * np.pi * self.oscillator_states.step))))
        L, s = self._transition_without_rotation[near].copy(), self.oscillator_states.states
        L[s, s] += rotation_matrix(np.exp(-1j * turn * self.oscillator_states.orders))
        return self.filters[near].with_transition(L)

    def quasi_steady_parts(self, first: int, count: int) -> list[tuple[int, int]]:
        """Halves of halves, until no oscillator departs from an even turning by more than `MAX_PHASE_DEVIATION`."""
        psi = self.oscillator_states.azimuth(np.arange(first, first + count + 1, dtype=float))
        bend = np.abs(psi - np.linspace(psi[0], psi[-1], count + 1)).max() * self.oscillator_states.orders.max()
        if bend <= MAX_PHASE_DEVIATION or count < 2 * MIN_PART_SAMPLES:
            return [(first, count)]
        half = count // 2
        return self.quasi_steady_parts(first, half) + self.quasi_steady_parts(first + half, count - half)

    @cached_property
    def _transition_without_rotation(self) -> Array:
        """L without the turning itself (g, N, N), which is done apart."""
        s = self.oscillator_states.states
        parts = []
        for one in self.filters:
            L = one.L.copy()
            L[s, s] -= one.model.F[s, s]
            parts.append(L)
        return np.stack(parts)

    def _grid_steps(self, first: int, count: int) -> Index:
        """Place (count,) of the speed at each sample in a grid that is `SPEED_SUBDIVISIONS` than that of the
        filters.
        """
        place = np.interp(
            self.oscillator_states.speed(first, count), self.speeds, np.arange(len(self.speeds), dtype=float)
        )
        return np.asarray(np.rint(SPEED_SUBDIVISIONS * place), np.intp)

    @cached_property
    def _transitions(self) -> _InterpolatedMatrices:
        return _InterpolatedMatrices(self._transition_without_rotation)

    def _apply_scheduled_gain(self, rows: Array, first: int, matrices: Array) -> Array:
        """Rows (n, a) times the matrices (g, a, b) of the speed at each sample: (n, b)."""
        steps, between = self._grid_steps(first, len(rows)), _InterpolatedMatrices(matrices)
        here = np.unique(steps)
        if len(here) == 1:
            return np.asarray(rows @ between[int(here[0])])
        total = np.empty((len(rows), matrices.shape[2]))
        for step in here:
            mine = steps == step
            total[mine] = rows[mine] @ between[int(step)]
        return total

    def forward_pass(self, first: int, y: Array, start: Array) -> FilterBlock:
        """Innovations (n, c) and predicted outputs, sample by sample."""
        inputs = self._apply_scheduled_gain(y, first, np.stack([one.K.T for one in self.filters]))
        states = self._run_forward(first, inputs, start)
        H = self.filters[0].model.H
        marked = states[self._marked_rows(first, len(y))] @ self._oscillator_rows.T
        # A copy: a view would keep the states of all samples as long as the piece itself.
        return FilterBlock(first, y - states[:-1] @ H.T, states[:-1] @ self.outputs.T, states[-1].copy(), marked)

    def _marked_rows(self, first: int, count: int) -> Index:
        low, high = np.searchsorted(self.marked, [first, first + count])
        return self.marked[low:high] - first

    @cached_property
    def _oscillator_rows(self) -> Array:
        """The rows (2 h, N) of the pairs."""
        return np.asarray(
            self.oscillator_states.size[:, None] * np.eye(len(self.filters[0].L))[self.oscillator_states.states]
        )

    def marked_outputs(self, first: int, count: int) -> MarkedOutputs | None:
        """Where the pairs are given out."""
        near, pairs = self.at(first), self._oscillator_rows
        updated, smoothed = near.output_variances(pairs)
        return MarkedOutputs(self._marked_rows(first, count), pairs, updated, smoothed)

    def _run_forward(self, first: int, inputs: Array, start: Array) -> Array:
        """States (n + 1, N)."""
        steps, transitions = self._grid_steps(first, len(inputs)).tolist(), self._transitions
        phasors, turned = self.oscillator_states.phasors(first, len(inputs)), self.oscillator_states.states
        states = np.empty((len(inputs) + 1, len(start)))
        states[0] = start
        for k, step in enumerate(steps):
            x = states[k]
            new = transitions[step] @ x
            new += inputs[k]
            new[turned] += (phasors[k] * x[turned].view(complex)).view(float)
            states[k + 1] = new
        return states

    def updated(self, filter_block: FilterBlock) -> Outputs:
        """Given y up to the sample itself."""
        gains = np.stack([(one.outputs @ one.update_gain).T for one in self.filters])
        loads = filter_block.predicted + self._apply_scheduled_gain(filter_block.innovation, filter_block.first, gains)
        assert filter_block.marked is not None
        at, near = self._marked_rows(filter_block.first, len(loads)), self.at(filter_block.first)
        return Outputs(
            loads, filter_block.marked + filter_block.innovation[at] @ (self._oscillator_rows @ near.update_gain).T
        )

    def backward_pass(self, filter_block: FilterBlock, adjoint_after: Array) -> tuple[Outputs, Array]:
        """Given y after them too, and rho at the first sample."""
        weighted_innovations = self._apply_scheduled_gain(
            filter_block.innovation, filter_block.first, np.stack([one.weighted for one in self.filters])
        )
        adjoint = self._run_backward(filter_block.first, weighted_innovations, adjoint_after)
        return self._smooth_outputs(filter_block, adjoint), adjoint[0].copy()

    def fixed_lag_pass(self, filter_block: FilterBlock, count: int, lag: int) -> Outputs:
        """Each sample given `lag` innovations after it, and up to twice as many: stretches of `lag` at a time."""
        weighted_innovations = self._apply_scheduled_gain(
            filter_block.innovation, filter_block.first, np.stack([one.weighted for one in self.filters])
        )
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

    def _smooth_outputs(self, filter_block: FilterBlock, adjoint: Array) -> Outputs:
        """X + P rho at every sample."""
        spread = np.stack([(one.outputs @ one.P).T for one in self.filters])
        loads = filter_block.predicted + self._apply_scheduled_gain(adjoint, filter_block.first, spread)
        assert filter_block.marked is not None
        at, near = self._marked_rows(filter_block.first, len(loads)), self.at(filter_block.first)
        return Outputs(loads, filter_block.marked + adjoint[at] @ (self._oscillator_rows @ near.P).T)

    def _run_backward(self, first: int, weighted_innovations: Array, adjoint_after: Array) -> Array:
        """Rho (n, N) at each sample."""
        steps, transitions = self._grid_steps(first, len(weighted_innovations)).tolist(), self._transitions
        phasors, turned = (
            self.oscillator_states.phasors(first, len(weighted_innovations)).conj(),
            self.oscillator_states.states,
        )
        adjoint = np.empty((len(weighted_innovations), len(adjoint_after)))
        rho = adjoint_after
        for k in range(len(weighted_innovations) - 1, -1, -1):
            new = rho @ transitions[steps[k]]
            new += weighted_innovations[k]
            new[turned] += (phasors[k] * rho[turned].view(complex)).view(float)
            adjoint[k] = rho = new
        return adjoint

    def variance(self, first: int, count: int, smoothed: bool) -> Array:
        """That of the speed at each sample."""
        each = np.stack([one.variance(first, 1, smoothed) for one in self.filters])
        return self._apply_scheduled_gain(np.ones((count, 1)), first, each)

    def whiten_innovations(self, filter_block: FilterBlock) -> Array:
        """V e (n, c), V that of the speed."""
        return self._apply_scheduled_gain(
            filter_block.innovation, filter_block.first, np.stack([one.whitening_matrix.T for one in self.filters])
        )
