"""Identification in the frequency domain: least squares, then maximum likelihood, all runs at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.selection.fit import Fit
from balance_cli.diagnosis.selection.mains_frequency import refit_at_best_frequency
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.choices import GOOD_FIT_CHI2_PER_DOF, Damping, Form, Method
from balance_cli.estimation.effect_inaccuracy import effect_inaccuracy_variance
from balance_cli.estimation.equation_error import fit_equation_error
from balance_cli.estimation.fit_quality import excited_band, fit_quality, frf_band
from balance_cli.estimation.force_noise import add_force_noise
from balance_cli.estimation.identifiability import (
    covariance_from_information,
    parameter_identifiability,
    unidentifiable_directions,
)
from balance_cli.estimation.identified_model import FitQuality, IdentifiedModel, ParameterTable
from balance_cli.estimation.levenberg_marquardt import Minimum, prior_curvature
from balance_cli.estimation.likelihood import Curvature, data_chi2, data_curvature
from balance_cli.estimation.maximum_likelihood import TOLERANCE, fit_best_start, fit_maximum_likelihood
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.estimation.mode_table import mode_table
from balance_cli.estimation.paper.result import PAPER_BAND, PaperOptions
from balance_cli.estimation.response_error import ResponseError
from balance_cli.estimation.response_error_estimate import estimate_response_error
from balance_cli.estimation.starting_values import (
    StartingPoints,
    find_starting_values,
    start_from_equations_of_motion,
)
from balance_cli.io.errors import UserError
from balance_cli.model.balance import BalanceModel, balance_model
from balance_cli.model.fitted_effects import FittedEffect, declare_fitted_effects, fitted_effects
from balance_cli.model.placed_effects import without_effects
from balance_cli.model.system import System
from balance_cli.steps.identify_paper_form import identify_in_paper_form
from balance_cli.steps.static_series import with_load_series

Array = NDArray[np.float64]

# Band of the equation error: frequency zero, which has no information on mass and damping, is left out.
DYNAMIC_BAND = (float(np.finfo(float).tiny), np.inf)


@dataclass(frozen=True)
class IdentifyOptions:
    """How to identify: `method`, `form`, the damping matrix of the paper's form, and the band [Hz] of the lines.

    Without a band the physical form uses all lines, the paper's those from 10 to 125 Hz.
    """

    method: Method = "ls+ml"
    form: Form = "physical"
    damping: Damping = "diagonal"
    band: tuple[float, float] | None = None


def identify(spectra: Spectra, geometry: Geometry, options: IdentifyOptions | None = None) -> IdentifiedModel:
    """Fit the balance to the lines of all sweeps and to the static points at once.

    The effects that the geometry declares are fitted too, from their declared values; the geometry of the model has
    their fitted values. Raises UserError where there is no sweep or no line in the band, and where effects are declared
    for a method or form that has none.
    """
    options = options or IdentifyOptions()
    if options.method != "computed" and not spectra.lines:
        raise UserError("no sweep run to identify from", remedy="Give at least one sweep run")
    _check_effects(geometry, options)
    if options.form == "paper":
        return identify_in_paper_form(spectra, geometry, _paper_options(options))
    spectra = with_load_series(spectra.in_band(options.band))
    return replace(_identify_physical_form(spectra, geometry, options), band=options.band)


def _check_effects(geometry: Geometry, options: IdentifyOptions) -> None:
    if not geometry.effects:
        return
    names = ", ".join(effect.name for effect in geometry.effects)
    if options.form == "paper":
        raise UserError(f"the paper's form has no effects ({names})", "--form", remedy="Use `physical`")
    if options.method == "ls":
        raise UserError(f"least squares cannot fit effects ({names})", "--method", remedy="Use ml or ls+ml")


def _paper_options(options: IdentifyOptions) -> PaperOptions:
    if options.method == "computed":
        raise UserError("the paper's form is identified, not computed", "--method", remedy="Use ls, ml or ls+ml")
    return PaperOptions(method=options.method, damping=options.damping, band=options.band or PAPER_BAND)


def _identify_physical_form(spectra: Spectra, geometry: Geometry, options: IdentifyOptions) -> IdentifiedModel:
    model = balance_model(geometry)
    batches = stack_runs(spectra.lines, spectra.statics, geometry.channel_names)
    if options.method == "computed":
        model = model.with_exact_effects()
        minimum, start = _declared_estimate(model, batches), "geometry"
    else:
        minimum, start = _fit_model(model, batches, _loaded_batches(spectra, geometry), options)
        # Along the frequency of a tone chi-square has a minimum for each lobe of the spectrum.
        settings = replace(DEFAULT_SETTINGS, fit=replace(DEFAULT_SETTINGS.fit, comparison_tolerance=TOLERANCE))
        minimum = refit_at_best_frequency(Fit.at_minimum(model, minimum), model.effects, batches, settings).minimum
        minimum, batches = _weight_by_force_noise(model, minimum, batches)
    return build_identified_model(model, batches, minimum, options.method, start, spectra)


def _weight_by_force_noise(
    model: BalanceModel, minimum: Minimum, batches: tuple[Batch, ...]
) -> tuple[Minimum, tuple[Batch, ...]]:
    """The fit continued with the noise of nonlinear forces in its weights, and the lines so weighted."""
    system = model.system(minimum.theta, derivatives=False)
    if not system.equations.forces:
        return minimum, batches
    weighted = add_force_noise(batches, system)
    return fit_maximum_likelihood(model, weighted, minimum.theta), weighted


def _declared_estimate(model: BalanceModel, batches: Sequence[Batch]) -> Minimum:
    """The declared parameters, with the tolerances for their covariance."""
    theta = model.parameters.value
    p = int(model.parameters.free.sum())
    chi2 = data_chi2(batches, model.system(derivatives=False))
    data = Curvature(chi2, np.zeros(p), np.zeros((p, p)))
    return Minimum(theta, data, data + prior_curvature(model.parameters, theta), 0, True)


def _loaded_batches(spectra: Spectra, geometry: Geometry) -> tuple[Batch, ...]:
    """The lines that have loads, without the means; the linear part of the static rows."""
    lines = [run.select(run.frequency > 0) for run in spectra.lines]
    statics = [replace(points, share=None) for points in spectra.statics]
    return stack_runs(lines, statics, geometry.channel_names)


def _fit_model(
    model: BalanceModel, batches: Sequence[Batch], loaded: Sequence[Batch], options: IdentifyOptions
) -> tuple[Minimum, str]:
    """The estimate, and the name of its start: equations of motion, least squares or geometry, whichever fits best.

    The starts are computed from the `loaded` lines. With effects the fits from two starts are compared after some
    iterations, and the better one is continued.
    """
    declared = model.parameters.value
    if options.method == "ml":
        return fit_maximum_likelihood(model, batches, declared), "geometry"
    first = _fit_rigid_equation_error(model, loaded)
    if options.method == "ls":
        if first is None:
            fault = "least squares need channels of cells that determine every motion of the plate"
            raise UserError(fault, "--method", remedy="Use ml")
        data = data_curvature(batches, model.system(first.theta))
        total = data + prior_curvature(model.parameters, first.theta)
        return Minimum(first.theta, data, total, first.iterations, first.converged), "geometry"
    if model.geometry.effects:
        points = find_starting_values(model.parameters, loaded, model.system, declared)
        return _fit_with_effects(model, batches, points)
    motion = start_from_equations_of_motion(model.parameters, loaded, model.system, declared)
    starts = {"equations of motion": motion}
    if first is not None:
        starts["least squares"] = first.theta
    starts["geometry"] = declared
    best = min(starts, key=lambda name: data_chi2(batches, model.system(starts[name], derivatives=False)))
    return fit_maximum_likelihood(model, batches, starts[best]), best


def _fit_with_effects(model: BalanceModel, batches: Sequence[Batch], points: StartingPoints) -> tuple[Minimum, str]:
    """The better fit from two starts; from the declared parameters where neither start is physical.

    Raises UserError where these are not physical either for the measured loads.
    """
    try:
        return fit_best_start(model, batches, {"least squares": points.effects_free, "geometry": points.effects_fixed})
    except np.linalg.LinAlgError:
        try:
            return fit_maximum_likelihood(model, batches, model.parameters.value), "geometry"
        except np.linalg.LinAlgError as error:
            names = ", ".join(f"`{effect.label}`" for effect in model.effects)
            fault = f"no start with {names} is physical: {error}"
            remedy = "Leave the effect out, or declare parameters near the true ones in `effects`"
            raise UserError(fault, place="effects", remedy=remedy) from error


def _fit_rigid_equation_error(model: BalanceModel, batches: Sequence[Batch]) -> Minimum | None:
    """Fit the rigid balance by its equation error: the cells' forces do not determine the motion of a flexible part."""
    rigid = balance_model(without_effects(model.geometry))
    return fit_equation_error(rigid.parameters, batches, rigid.system, DYNAMIC_BAND)


def build_identified_model(
    model: BalanceModel,
    batches: Sequence[Batch],
    minimum: Minimum,
    method: str,
    start: str,
    spectra: Spectra,
) -> IdentifiedModel:
    """The model at a minimum with its covariance, modes and quality; `start` and `method` name how it was found."""
    covariance = covariance_from_information(minimum.total.information)
    inaccuracy = effect_inaccuracy_variance(model, minimum.theta, batches)
    covariance = covariance + np.diag(inaccuracy[model.parameters.free])
    identifiability = parameter_identifiability(model.parameters, minimum.data.information)
    system = model.system(minimum.theta)
    band = frf_band(batches, model.geometry)
    quality = fit_quality(batches, system, identifiability.effective_parameters, band)
    return IdentifiedModel(
        form="physical",
        method=method,
        start=start,
        geometry=declare_fitted_effects(model.geometry, model.parameters.names, minimum.theta.tolist()),
        parameters=_parameter_table(model, minimum.theta, covariance, identifiability.informed_by),
        covariance=_expand_covariance(model, covariance),
        modes=mode_table(model, minimum.theta, covariance),
        quality=quality,
        unidentifiable=()
        if method == "computed"
        else unidentifiable_directions(model.parameters, minimum.data.information),
        channels_left_out=spectra.channels_left_out,
        iterations=minimum.iterations,
        converged=minimum.converged,
        response_error=_error_of_misfit(batches, system, quality, model.geometry),
        usual_noise=spectra.usual_noise or None,
        excited_band=excited_band(batches),
    )


def _error_of_misfit(
    batches: Sequence[Batch], system: System, quality: FitQuality, geometry: Geometry
) -> ResponseError | None:
    """What the system misses of the measured responses; None where it describes them to within their noise."""
    if not quality.chi2_per_dof > GOOD_FIT_CHI2_PER_DOF:
        return None
    return estimate_response_error(batches, system, geometry.channel_names)


def identified_effects(model: IdentifiedModel) -> tuple[FittedEffect, ...]:
    """The effects of a model with their fitted parameters."""
    table = model.parameters
    return fitted_effects(model.geometry, table.names, table.value.tolist(), table.sigma.tolist())


def _expand_covariance(model: BalanceModel, covariance: Array) -> Array:
    """The covariance of the free parameters among all, zero rows and columns for exact ones."""
    free, p = model.parameters.free, len(model.parameters)
    full = np.zeros((p, p))
    full[np.ix_(free, free)] = covariance
    return full


def _parameter_table(
    model: BalanceModel, theta: Array, covariance: Array, informed_by: tuple[str, ...]
) -> ParameterTable:
    parameters = model.parameters
    sigma = np.sqrt(np.diag(_expand_covariance(model, covariance)))
    return ParameterTable(
        names=parameters.names,
        units=parameters.units,
        value=theta,
        # Of a free one that changes nothing in these data the covariance is zero, but it is not known exactly.
        sigma=np.where(parameters.free & (sigma == 0.0), parameters.scale, sigma),
        declared=parameters.value,
        declared_sigma=parameters.sigma,
        informed_by=informed_by,
    )
