"""Identify the balance in the form of the 1985 paper: options, the fit, and what is told of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from balance_cli.errors import UserError
from balance_cli.estimation.paper.equations import (
    Coefficients,
    Mode,
    declared_coefficients,
    free_coefficients,
    is_stable,
    model_response,
    model_response_jacobian,
    modes,
)
from balance_cli.estimation.paper.least_squares import equation_error_fit
from balance_cli.estimation.paper.likelihood import OutputErrorFit, maximum_likelihood
from balance_cli.estimation.paper.misfit import Misfit, misfit
from balance_cli.estimation.paper.output_error import Noise, grouped
from balance_cli.estimation.paper.sensors import SensorRule, sensor_rule
from balance_cli.estimation.paper.spectra import SensorSpectra, sensor_spectra
from balance_cli.estimation.paper.starts import best_start
from balance_cli.geometry import Geometry
from balance_cli.signals.lines import Lines

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

PAPER_BAND = (10.0, 125.0)


@dataclass(frozen=True)
class PaperOptions:
    """How to identify.

    `method`: `ls` (equation error), `ml` (output error, begun at the geometry) or `ls+ml` (begun at least squares or
    the geometry, whichever fits better). `damping`: D `diagonal` (the paper's) or `full`. `band` [Hz]: the lines that
    take part, 10 to 125 Hz in the paper. `noise`: S `full` (the paper's), `diagonal` (independent sensors) or `equal`
    (sigma^2 I); with a full S that finds no minimum the fit falls back on a diagonal one. `line_weighting` of the
    equation error: `plain` (the paper's), or `displacement`, divided by omega^2.
    """

    method: Literal["ls", "ml", "ls+ml"] = "ls+ml"
    damping: Literal["diagonal", "full"] = "diagonal"
    band: tuple[float, float] = PAPER_BAND
    noise: Noise = "full"
    line_weighting: Literal["plain", "displacement"] = "plain"
    max_iterations: int = 80


@dataclass(frozen=True)
class PaperFit:
    """Eq. (6) identified: s'' + D s' + K s = B_F u for the sensors of `rule` and the `inputs`.

    `model` holds D (n, n) [1/s], K (n, n) [1/s2] and B_F (n, m) [1/s2, 1/(m s2)], `free` (n, 2n+m) which entries of
    [D, K, B_F] were fitted, `covariance` (p, p) theirs, in row order. `S` (n, n) is the residual covariance: estimated
    from the very residuals, so that chi2 against it is 1 by construction (output error [N2]; equation error [N2/s4]
    after `ls`); `noise` tells which form of S was used in the end. `misfit` compares with the noise measured in the
    runs instead. `start` names where the maximum likelihood began; `cost` is N ln det S, NaN after `ls`.
    """

    rule: SensorRule
    inputs: tuple[str, ...]
    model: Coefficients
    free: NDArray[np.bool_]
    covariance: Array
    S: ComplexArray
    noise: Noise
    modes: tuple[Mode, ...]
    misfit: Misfit
    options: PaperOptions
    lines: int
    start: str
    cost: float
    iterations: int
    converged: bool

    @property
    def parameters(self) -> Array:
        """The fitted entries (p,) of [D, K, B_F], row by row."""
        return self.model.table[self.free]

    @property
    def sigma(self) -> Array:
        """One standard deviation (p,) of the parameters."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names such as `D[x,x]`, `K[x,y1]`, `B_F[x,Fx]`, in the order of `parameters`."""
        return tuple(name for name, _ in _labels(self))

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """Units in the order of `parameters`."""
        return tuple(unit for _, unit in _labels(self))

    @property
    def stable(self) -> bool:
        """Whether every mode is damped; least squares may leave one that is not."""
        return is_stable(self.model)


def _labels(fit: PaperFit) -> list[tuple[str, str]]:
    sensors = fit.rule.names
    columns = [("D", name, "1/s") for name in sensors] + [("K", name, "1/s2") for name in sensors]
    columns += [("B_F", name, "1/s2" if name.startswith("F") else "1/(m s2)") for name in fit.inputs]
    return [
        (f"{columns[column][0]}[{sensors[row]},{columns[column][1]}]", columns[column][2])
        for row, column in np.argwhere(fit.free)
    ]


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
