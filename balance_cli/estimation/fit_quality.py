"""Quality of a fit: chi-square against the measured noise, and relative errors of the responses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.identified_model import FitQuality, RunFit
from balance_cli.estimation.likelihood import evaluate_batch
from balance_cli.estimation.recorded_loads import recorded_load_columns
from balance_cli.model.balance import balance_model
from balance_cli.model.modes import modes
from balance_cli.model.placed_effects import without_effects
from balance_cli.model.system import System
from balance_cli.model.system_response import solve

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Band [Hz] of the relative response error (`frf_error` in docs/json.md): the modes of rotor balances and 1 to 8/rev. A
# rig whose computed modes do not all lie in it has the band of its excited lines instead.
FRF_BAND = (5.0, 150.0)


def frf_band(batches: Sequence[Batch], geometry: Geometry) -> tuple[float, float]:
    """Return the band [Hz] of the relative response errors of a rig: `FRF_BAND`, or that of the excited lines."""
    return frf_band_of_lines(_excited_lines(batches), geometry)


def excited_band(batches: Sequence[Batch]) -> tuple[float, float] | None:
    """Return the lowest and the highest frequency [Hz] of the lines of the sweeps; None without any."""
    lines = _excited_lines(batches)
    return (float(lines.min()), float(lines.max())) if len(lines) else None


def _excited_lines(batches: Sequence[Batch]) -> Array:
    return np.concatenate([np.zeros(0), *(batch.line_frequency[batch.line_frequency > 0] for batch in batches)])


def frf_band_of_lines(frequency: Array, geometry: Geometry) -> tuple[float, float]:
    """Return `frf_band` for excited lines of these frequencies [Hz]; raises UserError as `balance_model` does."""
    computed = modes(balance_model(without_effects(geometry)).system()).frequency
    if len(computed) and FRF_BAND[0] <= computed.min() and computed.max() <= FRF_BAND[1]:
        return FRF_BAND
    return (float(frequency.min()), float(frequency.max())) if len(frequency) else FRF_BAND


def fit_quality(
    batches: Sequence[Batch], system: System, effective_parameters: float, band: tuple[float, float]
) -> FitQuality:
    """Quality of the whole fit and of every run; relative errors of the responses are those of the `band` [Hz].

    `effective_parameters` are subtracted from the degrees of freedom.
    """
    runs: dict[str, RunFit] = {}
    for batch in batches:
        runs.update(_batch_quality(batch, system, band))
    chi2, count = sum(run.chi2 for run in runs.values()), sum(run.dof for run in runs.values())
    dynamic = [run.frf_error for run in runs.values() if np.isfinite(run.frf_error)]
    error = float(np.sqrt(np.mean(np.square(dynamic)))) if dynamic else float("nan")
    return FitQuality(float(chi2), float(count - effective_parameters), error, runs, band)


def _batch_quality(batch: Batch, system: System, frf_limits: tuple[float, float]) -> dict[str, RunFit]:
    solution = solve(system, batch.frequency, batch.spin)
    fit = evaluate_batch(batch, system, solution)
    columns = recorded_load_columns(batch, system, solution)
    frequency = batch.line_frequency
    in_band = (frequency >= frf_limits[0]) & (frequency <= frf_limits[1]) & (frequency > 0)
    # Lines at rest may have no load at all.
    size = np.where(in_band, np.sum(np.abs(batch.lines.loads) ** 2, axis=1), 1.0)
    is_live = live_mask(batch)
    error = np.sum(np.where(is_live, np.abs(fit.residual) ** 2, 0.0), axis=1) / size
    variance = np.where(is_live, residual_variance(batch, columns, is_live), 0.0)
    noise = np.sum(variance, axis=1) / size
    by_channel = np.where(variance > 0.0, np.abs(fit.residual) ** 2 / np.where(variance > 0.0, variance, 1.0), 0.0)
    signal = np.sum(np.where(is_live, np.abs(batch.lines.channels) ** 2, 0.0), axis=1) / size
    qualities = {}
    for i, name in enumerate(batch.run_names):
        of_run = batch.lines.run == i
        band = of_run & in_band
        amplitudes = sum(part.effective_parameters for part in fit.transients if part.lines == batch.parts[i])
        qualities[name] = RunFit(
            chi2=float((fit.chi2[of_run] / batch.lines.efficiency[of_run]).sum()),
            dof=float(batch.lines.count[of_run].sum() - amplitudes),
            frf_error=_rms_ratio(error[band], signal[band]),
            frf_noise_floor=_rms_ratio(noise[band], signal[band]),
            worst_channel=_worst_channel(by_channel[of_run], system.channel_names),
        )
    return qualities


def _worst_channel(squares: Array, names: Sequence[str]) -> str | None:
    """Return the channel of the largest squares (k, c) of residuals over their noise; None without any."""
    total = np.sum(squares, axis=0)
    return names[int(np.argmax(total))] if np.any(total > 0.0) else None


def _rms_ratio(part: Array, total: Array) -> float:
    return float(np.sqrt(part.sum() / total.sum())) if len(part) else float("nan")


def live_mask(batch: Batch) -> NDArray[np.bool_]:
    """Return which channels (K, c) are live in each line."""
    return np.asarray(batch.lines.channel_precision > 0)


def residual_variance(batch: Batch, columns: ComplexArray, is_live: NDArray[np.bool_]) -> Array:
    """Variance (K, c) of channels - T loads for the columns T (K, c, u) of the excited loads; arbitrary where not live.

    The precision contains the efficiency, and the equal factor that removes the bias of an inverse.
    """
    K, c = is_live.shape
    size = c if batch.has_exact_loads else batch.lines.precision.shape[1]
    is_informed = np.ones((K, size), bool)
    is_informed[:, :c] = is_live
    precision = batch.lines.precision[:, :size, :size] + np.where(is_informed, 0.0, 1.0)[:, :, None] * np.eye(size)
    covariance = np.linalg.inv(precision) * (batch.lines.efficiency**2)[:, None, None]
    of_channels = np.real(np.diagonal(covariance, axis1=1, axis2=2))[:, :c]
    if batch.has_exact_loads:
        return np.asarray(of_channels)
    of_loads = np.matmul(columns, covariance[:, c:, c:]) - 2.0 * covariance[:, :c, c:]
    return np.asarray(
        np.maximum(of_channels + np.sum(np.real(of_loads * columns.conj()), axis=2), np.finfo(float).tiny)
    )
