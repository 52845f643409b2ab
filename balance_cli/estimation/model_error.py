"""Weights that carry the error of the model: what a fit needs as long as its model is known to be wrong.

Under a misfit the likelihood of the noise alone is decided by the few lines of the sharpest peaks, has a minimum for
every way to lay one peak over another, and makes every sigma meaningless. An error of the model that is a share e of
the response around each line, independent from line to line and from channel to channel, is added to the noise:

    cov(y_i) = noise + e^2 s_i^2,        s_i^2: mean of |y_i|^2 over lines within a few percent of the frequency

e is chosen so that chi-square equals its degrees of freedom (a random effect, by the method of moments: DerSimonian and
Laird, Controlled Clinical Trials 7, 1986). As the model gets better e shrinks, and where nothing is missing it is zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import WORKERS, Batch
from balance_cli.estimation.likelihood import evaluate_batch
from balance_cli.model.system import System
from balance_cli.model.system_response import Solution, solve

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
ModelErrors = Mapping[str, float]

# Half the band around a line over which the response is averaged, as a share of its frequency, and at least [Hz].
RELATIVE_HALF_BAND = 0.04
MIN_HALF_BAND = 0.5
# Of the strongest line of a run, below which no response counts as known to a share of itself.
MIN_RESPONSE_RATIO = 1e-3
MAX_RELATIVE_ERROR = 1.0
MIN_RELATIVE_ERROR = 1e-6
INITIAL_RELATIVE_ERROR = 0.1
ITERATIONS = 8
CONVERGENCE_TOLERANCE = 0.01


def add_model_error(batches: Sequence[Batch], relative_errors: ModelErrors) -> tuple[Batch, ...]:
    """The same lines with a model error, a share of the response by run, in the covariance of the channels."""
    return tuple(
        _add_batch_error(batch, np.array([relative_errors[name] for name in batch.run_names])) for batch in batches
    )


def _add_batch_error(batch: Batch, relative_errors: Array) -> Batch:
    """P = (C + E)^-1 = S - S_Y (E_live^-1 + S_YY)^-1 S_Y', with E the error's variance and S the noise's precision."""
    if not relative_errors.any():
        return batch
    c = batch.lines.channels.shape[1]
    variance = relative_errors[batch.lines.run, None] ** 2 * local_response_power(batch)
    S = batch.lines.precision
    live = np.real(np.diagonal(S, axis1=1, axis2=2))[:, :c] > 0
    # Where nothing is added its inverse is a large number beside the noise's precision, not infinite.
    least = 1e-12 / np.maximum(np.real(np.diagonal(S, axis1=1, axis2=2))[:, :c], 1e-300)
    inverse = np.where(live, 1.0 / np.maximum(variance, np.minimum(least, 1e100)), 1.0)
    inner = S[:, :c, :c] + inverse[:, :, None] * np.eye(c)
    removed = S[:, :, :c] @ np.linalg.solve(inner, S[:, :c, :])
    return replace(batch, lines=replace(batch.lines, precision=np.asarray(S - removed, complex)))


def local_response_power(batch: Batch) -> Array:
    """Mean |y|^2 (K, c) [V^2] of each channel around each line of its run."""
    power = np.abs(batch.lines.channels) ** 2
    usual = np.maximum(power.mean(axis=0), np.finfo(float).tiny)
    whole = (power / usual).mean(axis=1)[:, None] * usual
    size = np.empty(power.shape)
    frequency = batch.line_frequency
    for lines in batch.parts:
        size[lines] = _running_mean(frequency[lines], 0.5 * (power[lines] + whole[lines]))
    return size


def _running_mean(frequency: Array, power: Array) -> Array:
    """Mean of power (k, c) over the lines within the band around each, by running sums; lines in rising frequency."""
    order = np.argsort(frequency, kind="stable")
    rising = frequency[order]
    half = np.maximum(RELATIVE_HALF_BAND * rising, MIN_HALF_BAND)
    first, last = np.searchsorted(rising, rising - half), np.searchsorted(rising, rising + half, side="right")
    sums = np.concatenate([np.zeros((1, power.shape[1])), np.cumsum(power[order], axis=0)])
    mean = np.empty_like(power)
    mean[order] = (sums[last] - sums[first]) / (last - first)[:, None]
    return np.asarray(np.maximum(mean, MIN_RESPONSE_RATIO**2 * power.max(axis=0)))


def log_determinant_inflation(batches: Sequence[Batch], relative_errors: ModelErrors) -> float:
    """2 ln det(cov + E) - 2 ln det(cov) of all lines (once for real ones): what a model error adds to -2 ln likelihood.

    With it, fits of different model error can be compared.
    """
    total = 0.0
    for batch in batches:
        by_run = np.array([relative_errors[name] for name in batch.run_names])
        if not by_run.any():
            continue
        c = batch.lines.channels.shape[1]
        root = by_run[batch.lines.run, None] * np.sqrt(local_response_power(batch))
        inner = np.eye(c) + root[:, :, None] * batch.lines.precision[:, :c, :c] * root[:, None, :]
        total += float(np.sum(batch.lines.count / c * np.linalg.slogdet(inner)[1]))
    return total


def estimate_model_error(
    batches: Sequence[Batch], system: System, initial: ModelErrors | None = None, sigma_limit: float = 0.0
) -> ModelErrors:
    """The share e of each run at which its chi-square is its degrees of freedom; 0 where it is no more without any,

    or by so many of its standard deviations (`sigma_limit`) only.

    Where the error outweighs the noise chi-square goes as 1/e^2: e <- e sqrt(chi2 / dof), all runs at once.
    """
    names = [name for batch in batches for name in batch.run_names]
    dof = np.concatenate([np.bincount(batch.lines.run, batch.lines.count, len(batch.run_names)) for batch in batches])
    solutions = [solve(system, batch.frequency, batch.spin) for batch in batches]
    wrong = _run_chi2(batches, system, solutions) > dof + sigma_limit * _chi2_sigma(batches, dof)
    relative_errors = np.array([(initial or {}).get(name, 0.0) or INITIAL_RELATIVE_ERROR for name in names])
    for _ in range(ITERATIONS if wrong.any() else 0):
        trial = dict(zip(names, np.where(wrong, relative_errors, 0.0).tolist(), strict=True))
        ratio = np.sqrt(_run_chi2(add_model_error(batches, trial), system, solutions) / dof)
        relative_errors = np.clip(relative_errors * ratio, MIN_RELATIVE_ERROR, MAX_RELATIVE_ERROR)
        if np.all(np.abs(ratio[wrong] - 1.0) < CONVERGENCE_TOLERANCE):
            break
    return dict(
        zip(names, np.where(wrong & (relative_errors > MIN_RELATIVE_ERROR), relative_errors, 0.0).tolist(), strict=True)
    )


def _chi2_sigma(batches: Sequence[Batch], count: Array) -> Array:
    """Standard deviation of the chi-square of each run, of so many values; each channel's noise is an estimate too."""
    known = []
    for batch in batches:
        live = np.real(np.diagonal(batch.lines.precision, axis1=1, axis2=2))[:, : batch.lines.channels.shape[1]] > 0
        channels = [max(int(np.count_nonzero(live[part].any(axis=0))), 1) for part in batch.parts]
        known += [number * run.noise_dof for number, run in zip(channels, batch.runs, strict=True)]
    return np.asarray(np.sqrt(2.0 * count * (1.0 + count / np.array(known))))


def _run_chi2(batches: Sequence[Batch], system: System, solutions: Sequence[Solution]) -> Array:
    """Chi-square of every run, in the order of the batches."""

    def batch_chi2(batch: Batch, solution: Solution) -> Array:
        fit = evaluate_batch(batch, system, solution)
        return np.asarray(np.bincount(batch.lines.run, fit.chi2 / batch.lines.efficiency, len(batch.run_names)), float)

    with ThreadPoolExecutor(WORKERS) as workers:
        return np.concatenate(list(workers.map(batch_chi2, batches, solutions)))
