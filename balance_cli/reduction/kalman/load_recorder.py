"""Load histories and harmonics, revolution by revolution and on average, from blocks of estimates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.reduction.kalman.load_history import LoadHistory, LoadTrack
from balance_cli.reduction.kalman.segments import Estimates, MarkedEstimates
from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.signals.rotor.edge_weight import edge_weight

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

EXTRA_HARMONICS = 4
"""Harmonics regressed beyond those that are kept, so that they do not leak into these."""


@dataclass(frozen=True)
class RecorderSettings:
    """What converts estimates to loads: mean loads (m,) with their sigma, components, sample times and azimuth.

    `step` [s] between samples, `state_lead_time` [s] of the states, `max_harmonic`, `revolutions` first and last of the
    mean amplitudes; `has_oscillators`: whether the estimates hold the pairs of oscillators.
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
    """Takes estimates in order, passes load histories to a sink, and keeps the sums for the harmonics."""

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
        """Add a block; samples before the first and after the last pulse are left out."""
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
        """Add to the mean of each revolution, weighted by a raised cosine over two revolutions about its middle.

        A plain mean over a revolution would contain a part of the harmonics, because a revolution is not a whole number
        of samples.
        """
        count, turns = psi / (2 * np.pi), self._settings.azimuth.turns
        before = np.floor(count - 0.5).astype(int)
        for turn in (before, before + 1):
            inside = (turn >= 0) & (turn < turns)
            weight = np.cos(0.5 * np.pi * (count - turn - 0.5)[inside]) ** 2
            np.add.at(self._count, turn[inside], weight)
            np.add.at(self._sums, turn[inside], loads[inside] * weight[:, None])
        self._mean_sigma[np.minimum(count.astype(int), turns - 1)] = sigma

    def _add_marked(self, marked: MarkedEstimates) -> None:
        """Add the amplitudes alpha - j beta of pairs p + j q = (alpha + j beta) exp(-j n psi)."""
        settings, m = self._settings, self._sums.shape[1]
        count = settings.azimuth.extrapolated_count(marked.samples * settings.step + settings.state_lead_time)
        turn = np.clip(count.astype(int), 0, settings.azimuth.turns - 1)
        shape = (len(turn), m, settings.max_harmonic, 2)
        pairs, variance = marked.outputs.reshape(shape), marked.variance.reshape(shape).mean(axis=3)
        phasors = np.exp(-2j * np.pi * count[:, None] * np.arange(1, settings.max_harmonic + 1))
        amplitudes = np.conj(pairs[..., 0] + 1j * pairs[..., 1])
        self._harmonic_amplitudes[turn] = amplitudes.swapaxes(1, 2) * phasors[:, :, None]
        self._sigma[turn] = np.sqrt(variance.swapaxes(1, 2))

    def mean_amplitudes(self) -> ComplexArray:
        """Return harmonics 0 to `max_harmonic` (n + 1, m) over the settings' revolutions, by regression on azimuth."""
        n = self._settings.max_harmonic
        # Of the further harmonics one may lie at half the sample rate, where its sine is zero in every sample.
        coefficients = np.linalg.lstsq(self._gram, self._moment, rcond=None)[0]
        amplitude = coefficients[: n + 1].astype(complex)
        amplitude[1:] -= 1j * coefficients[n + EXTRA_HARMONICS + 1 : 2 * n + EXTRA_HARMONICS + 1]
        return amplitude

    def track(self) -> LoadTrack | None:
        """Return the harmonics from revolution to revolution; None without oscillators."""
        if not self._settings.has_oscillators:
            return None
        means = self._sums / np.maximum(self._count, 1.0)[:, None]
        means[[0, -1]] = np.nan
        amplitude = np.concatenate([means[:, None, :].astype(complex), self._harmonic_amplitudes], axis=1)
        sigma = np.concatenate([self._mean_sigma[:, None, :], self._sigma], axis=1)
        middle = self._settings.azimuth.time_of(np.arange(self._settings.azimuth.turns) + 0.5)
        return LoadTrack(middle, amplitude, sigma)


def _load_history(settings: RecorderSettings, time: Array, loads: Array, sigma: Array) -> LoadHistory:
    columns = [COMPONENTS.index(name) for name in settings.components]
    values = np.full((2, len(time), len(COMPONENTS)), np.nan)
    values[0][:, columns], values[1][:, columns] = loads, sigma
    return LoadHistory(settings.run, time, values[0], values[1])
