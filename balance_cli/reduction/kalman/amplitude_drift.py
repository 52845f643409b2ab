"""How fast the amplitudes of the rotor's harmonics drift: the likelihood of their changes from window to window.

In each window of some revolutions the loads' amplitudes come from regression on azimuth and the response at the speed
there. A random walk seen through noise of variance r has changes d[w] = a[w+1] - a[w] whose covariance is tridiagonal,
q + 2 r on and -r beside the diagonal; sine functions are its eigenvectors, with eigenvalues q + 2 r (1 - cos theta_j).
The drift of a component is one rate relative to the size of its harmonics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import read_channels
from balance_cli.io.errors import UserError
from balance_cli.model.state_space import StateSpace
from balance_cli.reduction.kalman.load_models import LoadLayer, Oscillators
from balance_cli.signals.channel_noise import CleanRecord
from balance_cli.signals.rotor.azimuth import Azimuth

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

WINDOW_REVOLUTIONS = 16
MIN_WINDOWS = 8
"""Windows into which a short record is cut at least."""
EXTRA_HARMONICS = 4
"""Harmonics regressed beyond those that are asked for."""
DRIFT_RATES = np.geomspace(1e-4, 3.0, 46)
"""Relative drifts in one second (square root of time) that are tried."""
NOISE_FACTORS = np.geomspace(1.0, 100.0, 13)
"""Factors on the variance of noise that are tried: a response off its window's mean scatters too."""
OUTLIER_LIMIT = 3.0
SIZE_MARGIN = 3.0
"""Times its usual size that an amplitude may have in the long run."""
AVERAGING_TIME = 5.0
"""Time [s] over which an amplitude is averaged at most: drift is never said to be less than that asks for."""


@dataclass(frozen=True)
class WindowAmplitudes:
    """Loads' amplitudes (w, h, m) in windows, variance (h, m) of each by noise of the channels; `apart` [s] of them."""

    values: ComplexArray
    variance: Array
    spacing: float


def fit_drifting_harmonics(
    clean_record: CleanRecord,
    space: StateSpace,
    columns: Sequence[int],
    noise: Array,
    azimuth: Azimuth,
    max_harmonic: int,
    random_layers: Sequence[LoadLayer],
) -> Oscillators:
    """Oscillators for harmonics 1 to `highest`, as large and as restless as the record's.

    Loads `between` the harmonics scatter the amplitudes of a window too, and are no drift.
    """
    amplitudes = fit_window_amplitudes(clean_record, space, columns, noise, azimuth, max_harmonic)
    orders = np.arange(1, max_harmonic + 1)
    density = np.sum([layer.spectrum(np.asarray(azimuth.mean_rate * orders, float)) for layer in random_layers], axis=0)
    amplitudes = replace(amplitudes, variance=amplitudes.variance + 4.0 * density / amplitudes.spacing)
    size = np.sqrt(np.mean(np.abs(amplitudes.values) ** 2, axis=0) + amplitudes.variance)
    # The noise of an amplitude, for one second of averaging, decides how slow a drift can be of any use.
    least = np.sqrt(amplitudes.variance * amplitudes.spacing) / AVERAGING_TIME
    rate = estimate_relative_drift(amplitudes) if len(amplitudes.values) > 2 else np.zeros(size.shape[1])
    return Oscillators(np.maximum(rate * size, least), SIZE_MARGIN * size, tuple(orders.tolist()))


def fit_window_amplitudes(
    clean_record: CleanRecord,
    space: StateSpace,
    columns: Sequence[int],
    noise: Array,
    azimuth: Azimuth,
    max_harmonic: int,
) -> WindowAmplitudes:
    """Regression of all channels on azimuth in consecutive windows, then least squares weighted by noise.

    UserError where no window lies in a sound stretch.
    """
    rows, variances = [], []
    turns = int(np.clip(azimuth.turns // MIN_WINDOWS, 1, WINDOW_REVOLUTIONS))
    for first, stop in _windows(clean_record, azimuth, turns):
        time = np.arange(first, stop) * clean_record.step
        y = _fit_harmonics(
            azimuth.psi(time), read_channels(clean_record.run, clean_record.names, first, stop), max_harmonic
        )
        speed = turns / (time[-1] - time[0] + clean_record.step)
        T = space.response(speed * np.arange(1, max_harmonic + 1))[:, :, list(columns)] / np.sqrt(noise)[:, None]
        covariance = np.linalg.inv(T.conj().swapaxes(1, 2) @ T)
        rows.append(np.einsum("hij,hcj,hc->hi", covariance, T.conj(), y / np.sqrt(noise)))
        variances.append(2.0 * np.einsum("hii->hi", covariance).real / len(time))
    if not rows:
        raise UserError(
            "no sound stretch holds a few revolutions", str(clean_record.run.path or clean_record.run.name), "channels"
        )
    return WindowAmplitudes(np.array(rows), np.mean(variances, axis=0), turns / azimuth.mean_rate)


def _windows(clean_record: CleanRecord, azimuth: Azimuth, turns: int) -> list[tuple[int, int]]:
    """First sample and end of each window of so many revolutions that lies in a clean span."""
    edges = azimuth.time_of(np.arange(0, azimuth.turns + 1, turns)) / clean_record.step
    pairs = [(int(np.ceil(a)), int(np.ceil(b))) for a, b in pairwise(edges)]
    return [(a, b) for a, b in pairs if any(start <= a and b <= stop for start, stop in clean_record.spans)]


def _fit_harmonics(psi: Array, y: Array, max_harmonic: int) -> ComplexArray:
    """Amplitudes (highest, c) of harmonics 1 to `highest` beside a mean, a slope and some higher harmonics."""
    angle = np.outer(psi, np.arange(1, max_harmonic + EXTRA_HARMONICS + 1))
    basis = np.column_stack([np.ones(len(psi)), np.linspace(-1, 1, len(psi)), np.cos(angle), np.sin(angle)])
    amplitudes = np.linalg.lstsq(basis, y, rcond=None)[0][2:]
    n = max_harmonic + EXTRA_HARMONICS
    return np.asarray(amplitudes[:max_harmonic] - 1j * amplitudes[n : n + max_harmonic])


def estimate_relative_drift(amplitudes: WindowAmplitudes) -> Array:
    """Most likely drift (m,) in one second relative to the size of a harmonic, alike for all of a component."""
    changes = _clip_changes(np.diff(amplitudes.values, axis=0))
    lines = scipy.fft.dst(changes.real, type=1, axis=0, norm="ortho") ** 2
    lines = lines + scipy.fft.dst(changes.imag, type=1, axis=0, norm="ortho") ** 2
    count = len(changes)
    away = 2.0 * (1.0 - np.cos(np.pi * np.arange(1, count + 1) / (count + 1)))
    size = np.mean(np.abs(amplitudes.values) ** 2, axis=0)
    # Real and imaginary part have half of the variance each.
    noise = NOISE_FACTORS[:, None, None, None] * 0.5 * amplitudes.variance * away[:, None, None]
    rates = np.concatenate([[0.0], DRIFT_RATES])

    def misfit(rate: float) -> Array:
        """For every factor on the noise (f, m)."""
        eigenvalue = rate**2 * size * amplitudes.spacing + noise
        return np.asarray(np.sum(np.log(eigenvalue) + 0.5 * lines / eigenvalue, axis=(1, 2)))

    value = np.stack([misfit(rate) for rate in rates])
    best = np.argmin(np.min(value, axis=1), axis=0)
    return np.asarray(rates[best])


def _clip_changes(changes: ComplexArray) -> ComplexArray:
    """Changes cut down to so many times their usual size: a step of the mean in a window is no drift."""
    usual = np.sqrt(np.median(np.abs(changes) ** 2, axis=0) / np.log(2.0)) + np.finfo(float).tiny
    return np.asarray(changes * np.minimum(1.0, OUTLIER_LIMIT * usual / np.maximum(np.abs(changes), 1e-300)))
