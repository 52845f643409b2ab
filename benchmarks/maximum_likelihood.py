"""The maximum-likelihood fit of the sample campaign against the same fit with scipy's numerical Jacobian.

Both minimize the same chi-square from the same start, over the same sweeps at both levels. scipy gets the whitened
residuals with the loads eliminated, and differentiates them numerically.

Nine evaluations of chi-square with all derivatives take 1.5 s. Their matrix products alone (derivatives of responses
and transients, weighted ones, information) take 0.6 in bare numpy and in the cache: no fit of this kind takes 0.5.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from balance_cli.campaign.recording.run_file import open_run
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.cli.batch.executors import keep_freed_memory
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.levenberg_marquardt import prior_curvature
from balance_cli.estimation.likelihood import data_chi2, evaluate_batch
from balance_cli.estimation.maximum_likelihood import fit_maximum_likelihood
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.estimation.recorded_loads import recorded_load_columns
from balance_cli.model.balance import BalanceModel, balance_model
from balance_cli.model.system import System
from balance_cli.model.system_response import solve
from benchmarks.comparison import Comparison, program_with_version

Array = NDArray[np.float64]
ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class TimedFit:
    """Processor time [s] of one fit, chi-square at its end, and the estimate."""

    seconds: float
    chi2: float
    theta: Array


def compare() -> list[Comparison]:
    """Time both fits."""
    keep_freed_memory()  # as every command does
    model, batches = _campaign()
    chi2 = _total(model, batches)
    fits = [_time_fit(lambda: _fit_with_balance_cli(model, batches), chi2) for _ in range(3)]
    analytic = min(fits, key=lambda fit: fit.seconds)
    numerical = _time_fit(lambda: _fit_with_numerical_jacobian(model, batches), chi2)
    parameters, lines = model.parameters, sum(len(batch.lines.index) for batch in batches)
    size = f"{lines} lines, {int(parameters.free.sum())} parameters"
    # Masses and stiffnesses have a common scale that sweeps do not tell: the priors alone bound it, where scipy stops.
    above = f"chi² {analytic.chi2:.4g}; scipy's stops {numerical.chi2 - analytic.chi2:.2g} above"
    note = f"{size}, sample campaign; {above}, in the scale that masses and stiffnesses have in common"
    program = program_with_version("scipy", "least_squares with its numerical Jacobian")
    return [Comparison("`identify`, likelihood", "fit", analytic.seconds, program, numerical.seconds, note)]


def _campaign() -> tuple[BalanceModel, tuple[Batch, ...]]:
    geometry = load_geometry(ROOT / "configs" / "rts-6.yaml")
    runs = [open_run(path) for path in sorted((ROOT / "sample_data").glob("sweep-*.h5"))]
    spectra = measured_spectra(runs, geometry)
    return balance_model(geometry), stack_runs(spectra.lines, spectra.statics, geometry.channel_names)


def _total(model: BalanceModel, batches: Sequence[Batch]) -> Callable[[Array], float]:
    return lambda theta: data_chi2(batches, model.system(theta)) + prior_curvature(model.parameters, theta).chi2


def _time_fit(fit: Callable[[], Array], chi2: Callable[[Array], float]) -> TimedFit:
    start = time.process_time()
    theta = fit()
    return TimedFit(time.process_time() - start, chi2(theta), theta)


def _fit_with_balance_cli(model: BalanceModel, batches: Sequence[Batch]) -> Array:
    return fit_maximum_likelihood(model, batches, model.parameters.value).theta


def _fit_with_numerical_jacobian(model: BalanceModel, batches: Sequence[Batch]) -> Array:
    parameters = model.parameters
    free, scale = parameters.free, parameters.scale[parameters.free]
    factors = [
        np.conj(np.linalg.cholesky(_fill_zero_precision(batch.lines.precision))).swapaxes(1, 2) for batch in batches
    ]

    def theta_of(x: Array) -> Array:
        theta = parameters.value.copy()
        theta[free] += x * scale
        return theta

    def residuals(x: Array) -> Array:
        theta = theta_of(x)
        system = model.system(theta)
        parts = [_whiten_residual(batch, factor, system) for batch, factor in zip(batches, factors, strict=True)]
        prior = (theta - parameters.value)[free] / parameters.sigma[free]
        return np.concatenate([*parts, prior])

    result = least_squares(residuals, np.zeros(int(free.sum())), method="trf", x_scale="jac", ftol=1e-9, xtol=1e-12)
    return theta_of(result.x)


def _fill_zero_precision(precision: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Set the precision of channels that were left out to one, so that the factor exists; their residual is zero."""
    dead = np.real(np.diagonal(precision, axis1=1, axis2=2)) == 0
    return precision + np.eye(precision.shape[1]) * dead[:, None, :]


def _whiten_residual(batch: Batch, factor: NDArray[np.complex128], system: System) -> Array:
    """sqrt(2) L* (z - M U0), real and imaginary parts, with U0 the weighted least-squares loads.

    The transients are subtracted from z; the rows of their priors follow.
    """
    solution = solve(system, batch.frequency, batch.spin)
    columns = recorded_load_columns(batch, system, solution)
    transients = evaluate_batch(batch, system, solution).transients
    M = np.concatenate([columns, np.broadcast_to(np.eye(columns.shape[2]), (len(columns), *2 * columns.shape[2:]))], 1)
    channels = batch.lines.channels.copy()
    for transient in transients:
        channels[transient.lines] -= transient.columns @ transient.x
    z = np.concatenate([channels, batch.lines.loads], axis=1)[:, :, None]
    A, b = factor @ M, factor @ z
    U = np.linalg.solve(A.conj().swapaxes(1, 2) @ A, A.conj().swapaxes(1, 2) @ b)
    r = np.sqrt(2.0) * (b - A @ U).reshape(-1)
    r = np.concatenate([r, *(transient.bound @ transient.x for transient in transients)])
    return np.concatenate([r.real, r.imag])
