"""Drift of the amplitudes of rotor harmonics, by the likelihood of their changes from window to window.

In each window of some revolutions the amplitudes of the loads come from regression on azimuth and from the response at
the speed of the window. A random walk observed with noise of variance r has changes d[w] = a[w+1] - a[w] with a
tridiagonal covariance, q + 2 r on the diagonal and -r beside it; its eigenvectors are sine functions, with eigenvalues
q + 2 r (1 - cos theta_j). All harmonics of a component have the same drift relative to their size.
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
"""Revolutions of a window: about 1 s, short compared with most maneuvers, and ample for 12 harmonics."""
MIN_WINDOWS = 8
"""Windows into which a short record is divided at least: seven changes determine a variance within a factor of two."""
EXTRA_HARMONICS = 4
"""Harmonics regressed beyond those that are kept, so that they do not leak into these."""
DRIFT_RATES = np.geomspace(1e-4, 3.0, 46)
"""Relative drifts in one second that are tried, from none in any record to several times the amplitude; 25 % apart."""
NOISE_FACTORS = np.geomspace(1.0, 100.0, 13)
"""Factors on the variance of noise that are tried: a response that varies within a window adds scatter."""
OUTLIER_LIMIT = 3.0
"""Typical changes at which a change is clipped: a Rayleigh variable exceeds three times its rms once in 8000."""
SIZE_MARGIN = 3.0
"""Stationary standard deviation of an amplitude over its rms in the record: the prior must not pull it to zero."""
AVERAGING_TIME = 5.0
"""Longest time [s] over which a filter averages an amplitude: the drift is at least what corresponds to it."""


@dataclass(frozen=True)
class WindowAmplitudes:
    """Amplitudes of the loads (w, h, m) in windows `spacing` [s] apart; variance (h, m) of each from channel noise."""

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
    """Return oscillators for harmonics 1 to `max_harmonic` with the size and drift of those in the record.

    The `random_layers` between the harmonics scatter the amplitudes of a window as well; that is not drift.
    """
    amplitudes = fit_window_amplitudes(clean_record, space, columns, noise, azimuth, max_harmonic)
    orders = np.arange(1, max_harmonic + 1)
    density = np.sum([layer.spectrum(np.asarray(azimuth.mean_rate * orders, float)) for layer in random_layers], axis=0)
    amplitudes = replace(amplitudes, variance=amplitudes.variance + 4.0 * density / amplitudes.spacing)
    size = np.sqrt(np.mean(np.abs(amplitudes.values) ** 2, axis=0) + amplitudes.variance)
    # A drift far below the noise of an average over AVERAGING_TIME could not be observed.
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
    """Regress all channels on azimuth in consecutive windows, then solve for the loads, weighted by noise.

    Raises UserError where no window lies in clean samples.
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
            "no part of the record with all channels contains a few revolutions",
            clean_record.run.file,
            "channels",
        )
    return WindowAmplitudes(np.array(rows), np.mean(variances, axis=0), turns / azimuth.mean_rate)


def _windows(clean_record: CleanRecord, azimuth: Azimuth, turns: int) -> list[tuple[int, int]]:
    """Return first sample and end of each window of `turns` revolutions that lies in a clean span."""
    edges = azimuth.time_of(np.arange(0, azimuth.turns + 1, turns)) / clean_record.step
    pairs = [(int(np.ceil(a)), int(np.ceil(b))) for a, b in pairwise(edges)]
    return [(a, b) for a, b in pairs if any(start <= a and b <= stop for start, stop in clean_record.spans)]


def _fit_harmonics(psi: Array, y: Array, max_harmonic: int) -> ComplexArray:
    """Return amplitudes (max_harmonic, c), with a mean, a slope and `EXTRA_HARMONICS` in the regression."""
    angle = np.outer(psi, np.arange(1, max_harmonic + EXTRA_HARMONICS + 1))
    basis = np.column_stack([np.ones(len(psi)), np.linspace(-1, 1, len(psi)), np.cos(angle), np.sin(angle)])
    amplitudes = np.linalg.lstsq(basis, y, rcond=None)[0][2:]
    n = max_harmonic + EXTRA_HARMONICS
    return np.asarray(amplitudes[:max_harmonic] - 1j * amplitudes[n : n + max_harmonic])


def estimate_relative_drift(amplitudes: WindowAmplitudes) -> Array:
    """Return the most likely drift (m,) in one second, relative to the size of the harmonics of each component."""
    changes = _clip_changes(np.diff(amplitudes.values, axis=0))
    power = scipy.fft.dst(changes.real, type=1, axis=0, norm="ortho") ** 2
    power = power + scipy.fft.dst(changes.imag, type=1, axis=0, norm="ortho") ** 2
    count = len(changes)
    noise_eigenvalues = 2.0 * (1.0 - np.cos(np.pi * np.arange(1, count + 1) / (count + 1)))
    size = np.mean(np.abs(amplitudes.values) ** 2, axis=0)
    # Real and imaginary part have half of the variance each.
    noise = NOISE_FACTORS[:, None, None, None] * 0.5 * amplitudes.variance * noise_eigenvalues[:, None, None]
    rates = np.concatenate([[0.0], DRIFT_RATES])

    def misfit(rate: float) -> Array:
        """Return -ln L (f, m) for every factor on the noise."""
        eigenvalue = rate**2 * size * amplitudes.spacing + noise
        return np.asarray(np.sum(np.log(eigenvalue) + 0.5 * power / eigenvalue, axis=(1, 2)))

    misfits = np.stack([misfit(rate) for rate in rates])
    best = np.argmin(np.min(misfits, axis=1), axis=0)
    return np.asarray(rates[best])


def _clip_changes(changes: ComplexArray) -> ComplexArray:
    """Return the changes clipped at `OUTLIER_LIMIT` times their typical size: a step of the loads is not drift."""
    typical = np.sqrt(np.median(np.abs(changes) ** 2, axis=0) / np.log(2.0)) + np.finfo(float).tiny
    return np.asarray(changes * np.minimum(1.0, OUTLIER_LIMIT * typical / np.maximum(np.abs(changes), 1e-300)))
