"""Frequency responses from the lines of periodic records: no leakage, no local model where one can do without.

One component excited: the ratio, line by line. Several at once: from as many runs with other phases, line by line
(Pintelon and Schoukens, System Identification, 2nd ed., section 2.7); from one run alone, by local rational models
across its lines, which tell the components apart by their phases at neighbouring lines.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.io.errors import UserError
from balance_cli.signals.local.fit import ModelOrders, WindowedData
from balance_cli.signals.local.models import LocalModels, ScaledSpectrum, best_fits, sliding_windows, stitch_response
from balance_cli.signals.local.noise import NoiseCovariances
from balance_cli.signals.local.response import coherences, response_from_models
from balance_cli.signals.periodic import PeriodicRecord
from balance_cli.signals.run_spectrum import FrequencyResponse, RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LINE_MODEL_ORDERS = tuple(ModelOrders(degree, -1, poles) for degree in (1, 2) for poles in (0, 1, 2, 3))
FEWEST_WINDOW_LINES = 21
LARGEST_LOAD_CONDITION = 1e3


def joint_response(records: Sequence[PeriodicRecord]) -> FrequencyResponse:
    """Response from R periodic runs with the same lines and u <= R components, Y = T U over the runs at every line.

    Runs are weighed alike; the noise of the channels is the mean over the runs. UserError where the runs do not tell
    the components apart (their loads are in proportion to each other).
    """
    lines = [record.spectrum for record in records]
    U = np.stack([each.loads for each in lines], axis=2)
    Y = np.stack([each.channels for each in lines], axis=2)
    size = np.sqrt(np.mean(np.abs(U) ** 2, axis=(0, 2)))
    if np.median(np.linalg.cond(U / size[:, None])) > LARGEST_LOAD_CONDITION:
        raise UserError(
            f"{', '.join(lines[0].components)} were excited in proportion to each other",
            f"run {lines[0].run}",
            remedy="Record as many runs with other phases",
        )
    inverse = np.linalg.pinv(U)
    response = Y @ inverse
    noise = np.mean([equation_error_noise(each, response) for each in lines], axis=0)
    power = U @ U.conj().swapaxes(1, 2) / len(lines)
    periods = np.mean([record.periods - record.first for record in records], axis=0)
    ordinary, multiple = coherences(response, noise * periods[:, None, None], power)
    return FrequencyResponse(
        run="+".join(each.run for each in lines),
        channel_names=lines[0].channel_names,
        components=lines[0].components,
        estimator="periodic",
        frequency=lines[0].frequency,
        response=response,
        channel_covariance=noise,
        load_covariance=inverse.conj().swapaxes(1, 2) @ inverse,
        coherence=ordinary,
        multiple_coherence=multiple,
        rotor_speed=lines[0].rotor_speed,
        level=lines[0].level,
    )


def equation_error_noise(lines: RunSpectrum, response: ComplexArray) -> ComplexArray:
    """Covariance (k, c, c) of `Y - T U` from that of [channels, loads]."""
    c = lines.channels.shape[1]
    S = lines.covariance
    cross = S[:, :c, c:] @ response.conj().swapaxes(1, 2)
    through = response @ S[:, c:, c:] @ response.conj().swapaxes(1, 2)
    return np.asarray(S[:, :c, :c] - cross - cross.conj().swapaxes(1, 2) + through)


def response_from_one_run(run: Run, lines: RunSpectrum) -> FrequencyResponse:
    """Response to several components excited at once in one periodic run, by local models over its lines.

    UserError where the run has too few lines.
    """
    u = len(lines.components)
    M = max(FEWEST_WINDOW_LINES, 3 * max(orders.coefficients(u) for orders in LINE_MODEL_ORDERS)) | 1
    if len(lines.frequency) < M:
        raise UserError(
            f"{len(lines.frequency)} lines cannot tell {u} components apart",
            f"run {lines.run}",
            remedy="Record as many runs with other phases, or excite more lines",
        )
    spectrum = _scaled_spectrum(run, lines)
    first, assigned_lines = sliding_windows(len(lines.frequency), M, max(M // 7, 1))
    windows = _spectrum_windows(spectrum, first[:, None] + np.arange(M))
    fits = best_fits(windows, LINE_MODEL_ORDERS)
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
