"""From estimates block by block to what a user asks for: load histories, amplitudes that move, their mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.reduction.kalman.load_history import History, LoadTrack
from balance_cli.reduction.kalman.segments import Estimates, Marked
from balance_cli.signals.azimuth import Azimuth
from balance_cli.signals.harmonics import edge_weight

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

HIGHER = 4
"""Harmonics regressed beyond those asked for, so that they do not leak into these."""


@dataclass(frozen=True)
class TrackFrame:
    """What turns estimates into loads: their `mean` (m,) with `mean_sigma`, components, clock and azimuth.

    `step` [s] between samples, `ahead` [s] of the states, `highest` harmonic, `revolutions` first and last of the mean
    amplitudes; `pairs`: whether the outputs hold those of oscillators after the loads.
    """

    run: str
    components: tuple[str, ...]
    mean: Array
    mean_sigma: Array
    azimuth: Azimuth
    step: float
    ahead: float
    highest: int
    revolutions: tuple[int, int]
    pairs: bool


class LoadRecorder:
    """Takes estimates in order; hands load histories on; holds sums for amplitudes only."""

    def __init__(self, frame: TrackFrame, sink: Callable[[History], None] | None) -> None:
        self._frame, self._sink = frame, sink
        columns, m = 2 * (frame.highest + HIGHER) + 1, len(frame.components)
        self._gram, self._moment = np.zeros((columns, columns)), np.zeros((columns, m))
        turns = frame.azimuth.turns
        self._sums, self._count = np.zeros((turns, m)), np.zeros(turns)
        self._pairs = np.full((turns, frame.highest, m), np.nan, complex)
        self._sigma = np.full((turns, frame.highest, m), np.nan)
        self._mean_sigma = np.full((turns, m), np.nan)

    def add(self, estimates: Estimates) -> None:
        """One block; what lies outside the pulses is left out."""
        frame = self._frame
        time: Array = (estimates.first + np.arange(len(estimates.loads), dtype=float)) * frame.step + frame.ahead
        inside = (time >= frame.azimuth.first) & (time <= frame.azimuth.last)
        if not inside.any():
            return
        time = time[inside]
        loads = np.asarray(frame.mean + estimates.loads[inside], float)
        sigma = np.asarray(np.sqrt(estimates.variance[inside] + frame.mean_sigma**2), float)
        psi = frame.azimuth.psi(time)
        self._add_mean(psi, loads)
        self._add_turns(psi, loads, sigma)
        if estimates.marked is not None:
            self._add_marked(estimates.marked)
        if self._sink is not None:
            self._sink(_history(frame, time, loads, sigma))

    def _add_mean(self, psi: Array, loads: Array) -> None:
        first, last = self._frame.revolutions
        weight = edge_weight(psi / (2 * np.pi), first, last)
        angle = np.outer(psi, np.arange(self._frame.highest + HIGHER + 1))
        basis = np.hstack([np.cos(angle), np.sin(angle[:, 1:])])
        self._gram += (basis * weight[:, None]).T @ basis
        self._moment += (basis * weight[:, None]).T @ loads

    def _add_turns(self, psi: Array, loads: Array, sigma: Array) -> None:
        """Means about the middle of each revolution, by a raised cosine over two: no harmonic leaks into these.

        A plain mean would take in a part of them: no whole number of samples makes a revolution.
        """
        count, turns = psi / (2 * np.pi), self._frame.azimuth.turns
        before = np.floor(count - 0.5).astype(int)
        for turn in (before, before + 1):
            mine = (turn >= 0) & (turn < turns)
            weight = np.cos(0.5 * np.pi * (count - turn - 0.5)[mine]) ** 2
            np.add.at(self._count, turn[mine], weight)
            np.add.at(self._sums, turn[mine], loads[mine] * weight[:, None])
        self._mean_sigma[np.minimum(count.astype(int), turns - 1)] = sigma

    def _add_marked(self, marked: Marked) -> None:
        """Amplitudes alpha - j beta, the pairs being p + j q = (alpha + j beta) exp(-j n psi)."""
        frame, m = self._frame, self._sums.shape[1]
        count = frame.azimuth.count_beyond(marked.samples * frame.step + frame.ahead)
        turn = np.clip(count.astype(int), 0, frame.azimuth.turns - 1)
        shape = (len(turn), m, frame.highest, 2)
        z, spread = marked.outputs.reshape(shape), marked.variance.reshape(shape).mean(axis=3)
        turned = np.exp(-2j * np.pi * count[:, None] * np.arange(1, frame.highest + 1))
        self._pairs[turn] = np.conj(z[..., 0] + 1j * z[..., 1]).swapaxes(1, 2) * turned[:, :, None]
        self._sigma[turn] = np.sqrt(spread.swapaxes(1, 2))

    def mean_amplitudes(self) -> ComplexArray:
        """Harmonics 0 to `highest` (n + 1, m) over the revolutions of the frame, by regression on azimuth."""
        n = self._frame.highest
        found = np.linalg.solve(self._gram, self._moment)
        amplitude = found[: n + 1].astype(complex)
        amplitude[1:] -= 1j * found[n + HIGHER + 1 : 2 * n + HIGHER + 1]
        return amplitude

    def track(self) -> LoadTrack | None:
        """Amplitudes from revolution to revolution; None where no oscillators follow them."""
        if not self._frame.pairs:
            return None
        steady = self._sums / np.maximum(self._count, 1.0)[:, None]
        steady[[0, -1]] = np.nan
        amplitude = np.concatenate([steady[:, None, :].astype(complex), self._pairs], axis=1)
        sigma = np.concatenate([self._mean_sigma[:, None, :], self._sigma], axis=1)
        middle = self._frame.azimuth.time_of(np.arange(self._frame.azimuth.turns) + 0.5)
        return LoadTrack(middle, amplitude, sigma)


def _history(frame: TrackFrame, time: Array, loads: Array, sigma: Array) -> History:
    mine = [COMPONENTS.index(name) for name in frame.components]
    values = np.full((2, len(time), len(COMPONENTS)), np.nan)
    values[0][:, mine], values[1][:, mine] = loads, sigma
    return History(frame.run, time, values[0], values[1])
