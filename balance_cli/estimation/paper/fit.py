"""Identification in the form of the 1985 paper."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.paper.equations import (
    Coefficients,
    declared_coefficients,
    free_coefficients,
    model_response,
    model_response_jacobian,
    modes_of_coefficients,
)
from balance_cli.estimation.paper.initial_models import select_initial_model
from balance_cli.estimation.paper.least_squares import fit_linear_equations
from balance_cli.estimation.paper.likelihood import OutputErrorFit, maximize_likelihood
from balance_cli.estimation.paper.misfit import Misfit, compare_with_measurement
from balance_cli.estimation.paper.output_error import group_by_frequency
from balance_cli.estimation.paper.result import PaperFit, PaperOptions
from balance_cli.estimation.paper.sensors import SensorRule, sensor_rule
from balance_cli.estimation.paper.spectra import SensorSpectra, sensor_spectra
from balance_cli.io.errors import UserError
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def identify_paper_form(
    geometry: Geometry,
    runs: Sequence[RunSpectrum],
    options: PaperOptions | None = None,
    frf_band: tuple[float, float] | None = None,
) -> PaperFit:
    """Identify the balance in the paper's form from the lines of sweep runs.

    `frf_band` [Hz] is that of the relative response errors, by default all lines. Runs that do not excite the plate are
    not used. Raises UserError where the cells do not fit the form, a cell has no channel, or the runs do not determine
    the equations.
    """
    options = options or PaperOptions()
    rule = sensor_rule(geometry)
    all_spectra = sensor_spectra(geometry, rule, runs)
    spectra = all_spectra.in_band(options.band)
    if not len(spectra.frequency):
        raise UserError(f"no line from {options.band[0]:g} to {options.band[1]:g} Hz", remedy="Widen the band")
    free = free_coefficients(len(rule.names), len(spectra.inputs), options.damping == "full")
    band = frf_band or (float(all_spectra.frequency.min()), float(all_spectra.frequency.max()))

    def misfit(model: Coefficients) -> Misfit:
        return compare_with_measurement(all_spectra, spectra, model, int(free.sum()), band)

    if options.method == "ls":
        weight = None if options.line_weighting == "plain" else 1.0 / spectra.frequency**2
        first = fit_linear_equations(spectra, free, weight)
        estimate = OutputErrorFit(first.model, first.covariance, first.residual_covariance, "full", np.nan, 0, True)
        return _build_fit(rule, misfit(estimate.model), spectra, free, estimate, "", options)
    estimate, start = _fit_maximum_likelihood(geometry, rule, spectra, free, options)
    return _build_fit(rule, misfit(estimate.model), spectra, free, estimate, start, options)


def _fit_maximum_likelihood(
    geometry: Geometry, rule: SensorRule, spectra: SensorSpectra, free: NDArray[np.bool_], options: PaperOptions
) -> tuple[OutputErrorFit, str]:
    data, full = group_by_frequency(spectra), free_coefficients(len(rule.names), len(spectra.inputs), True)
    starts = {"geometry": declared_coefficients(geometry, rule, spectra.inputs)}
    # Least squares raises UserError where lines or sweeps are too few, whatever the start.
    first = fit_linear_equations(spectra, full)
    if options.method == "ls+ml":
        starts["least squares"] = first.model
    model, origin = select_initial_model(data, starts, options.damping == "full")
    return maximize_likelihood(data, free, model, options.noise, options.max_iterations), origin


def _build_fit(
    rule: SensorRule,
    misfit: Misfit,
    spectra: SensorSpectra,
    free: NDArray[np.bool_],
    estimate: OutputErrorFit,
    start: str,
    options: PaperOptions,
) -> PaperFit:
    return PaperFit(
        rule=rule,
        inputs=spectra.inputs,
        model=estimate.model,
        free=free,
        covariance=estimate.covariance,
        S=estimate.S,
        noise=estimate.noise,
        modes=modes_of_coefficients(estimate.model, free, estimate.covariance),
        misfit=misfit,
        options=options,
        line_count=len(spectra.frequency),
        start=start,
        cost=estimate.cost,
        iterations=estimate.iterations,
        converged=estimate.converged,
    )


def response(fit: PaperFit, frequency: Array) -> ComplexArray:
    """s/u (k, n, m) [N/N, N/(N m)] at `frequency` (k,) [Hz]; 0 gives the static response."""
    return model_response(fit.model, np.asarray(frequency, float))


def response_jacobian(fit: PaperFit, frequency: Array) -> ComplexArray:
    """Derivative (k, n, m, p) of s/u by the parameters, in the order of `fit.parameters`."""
    return model_response_jacobian(fit.model, fit.free, np.asarray(frequency, float))
