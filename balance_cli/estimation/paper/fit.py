"""Identify the balance in the form of the 1985 paper: options, the fit, and what is told of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.paper.equations import (
    declared_coefficients,
    free_coefficients,
    model_response,
    model_response_jacobian,
    modes,
)
from balance_cli.estimation.paper.initial_models import best_start
from balance_cli.estimation.paper.least_squares import equation_error_fit
from balance_cli.estimation.paper.likelihood import OutputErrorFit, maximum_likelihood
from balance_cli.estimation.paper.misfit import misfit
from balance_cli.estimation.paper.output_error import grouped
from balance_cli.estimation.paper.result import PaperFit, PaperOptions
from balance_cli.estimation.paper.sensors import SensorRule, sensor_rule
from balance_cli.estimation.paper.spectra import SensorSpectra, sensor_spectra
from balance_cli.io.errors import UserError
from balance_cli.signals.run_spectrum import Lines

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def identify_paper_form(geometry: Geometry, runs: Sequence[Lines], options: PaperOptions | None = None) -> PaperFit:
    """Identify the balance in the paper's form from the lines of sweep runs.

    Runs that leave the plate alone are not used. Raises UserError where the cells do not fit the form, a cell has no
    channel, or the runs do not determine the equations.
    """
    options = options or PaperOptions()
    rule = sensor_rule(geometry)
    everything = sensor_spectra(geometry, rule, runs)
    spectra = everything.within(options.band)
    if not len(spectra.frequency):
        raise UserError(f"no line from {options.band[0]:g} to {options.band[1]:g} Hz", remedy="Widen the band")
    free = free_coefficients(len(rule.names), len(spectra.inputs), options.damping == "full")
    if options.method == "ls":
        weight = None if options.line_weighting == "plain" else 1.0 / spectra.frequency**2
        first = equation_error_fit(spectra, free, weight)
        found = OutputErrorFit(first.model, first.covariance, first.residual_covariance, "full", np.nan, 0, True)
        return _described(rule, everything, spectra, free, found, "", options)
    found, start = _maximum_likelihood(geometry, rule, spectra, free, options)
    return _described(rule, everything, spectra, free, found, start, options)


def _maximum_likelihood(
    geometry: Geometry, rule: SensorRule, spectra: SensorSpectra, free: NDArray[np.bool_], options: PaperOptions
) -> tuple[OutputErrorFit, str]:
    data, full = grouped(spectra), free_coefficients(len(rule.names), len(spectra.inputs), True)
    starts = {"geometry": declared_coefficients(geometry, rule, spectra.inputs)}
    # Least squares also finds out where lines or sweeps are too few, whatever the start.
    first = equation_error_fit(spectra, full)
    if options.method == "ls+ml":
        starts["least squares"] = first.model
    model, origin = best_start(data, starts, options.damping == "full")
    return maximum_likelihood(data, free, model, options.noise, options.max_iterations), origin


def _described(
    rule: SensorRule,
    everything: SensorSpectra,
    spectra: SensorSpectra,
    free: NDArray[np.bool_],
    found: OutputErrorFit,
    start: str,
    options: PaperOptions,
) -> PaperFit:
    return PaperFit(
        rule=rule,
        inputs=spectra.inputs,
        model=found.model,
        free=free,
        covariance=found.covariance,
        S=found.S,
        noise=found.noise,
        modes=modes(found.model, free, found.covariance),
        misfit=misfit(everything, spectra, found.model, int(free.sum())),
        options=options,
        lines=len(spectra.frequency),
        start=start,
        cost=found.cost,
        iterations=found.iterations,
        converged=found.converged,
    )


def response(fit: PaperFit, frequency: Array) -> ComplexArray:
    """s/u (k, n, m) [N/N, N/(N m)] at `frequency` (k,) [Hz]; 0 gives the static response."""
    return model_response(fit.model, np.asarray(frequency, float))


def response_jacobian(fit: PaperFit, frequency: Array) -> ComplexArray:
    """Derivative (k, n, m, p) of s/u by the parameters, in the order of `fit.parameters`."""
    return model_response_jacobian(fit.model, fit.free, np.asarray(frequency, float))
