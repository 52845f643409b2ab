"""From estimates block by block to what a user asks for: load histories, amplitudes that move, their mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.reduction.kalman.load_history import LoadHistory, LoadTrack
from balance_cli.reduction.kalman.segments import Estimates, MarkedEstimates
from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.signals.rotor.harmonics import edge_weight

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

EXTRA_HARMONICS = 4
"""Harmonics regressed beyond those asked for, so that they do not leak into these."""


@dataclass(frozen=True)
class RecorderSettings:
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
    state_lead_time: float
    max_harmonic: int
    revolutions: tuple[int, int]
    has_oscillators: bool


class LoadRecorder:
    """Takes estimates in order; hands load histories on; holds sums for amplitudes only."""

    def __init__(self, settings: RecorderSettings, sink: Callable[[LoadHistory], None] | None) -> None:
        self._settings, self._sink = settings, sink
        columns, m = 2 * (settings.max_harmonic + EXTRA_HARMONICS) + 1, len(settings.components)
        self._gram, self._moment = np.zeros((columns, columns)), np.zeros((columns, m))
        turns = settings.azimuth.turns
        self._sums, self._count = np.zeros((turns, m)), np.zeros(turns)
        self._harmonic_amplitudes = np.full((turns, settings.max_harmonic, m), np.nan, complex)
        self._sigma = np.full((turns, settings.max_harmonic, m), np.nan)
        self._mean_sigma = np.full((turns, m), np.nan)

    def add(self, estimates: Estimates) -> None:
        """One block; what lies outside the pulses is left out."""
        settings = self._settings
        time: Array = (
            estimates.first + np.arange(len(estimates.loads), dtype=float)
        ) * settings.step + settings.state_lead_time
        inside = (time >= settings.azimuth.first) & (time <= settings.azimuth.last)
        if not inside.any():
            return
        time = time[inside]
        loads = np.asarray(settings.mean + estimates.loads[inside], float)
        sigma = np.asarray(np.sqrt(estimates.variance[inside] + settings.mean_sigma**2), float)
        psi = settings.azimuth.psi(time)
        self._add_mean(psi, loads)
        self._add_revolution_means(psi, loads, sigma)
        if estimates.marked is not None:
            self._add_marked(estimates.marked)
        if self._sink is not None:
            self._sink(_load_history(settings, time, loads, sigma))

    def _add_mean(self, psi: Array, loads: Array) -> None:
        first, last = self._settings.revolutions
        weight = edge_weight(psi / (2 * np.pi), first, last)
        angle = np.outer(psi, np.arange(self._settings.max_harmonic + EXTRA_HARMONICS + 1))
        basis = np.hstack([np.cos(angle), np.sin(angle[:, 1:])])
        self._gram += (basis * weight[:, None]).T @ basis
        self._moment += (basis * weight[:, None]).T @ loads

    def _add_revolution_means(self, psi: Array, loads: Array, sigma: Array) -> None:
        """Means about the middle of each revolution, by a raised cosine over two: no harmonic leaks into these.

        A plain mean would take in a part of them: no whole number of samples makes a revolution.
        """
        count, turns = psi / (2 * np.pi), self._settings.azimuth.turns
        before = np.floor(count - 0.5).astype(int)
        for turn in (before, before + 1):
            mine = (turn >= 0) & (turn < turns)
            weight = np.cos(0.5 * np.pi * (count - turn - 0.5)[mine]) ** 2
            np.add.at(self._count, turn[mine], weight)
            np.add.at(self._sums, turn[mine], loads[mine] * weight[:, None])
        self._mean_sigma[np.minimum(count.astype(int), turns - 1)] = sigma

    def _add_marked(self, marked: MarkedEstimates) -> None:
        """Amplitudes alpha - j beta, the pairs being p + j q = (alpha + j beta) exp(-j n psi)."""
        settings, m = self._settings, self._sums.shape[1]
        count = settings.azimuth.extrapolated_count(marked.samples * settings.step + settings.state_lead_time)
        turn = np.clip(count.astype(int), 0, settings.azimuth.turns - 1)
        shape = (len(turn), m, settings.max_harmonic, 2)
        z, spread = marked.outputs.reshape(shape), marked.variance.reshape(shape).mean(axis=3)
        turned = np.exp(-2j * np.pi * count[:, None] * np.arange(1, settings.max_harmonic + 1))
        self._harmonic_amplitudes[turn] = np.conj(z[..., 0] + 1j * z[..., 1]).swapaxes(1, 2) * turned[:, :, None]
        self._sigma[turn] = np.sqrt(spread.swapaxes(1, 2))

    def mean_amplitudes(self) -> ComplexArray:
        """Harmonics 0 to `highest` (n + 1, m) over the revolutions of the frame, by regression on azimuth."""
        n = self._settings.max_harmonic
        found = np.linalg.solve(self._gram, self._moment)
        amplitude = found[: n + 1].astype(complex)
        amplitude[1:] -= 1j * found[n + EXTRA_HARMONICS + 1 : 2 * n + EXTRA_HARMONICS + 1]
        return amplitude

    def track(self) -> LoadTrack | None:
        """Amplitudes from revolution to revolution; None where no oscillators follow them."""
        if not self._settings.has_oscillators:
            return None
        steady = self._sums / np.maximum(self._count, 1.0)[:, None]
        steady[[0, -1]] = np.nan
        amplitude = np.concatenate([steady[:, None, :].astype(complex), self._harmonic_amplitudes], axis=1)
        sigma = np.concatenate([self._mean_sigma[:, None, :], self._sigma], axis=1)
        middle = self._settings.azimuth.time_of(np.arange(self._settings.azimuth.turns) + 0.5)
        return LoadTrack(middle, amplitude, sigma)


def _load_history(settings: RecorderSettings, time: Array, loads: Array, sigma: Array) -> LoadHistory:
    mine = [COMPONENTS.index(name) for name in settings.components]
    values = np.full((2, len(time), len(COMPONENTS)), np.nan)
    values[0][:, mine], values[1][:, mine] = loads, sigma
    return LoadHistory(settings.run, time, values[0], values[1])
