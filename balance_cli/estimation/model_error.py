"""Weights that include the error of the model, for fits of a model that is known to be incomplete.

Under a misfit the likelihood of the noise alone is dominated by the few lines of the sharpest peaks, has a minimum for
each pairing of computed with measured peaks, and makes every sigma meaningless. A model error that is a fraction e of
the response around each line, independent between lines and channels, is therefore added to the noise:

    cov(y_i) = noise + e^2 s_i^2,        s_i^2: mean of |y_i|^2 over lines within a few percent of the frequency

e is such that chi-square equals its degrees of freedom (a random effect, by the method of moments: DerSimonian and
Laird, Controlled Clinical Trials 7, 1986). As the model improves e decreases, and for a complete model it is zero.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch, map_batches
from balance_cli.estimation.likelihood import evaluate_prediction
from balance_cli.estimation.prediction import BatchPrediction, predict_batch
from balance_cli.estimation.shared_solutions import SharedSolutions
from balance_cli.model.system import System

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
ModelErrors = Mapping[str, float]

# Half the band around a line over which the response is averaged, relative to its frequency: twice the half-power width
# of a mode with 1 % damping. Its minimum relative to the highest frequency of the run: that width in the lowest tenth.
RELATIVE_HALF_BAND = 0.04
MIN_HALF_BAND_SHARE = 1.0 / 300.0
# Least response relative to the strongest line of a run: at an antiresonance the model error does not vanish.
MIN_RESPONSE_RATIO = 1e-3
# Range of e: an error as large as the response, and one far below any noise, which counts as zero.
MAX_RELATIVE_ERROR = 1.0
MIN_RELATIVE_ERROR = 1e-6
# Start of the iteration for e, which matters little.
INITIAL_RELATIVE_ERROR = 0.1
ITERATIONS = 8
# Relative change of e at which the iteration ends; a weight need not be known better.
CONVERGENCE_TOLERANCE = 0.01
# Derivative of ln(chi2 without error / chi2 - 1) by ln e where the error is about equally large beside the noise of all
# lines, and the flattest one with which a step is taken.
USUAL_SLOPE, FLATTEST_SLOPE = 2.0, 0.25


def add_model_error(batches: Sequence[Batch], relative_errors: ModelErrors) -> tuple[Batch, ...]:
    """The same lines with a model error, given by run relative to the response, added to the channels' covariance."""
    return _add_errors(batches, relative_errors, [None] * len(batches))


def _add_errors(
    batches: Sequence[Batch], relative_errors: ModelErrors, powers: Sequence[Array | None]
) -> tuple[Batch, ...]:
    """The same, where the local power of the response of a batch may be known."""
    return tuple(
        _add_batch_error(batch, np.array([relative_errors[name] for name in batch.run_names]), power)
        for batch, power in zip(batches, powers, strict=True)
    )


def _add_batch_error(batch: Batch, relative_errors: Array, power: Array | None) -> Batch:
    """P = (C + E)^-1 = S - S_Y (E_live^-1 + S_YY)^-1 S_Y', with E the error's variance and S the noise's precision."""
    if not relative_errors.any():
        return batch
    c = batch.lines.channels.shape[1]
    power = local_response_power(batch) if power is None else power
    variance = relative_errors[batch.lines.run, None] ** 2 * power
    S = batch.lines.precision
    is_live = np.real(np.diagonal(S, axis1=1, axis2=2))[:, :c] > 0
    # Where the error is zero its inverse is large compared with the noise's precision, not infinite.
    negligible = 1e-12 / np.maximum(np.real(np.diagonal(S, axis1=1, axis2=2))[:, :c], 1e-300)
    inverse = np.where(is_live, 1.0 / np.maximum(variance, np.minimum(negligible, 1e100)), 1.0)
    inner = S[:, :c, :c].copy()
    inner[:, range(c), range(c)] += inverse
    removed = S[:, :, :c] @ np.linalg.solve(inner, S[:, :c, :])
    return replace(batch, lines=replace(batch.lines, precision=np.subtract(S, removed, out=removed)))


def local_response_power(batch: Batch) -> Array:
    """Mean |y|^2 (K, c) [V^2] of each channel around each line of its run."""
    power = np.abs(batch.lines.channels) ** 2
    mean_power = np.maximum(power.mean(axis=0), np.finfo(float).tiny)
    common = (power / mean_power).mean(axis=1)[:, None] * mean_power
    size = np.empty(power.shape)
    frequency = batch.line_frequency
    for lines in batch.parts:
        size[lines] = _running_mean(frequency[lines], 0.5 * (power[lines] + common[lines]))
    return size


def _running_mean(frequency: Array, power: Array) -> Array:
    """Mean of power (k, c) over the lines within the band around each line, by running sums."""
    order = np.argsort(frequency, kind="stable")
    rising = frequency[order]
    half = np.maximum(RELATIVE_HALF_BAND * rising, MIN_HALF_BAND_SHARE * rising.max(initial=0.0))
    first, last = np.searchsorted(rising, rising - half), np.searchsorted(rising, rising + half, side="right")
    sums = np.concatenate([np.zeros((1, power.shape[1])), np.cumsum(power[order], axis=0)])
    mean = np.empty_like(power)
    mean[order] = (sums[last] - sums[first]) / (last - first)[:, None]
    return np.asarray(np.maximum(mean, MIN_RESPONSE_RATIO**2 * power.max(axis=0)))


def log_determinant_inflation(batches: Sequence[Batch], relative_errors: ModelErrors) -> float:
    """2 ln det(cov + E) - 2 ln det(cov) of all lines (once for real ones).

    It is the term of a model error in -2 ln likelihood, and makes fits with different model errors comparable.
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
    """The relative error e of each run at which its chi-square equals its degrees of freedom.

    Zero where chi-square exceeds the degrees of freedom by at most `sigma_limit` of its standard deviations without any
    model error. With an error e beside a noise n chi-square falls as 1 / (1 + e^2 / n^2): chi2(0) / chi2(e) - 1 is
    nearly a power of e, and e is found by secants in logarithms.
    """
    names = [name for batch in batches for name in batch.run_names]
    dof = np.concatenate([np.bincount(batch.lines.run, batch.lines.count, len(batch.run_names)) for batch in batches])
    shared = SharedSolutions(system)
    predictions = [_predict(batch, system, shared) for batch in batches]
    without_error = _run_chi2(batches, system, predictions, shared)
    misfits = without_error > dof + sigma_limit * _chi2_sigma(batches, dof)
    if not misfits.any():
        return dict.fromkeys(names, 0.0)
    powers = [local_response_power(batch) for batch in batches]

    def excess(log_error: Array) -> Array:
        trial = dict(zip(names, np.where(misfits, np.exp(log_error), 0.0).tolist(), strict=True))
        chi2 = _run_chi2(_add_errors(batches, trial, powers), system, predictions, shared)
        tiny = np.finfo(float).tiny
        found, sought = (np.maximum(without_error / value - 1.0, tiny) for value in (chi2, dof))
        return np.asarray(np.log(found / sought))

    start = np.log([(initial or {}).get(name, 0.0) or INITIAL_RELATIVE_ERROR for name in names])
    relative_errors = np.exp(_solve_by_secants(excess, start, misfits))
    is_error = misfits & (relative_errors > MIN_RELATIVE_ERROR)
    return dict(zip(names, np.where(is_error, relative_errors, 0.0).tolist(), strict=True))


def _solve_by_secants(excess: Callable[[Array], Array], start: Array, sought: NDArray[np.bool_]) -> Array:
    """Return ln e (r,) at which rising functions of it are zero, one for each; only the `sought` ones matter."""
    limits = np.log([MIN_RELATIVE_ERROR, MAX_RELATIVE_ERROR])
    x, slope = np.clip(start, *limits), np.full(len(start), USUAL_SLOPE)
    value = excess(x)
    for _ in range(ITERATIONS):
        step = np.clip(x - value / slope, *limits) - x
        x = x + step
        if np.all(np.abs(step[sought]) < CONVERGENCE_TOLERANCE):
            break
        before, value = value, excess(x)
        moved = np.abs(step) > CONVERGENCE_TOLERANCE
        secant = np.maximum((value - before) / np.where(moved, step, 1.0), FLATTEST_SLOPE)
        slope = np.where(moved, secant, slope)
    return x


def _chi2_sigma(batches: Sequence[Batch], count: Array) -> Array:
    """Standard deviation of the chi-square of each run, of `count` values, with the noise estimated by channel."""
    noise_dof: list[float] = []
    for batch in batches:
        is_live = batch.lines.channel_precision > 0
        channels = [max(int(np.count_nonzero(is_live[part].any(axis=0))), 1) for part in batch.parts]
        noise_dof += [number * run.noise_dof for number, run in zip(channels, batch.runs, strict=True)]
    return np.asarray(np.sqrt(2.0 * count * (1.0 + count / np.array(noise_dof))))


def _predict(batch: Batch, system: System, shared: SharedSolutions) -> BatchPrediction:
    solution = shared.solution(batch.frequency, batch.spin)
    return predict_batch(batch, system, solution, derivatives=False, shared=shared)


def _run_chi2(
    batches: Sequence[Batch], system: System, predictions: Sequence[BatchPrediction], shared: SharedSolutions
) -> Array:
    """Chi-square of every run, in the order of the batches; the predictions do not depend on the weights."""

    def batch_chi2(batch: Batch, prediction: BatchPrediction) -> Array:
        fit = evaluate_prediction(batch, system, prediction, derivatives=False, shared=shared)
        return np.asarray(np.bincount(batch.lines.run, fit.chi2 / batch.lines.efficiency, len(batch.run_names)), float)

    return np.concatenate(list(map_batches(batch_chi2, batches, predictions)))
