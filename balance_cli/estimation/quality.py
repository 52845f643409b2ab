"""How well a system fits measured lines: chi-square against the measured noise, and relative response errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.likelihood import fitted
from balance_cli.estimation.measurements import Batch
from balance_cli.identified import FitQuality, RunFit
from balance_cli.model.system import System, solve

Array = NDArray[np.float64]

# Band of the relative response error that every summary quotes (contract, `frf_error`) [Hz].
FRF_BAND = (5.0, 150.0)


def fit_quality(batches: Sequence[Batch], system: System, determined: float) -> FitQuality:
    """Quality of the whole fit and of every run; `determined` parameters are taken from the degrees of freedom."""
    runs: dict[str, RunFit] = {}
    for batch in batches:
        runs.update(_batch_quality(batch, system))
    chi2, count = sum(run.chi2 for run in runs.values()), sum(run.dof for run in runs.values())
    dynamic = [run.frf_error for run in runs.values() if np.isfinite(run.frf_error)]
    error = float(np.sqrt(np.mean(np.square(dynamic)))) if dynamic else float("nan")
    return FitQuality(float(chi2), float(count - determined), error, runs)


def _batch_quality(batch: Batch, system: System) -> dict[str, RunFit]:
    fit = fitted(batch, system, solve(system, batch.frequency, batch.spin))
    frequency = batch.frequency[batch.index]
    in_band = (frequency >= FRF_BAND[0]) & (frequency <= FRF_BAND[1])
    # At rest there may be lines without any load.
    size = np.where(in_band, np.sum(np.abs(batch.loads) ** 2, axis=1), 1.0)
    live = _live(batch)
    error = np.sum(np.where(live, np.abs(fit.residual) ** 2, 0.0), axis=1) / size
    noise = np.sum(_noise(batch, live), axis=1) / size
    signal = np.sum(np.where(live, np.abs(batch.channels) ** 2, 0.0), axis=1) / size
    qualities = {}
    for i, name in enumerate(batch.runs):
        mine = batch.run == i
        band = mine & in_band
        relative = [_relative(part[band], signal[band]) for part in (error, noise)]
        chi2 = float((fit.chi2[mine] / batch.efficiency[mine]).sum())
        amplitudes = sum(one.determined for one in fit.transients if one.lines == batch.parts[i])
        qualities[name] = RunFit(chi2, float(batch.count[mine].sum() - amplitudes), *relative)
    return qualities


def _relative(part: Array, whole: Array) -> float:
    return float(np.sqrt(part.sum() / whole.sum())) if len(part) else float("nan")


def _live(batch: Batch) -> NDArray[np.bool_]:
    c = batch.channels.shape[1]
    return np.asarray(np.real(np.diagonal(batch.precision, axis1=1, axis2=2))[:, :c] > 0)


def _noise(batch: Batch, live: NDArray[np.bool_]) -> Array:
    """Variance (K, c) of the channels' means; where channels are independent the inverse precision serves."""
    c = batch.channels.shape[1]
    precision = np.real(np.diagonal(batch.precision, axis1=1, axis2=2))[:, :c]
    return np.where(live, 1.0 / np.where(live, precision, 1.0), 0.0)
