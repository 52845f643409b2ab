"""How well a system fits measured lines: chi-square against the measured noise, and relative response errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.estimation.identified_model import FitQuality, RunFit
from balance_cli.estimation.likelihood import evaluate_batch, exciter_response
from balance_cli.model.system import System
from balance_cli.model.system_response import solve

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Band of the relative response error that every summary quotes (contract, `frf_error`) [Hz].
FRF_BAND = (5.0, 150.0)


def fit_quality(batches: Sequence[Batch], system: System, effective_parameters: float) -> FitQuality:
    """Quality of the whole fit and of every run; `effective_parameters` parameters are taken from the degrees of
    freedom.
    """
    runs: dict[str, RunFit] = {}
    for batch in batches:
        runs.update(_batch_quality(batch, system))
    chi2, count = sum(run.chi2 for run in runs.values()), sum(run.dof for run in runs.values())
    dynamic = [run.frf_error for run in runs.values() if np.isfinite(run.frf_error)]
    error = float(np.sqrt(np.mean(np.square(dynamic)))) if dynamic else float("nan")
    return FitQuality(float(chi2), float(count - effective_parameters), error, runs)


def _batch_quality(batch: Batch, system: System) -> dict[str, RunFit]:
    solution = solve(system, batch.frequency, batch.spin)
    fit = evaluate_batch(batch, system, solution)
    columns = exciter_response(system, solution)[batch.lines.index[:, None], :, batch.lines.components].swapaxes(1, 2)
    frequency = batch.line_frequency
    in_band = (frequency >= FRF_BAND[0]) & (frequency <= FRF_BAND[1])
    # At rest there may be lines without any load.
    size = np.where(in_band, np.sum(np.abs(batch.lines.loads) ** 2, axis=1), 1.0)
    live = live_mask(batch)
    error = np.sum(np.where(live, np.abs(fit.residual) ** 2, 0.0), axis=1) / size
    noise = np.sum(np.where(live, residual_variance(batch, columns, live), 0.0), axis=1) / size
    signal = np.sum(np.where(live, np.abs(batch.lines.channels) ** 2, 0.0), axis=1) / size
    qualities = {}
    for i, name in enumerate(batch.run_names):
        mine = batch.lines.run == i
        band = mine & in_band
        relative = [_rms_ratio(part[band], signal[band]) for part in (error, noise)]
        chi2 = float((fit.chi2[mine] / batch.lines.efficiency[mine]).sum())
        amplitudes = sum(one.effective_parameters for one in fit.transients if one.lines == batch.parts[i])
        qualities[name] = RunFit(chi2, float(batch.lines.count[mine].sum() - amplitudes), *relative)
    return qualities


def _rms_ratio(part: Array, whole: Array) -> float:
    return float(np.sqrt(part.sum() / whole.sum())) if len(part) else float("nan")


def live_mask(batch: Batch) -> NDArray[np.bool_]:
    """Return which channels (K, c) are live in each line."""
    c = batch.lines.channels.shape[1]
    return np.asarray(np.real(np.diagonal(batch.lines.precision, axis1=1, axis2=2))[:, :c] > 0)


def residual_variance(batch: Batch, columns: ComplexArray, live: NDArray[np.bool_]) -> Array:
    """Variance (K, c) of channels - T loads for the columns T (K, c, u) of the excited loads; any where not live.

    The precision holds the efficiency and the factor that frees an inverse of its bias, which is the same.
    """
    K, c = live.shape
    size = c if batch.has_exact_loads else batch.lines.precision.shape[1]
    silent = np.ones((K, size), bool)
    silent[:, :c] = live
    precision = batch.lines.precision[:, :size, :size] + np.where(silent, 0.0, 1.0)[:, :, None] * np.eye(size)
    covariance = np.linalg.inv(precision) * (batch.lines.efficiency**2)[:, None, None]
    own = np.real(np.diagonal(covariance, axis1=1, axis2=2))[:, :c]
    if batch.has_exact_loads:
        return np.asarray(own)
    through = np.matmul(columns, covariance[:, c:, c:]) - 2.0 * covariance[:, :c, c:]
    return np.asarray(np.maximum(own + np.sum(np.real(through * columns.conj()), axis=2), np.finfo(float).tiny))
