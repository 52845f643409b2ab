"""Frequency responses from the lines of periodic records, free of leakage.

With one component excited the response is the ratio, line by line. With several at once it is found line by line from
as many runs with different phases (Pintelon and Schoukens, System Identification, 2nd ed., section 2.7), or from one
run by local rational models across its lines, which separate the components by their phases at neighboring lines.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.io.errors import UserError
from balance_cli.signals.local.fit import ModelOrders, WindowedData
from balance_cli.signals.local.models import LocalModels, best_fits, stitch_response
from balance_cli.signals.local.noise import NoiseCovariances
from balance_cli.signals.local.response import coherences, response_from_models
from balance_cli.signals.local.scaled_spectrum import ScaledSpectrum
from balance_cli.signals.local.widths import sliding_windows
from balance_cli.signals.periodic import PeriodicRecord
from balance_cli.signals.run_samples import LARGEST_LOAD_CONDITION
from balance_cli.signals.run_spectrum import FrequencyResponse, RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LINE_MODEL_ORDERS = tuple(ModelOrders(degree, -1, poles) for degree in (1, 2) for poles in (0, 1, 2, 3))
FEWEST_WINDOW_LINES = 21
"""Lines in a window: more than three for each of the six parameters of the largest model with one input."""
LEAST_REDUNDANT_DOF = 40
"""Complex degrees of freedom over which the variance of redundant runs is averaged: it is then known to a sixth."""
CLEAR_DIFFERENCE_SIGMA = 4.0
"""Standard deviations of that variance from which the runs differ by more than their noise: p = 3e-5."""


def joint_response(records: Sequence[PeriodicRecord]) -> FrequencyResponse:
    """Estimate the response from R periodic runs with the same lines and u <= R components.

    At every line it solves Y = T U over the runs, which have equal weights; the noise of the channels is the mean over
    the runs. Where R > u and the runs differ by more than that noise, it is raised to what they differ by. Raises
    UserError where the loads of the runs are proportional to each other.
    """
    spectra = [record.spectrum for record in records]
    first = spectra[0]
    U = np.stack([spectrum.loads for spectrum in spectra], axis=2)
    Y = np.stack([spectrum.channels for spectrum in spectra], axis=2)
    if _load_condition(U) > LARGEST_LOAD_CONDITION:
        raise UserError(
            f"the loads {', '.join(first.components)} are proportional to each other",
            f"run {first.run}",
            remedy="Record as many runs as components, with different phases",
        )
    inverse = _right_inverse(U)
    response = Y @ inverse
    noise = equation_error_noise(first, response)
    for spectrum in spectra[1:]:
        noise += equation_error_noise(spectrum, response)
    noise /= len(spectra)
    if len(spectra) > len(first.components):
        excess = np.sqrt(run_difference_ratio(Y - response @ U, noise, len(spectra) - len(first.components)))
        noise *= excess[:, :, None] * excess[:, None, :]
    power = U @ U.conj().swapaxes(1, 2) / len(spectra)
    periods = np.mean([record.periods - record.first for record in records], axis=0)
    ordinary, multiple = coherences(response, noise * periods[:, None, None], power)
    return FrequencyResponse(
        run="+".join(spectrum.run for spectrum in spectra),
        channel_names=first.channel_names,
        components=first.components,
        estimator="periodic",
        frequency=first.frequency,
        response=response,
        channel_covariance=noise,
        load_covariance=inverse.conj().swapaxes(1, 2) @ inverse,
        coherence=ordinary,
        multiple_coherence=multiple,
        rotor_speed=first.rotor_speed,
        level=first.level,
        noise_dof=float(sum(spectrum.dof for spectrum in spectra)),
    )


def _load_condition(U: ComplexArray) -> float:
    """Return the median condition number of loads (k, u, R), each over its size."""
    if U.shape[1] == 1:
        return 1.0
    size = np.sqrt(np.mean(np.abs(U) ** 2, axis=(0, 2)))
    return float(np.median(np.linalg.cond(U / size[:, None])))


def _right_inverse(U: ComplexArray) -> ComplexArray:
    """Return the pseudoinverses (k, R, u) of loads (k, u, R); that of one load needs no singular values."""
    if U.shape[1] > 1:
        return np.asarray(np.linalg.pinv(U))
    adjoint = U.conj().swapaxes(1, 2)
    return np.asarray(adjoint / np.sum(np.abs(U) ** 2, axis=2, keepdims=True))


def run_difference_ratio(residual: ComplexArray, noise: ComplexArray, redundant: int) -> Array:
    """Return the variance (k, c) of residuals (k, c, R) of R runs over that of `noise` (k, c, c), at least one.

    Of the R values of a channel `redundant` are left, averaged over neighboring lines. A ratio that
    chance could make, or that of a channel without noise, counts as one.
    """
    variance = np.maximum(np.diagonal(noise, axis1=1, axis2=2).real, 0.0)
    power = np.sum(np.abs(residual) ** 2, axis=2)
    if redundant < 1 or not np.any(power):
        return np.ones(variance.shape)
    size = min(2 * -(-LEAST_REDUNDANT_DOF // (2 * redundant)) + 1, len(power))
    ratio = power / np.maximum(redundant * variance, np.finfo(float).tiny)
    kernel = np.ones(size)
    lines = np.convolve(np.ones(len(ratio)), kernel, "same")
    mean = np.stack([np.convolve(column, kernel, "same") for column in ratio.T], axis=1) / lines[:, None]
    limit = 1.0 + CLEAR_DIFFERENCE_SIGMA / np.sqrt(redundant * lines)[:, None]
    return np.where((mean > limit) & (variance > 0.0), mean, 1.0)


def equation_error_noise(lines: RunSpectrum, response: ComplexArray) -> ComplexArray:
    """Return the covariance (k, c, c) of `Y - T U` from that of [channels, loads]."""
    c = lines.channels.shape[1]
    S = lines.covariance
    # With W = S_yu - T S_uu / 2 it is S_yy - W T* - (W T*)*: one product and one sum of large arrays less.
    half = (S[:, :c, c:] - 0.5 * response @ S[:, c:, c:]) @ response.conj().swapaxes(1, 2)
    noise = S[:, :c, :c] - half
    noise -= half.conj().swapaxes(1, 2)
    return np.asarray(noise)


def response_from_one_run(run: Run, lines: RunSpectrum) -> FrequencyResponse:
    """Estimate the response to several components excited at once in one periodic run, by local models over its lines.

    Raises UserError where the run has too few lines.
    """
    u = len(lines.components)
    M = max(FEWEST_WINDOW_LINES, 3 * max(orders.coefficients(u) for orders in LINE_MODEL_ORDERS)) | 1
    if len(lines.frequency) < M:
        raise UserError(
            f"{len(lines.frequency)} lines are too few to separate {u} components",
            f"run {lines.run}",
            remedy="Record as many runs as components, with different phases, or excite more lines",
        )
    spectrum = _scaled_spectrum(run, lines)
    layout = sliding_windows(len(lines.frequency), M, max(M // 7, 1))
    first, assigned_lines = layout.first, layout.assigned_lines
    fits = best_fits(_spectrum_windows(spectrum, layout.index), LINE_MODEL_ORDERS)
    c = len(lines.channel_names)
    scale = np.concatenate([spectrum.channel_scale, spectrum.load_scale])
    scaled = lines.covariance / (scale[:, None] * scale)
    noise = NoiseCovariances(scaled[:, :c, :c], np.median(scaled[:, c:, c:].real, axis=0).astype(complex), lines.dof)
    level = np.ones(len(lines.frequency))
    response = stitch_response(fits, first, assigned_lines)
    models = LocalModels(
        spectrum, first, assigned_lines, fits, response, noise, level, np.zeros_like(spectrum.channels)
    )
    return response_from_models(models, "periodic-local")


def _scaled_spectrum(run: Run, lines: RunSpectrum) -> ScaledSpectrum:
    """The lines as a spectrum: channels in units of their noise, loads in units of their rms."""
    c = len(lines.channel_names)
    noise = np.sqrt(np.median(np.diagonal(lines.covariance, axis1=1, axis2=2).real, axis=0))[:c]
    channel_scale = np.where(noise > 0, noise, 1.0)
    load_scale = np.sqrt(np.mean(np.abs(lines.loads) ** 2, axis=0))
    return ScaledSpectrum(
        run=run,
        channel_names=lines.channel_names,
        components=lines.components,
        frequency=lines.frequency,
        channels=lines.channels / channel_scale,
        loads=lines.loads / load_scale,
        channel_scale=channel_scale,
        load_scale=load_scale,
        excited=np.ones(len(lines.frequency), bool),
    )


def _spectrum_windows(spectrum: ScaledSpectrum, index: NDArray[np.intp]) -> WindowedData:
    frequency = spectrum.frequency[index]
    low, high = frequency[:, :1], frequency[:, -1:]
    r = (2.0 * frequency - low - high) / (high - low)
    return WindowedData(spectrum.channels[index], spectrum.loads[index], np.ones(index.shape), r)
