"""Reduction by harmonics: hub loads of a run from its channels, a response and the static calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import AllTrimsCalibration
from balance_cli.calibration.result import Calibration, TrimCalibration
from balance_cli.campaign.recording.gaps import describe_gaps
from balance_cli.campaign.recording.run import Run, hold_samples
from balance_cli.campaign.rig.attitude import stated_gravity
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.reduction.channel_pairs import PairGain, add_pair_gains
from balance_cli.reduction.check_contradiction import flag_beyond_sweeps, flag_by_held_out_runs, flag_by_turbulence
from balance_cli.reduction.check_errors import check_errors, scale_contradiction
from balance_cli.reduction.flags import EXTRAPOLATED, MODEL_CONTRADICTED, NOT_STEADY
from balance_cli.reduction.gain_error import add_gain_error
from balance_cli.reduction.harmonic_loads import harmonic_loads, harmonic_response, load_problem
from balance_cli.reduction.load_fluctuation import add_load_fluctuation
from balance_cli.reduction.mean_attitude import without_change_of_weight, zero_in_attitude
from balance_cli.reduction.mean_loads import MEANS_REMOVED, MeanLoads, linear_mean_loads, unmeasured_mean_loads
from balance_cli.reduction.mean_loads_nonlinear import nonlinear_mean_loads
from balance_cli.reduction.mean_temperature import mean_loads_at_temperature
from balance_cli.reduction.reliability import UnnoticedErrors, unnoticed_errors
from balance_cli.reduction.response_sources import (
    ResponseSource,
    ResponseWithoutModel,
    StaticSource,
    at_rotor_speed,
)
from balance_cli.reduction.resting_forces import add_resting_forces
from balance_cli.reduction.result import RunConditions, RunLoads
from balance_cli.reduction.rotor_record import RotorRecord, rotor_record
from balance_cli.reduction.series_doubt import add_series_doubt
from balance_cli.reduction.static_disagreement import add_static_disagreement
from balance_cli.reduction.trust import ReducedRecord, assess_trust, nearest_trim
from balance_cli.reduction.undeclared_mass import undeclared_mass
from balance_cli.reduction.vibration_shift import read_deviations
from balance_cli.reduction.weighted_least_squares import SolvedLoads
from balance_cli.reduction.wind_off import ZeroRecord, means_are_removed
from balance_cli.signals.rotor.harmonics import Harmonics

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

ERRORS_UNKNOWN = "sigma of the mean loads contains noise and the residuals stated with the matrix, not its own errors"
"""Note on a run that was reduced by a matrix without standard errors."""


IMPLAUSIBLE_LOAD = 10.0
"""Load over the calibrated range from which all loads of a run are doubted: no balance bears it, a unit explains it."""


@dataclass(frozen=True)
class ReduceOptions:
    """Options of a reduction: harmonics 0 to `harmonics` of `rotor` 1, 2 and so on are reduced."""

    harmonics: int = 8
    rotor: int = 1


def reduce_run(
    run: Run,
    geometry: Geometry,
    calibration: Calibration | None,
    source: ResponseSource,
    zero: ZeroRecord | None = None,
    options: ReduceOptions | None = None,
) -> RunLoads:
    """Reduce one `check` or `wind` run to hub loads; without a calibration its mean loads are not measured.

    Raises UserError where the pulses are unusable or the usable channels do not determine the loads.
    """
    options = options or ReduceOptions()
    source = at_rotor_speed(source, run.rotor_speed)
    record = rotor_record(hold_samples(run), geometry, source, options.harmonics, options.rotor)
    loads = reduce_record(record, geometry, calibration, source, zero)
    return flag_by_turbulence(loads, record, geometry, source)


def reduce_record(
    record: RotorRecord,
    geometry: Geometry,
    calibration: Calibration | None,
    source: ResponseSource,
    zero: ZeroRecord | None = None,
    amplitudes: ComplexArray | None = None,
) -> RunLoads:
    """Return the hub loads of a record whose harmonics are known.

    `amplitudes` (n, m) of harmonics 1 to n, estimated in another way, replace those that the inverted response gives;
    the errors, the redundancy and the condition remain those of the inverted response.
    """
    record = add_load_fluctuation(record, geometry, source)
    mean_solution = _mean_loads(record, calibration, source, zero)
    response = harmonic_response(record, geometry, source)
    problem = load_problem(record, geometry, source, response)
    harmonic_solution = _add_dynamic_error(problem.solve(), record, geometry, source)
    harmonic_solution, gains = add_pair_gains(harmonic_solution, record, geometry, source, response)
    if amplitudes is not None:
        harmonic_solution = replace(harmonic_solution, loads=amplitudes)
    errors_known = calibration is None or calibration.errors_known
    notes = record.azimuth.notes if errors_known else (*record.azimuth.notes, ERRORS_UNKNOWN)
    loads = _combine_loads(record, mean_solution, harmonic_solution, source, geometry)
    added_mass = undeclared_mass(record, geometry, source, problem, harmonic_solution)
    sigma = np.maximum(loads.sigma_cosine, loads.sigma_sine)
    static = None if calibration is None else nearest_trim(calibration, loads)
    trust = assess_trust(ReducedRecord(record, geometry, source, static, response, problem, harmonic_solution, sigma))
    shared = (line.description for line in record.confounded)
    lines = (*filter(None, [describe_gaps(record.run)]), *shared, *trust.notes)
    further = filter(None, [mean_solution.note, source.note if isinstance(source, ResponseWithoutModel) else ""])
    loads = replace(loads, flags=trust.flags(loads.flags), notes=(*notes, *lines, *further))
    loads = replace(loads, wrong_channels=trust.wrong_channels or None, undeclared_mass=added_mass)
    loads = _flag_pair_gains(_with_changes(loads, trust.mean_change, trust.harmonic_error), gains)
    if static is not None:
        loads = _flag_implausible(loads, static)
    loads = flag_beyond_sweeps(flag_by_held_out_runs(loads, source), source)
    if not record.run.has_loads or record.run.kind != "check":
        return loads
    return _with_check_errors(loads, record, harmonic_solution, geometry, source, response)


def _with_changes(loads: RunLoads, change: Array | None, harmonic_error: Array | None) -> RunLoads:
    """Return the loads with half of the change (m,) of the means within the record in their sigma.

    Nobody knows whether what is sought is the load before or after: where a channel stepped, one of them is right.
    `harmonic_error` (n, m) is what changes leave in the harmonics.
    """
    cosine, sine = loads.sigma_cosine.copy(), loads.sigma_sine.copy()
    if change is not None and change.any():
        cosine[0] = np.hypot(cosine[0], 0.5 * change)
    if harmonic_error is not None:
        cosine[1:], sine[1:] = np.hypot(cosine[1:], harmonic_error), np.hypot(sine[1:], harmonic_error)
    return replace(loads, sigma_cosine=cosine, sigma_sine=sine)


def _flag_pair_gains(loads: RunLoads, gains: tuple[PairGain, ...]) -> RunLoads:
    """Return the loads with what the two channels of cells differ by in words, flagged where that drifts."""
    for pair in gains:
        loads = loads.with_flag(NOT_STEADY, pair.description, where=pair.drift is not None)
    return loads


def _unnoticed_errors(
    record: RotorRecord, geometry: Geometry, source: ResponseSource, solved: SolvedLoads
) -> UnnoticedErrors | None:
    """Return what the residual test does not show of errors of sensors; None where its rows are not channels."""
    live = record.health.live
    if not source.channel_combination(record.spectra.frequency_hz[1:2], live).rows_are_channels:
        return None
    sources = {channel.name: channel.source for channel in geometry.channels}
    return unnoticed_errors(solved.equations, [sources[name] for name in live], solved.degrees, solved.limit)


def _with_check_errors(
    loads: RunLoads,
    record: RotorRecord,
    solution: SolvedLoads,
    geometry: Geometry,
    source: ResponseSource,
    response: ComplexArray,
) -> RunLoads:
    """Return the loads of a check run with their errors, flagged where these are those of another unit or sign."""
    from balance_cli.reduction.known_load_channels import describe_wrong_channels  # wind runs do without

    check = check_errors(record, solution, geometry, source)
    wrong = describe_wrong_channels(record, geometry, source, response, check.applied)
    return flag_scale_contradiction(replace(loads, check=replace(check, wrong_channels=wrong)))


def flag_scale_contradiction(loads: RunLoads) -> RunLoads:
    """Return the loads of a check run, all flagged where the known loads have another unit or sign."""
    if loads.check is None:
        return loads
    contradiction = scale_contradiction(loads.check, loads.amplitude, loads.components)
    return loads.with_flag(MODEL_CONTRADICTED, contradiction) if contradiction else loads


def _flag_implausible(loads: RunLoads, static: TrimCalibration) -> RunLoads:
    """Return the loads, all flagged where one is far beyond what was ever applied to the balance."""
    largest = dict(zip(static.components, static.calibrated_range.tolist(), strict=True))
    reached = {
        name: float(np.nanmax(np.abs(loads.amplitude[:, m]), initial=0.0)) / largest[name]
        for m, name in enumerate(loads.components)
        if largest.get(name, 0.0) > 0.0
    }
    worst = max(reached, key=lambda name: reached[name], default="")
    if not worst or reached[worst] < IMPLAUSIBLE_LOAD:
        return loads
    note = f"{worst} reaches {reached[worst]:.3g} times the calibrated range: are the channels in V?"
    return loads.with_flag(EXTRAPOLATED, note)


def _mean_loads(
    record: RotorRecord, calibration: Calibration | None, source: ResponseSource, zero: ZeroRecord | None
) -> MeanLoads:
    """Return the mean loads by the calibration, with what else makes them uncertain."""
    if calibration is None:
        return add_gain_error(unmeasured_mean_loads(record.components), source)
    if means_are_removed(record, calibration):
        return add_gain_error(unmeasured_mean_loads(record.components, MEANS_REMOVED), source)
    loads = _calibrated_mean_loads(record, calibration, zero)
    loads = add_resting_forces(loads, record, calibration, source, zero is not None)
    loads = add_static_disagreement(loads, record.health, calibration, source)
    return add_gain_error(add_series_doubt(loads, calibration), source)


def _calibrated_mean_loads(record: RotorRecord, calibration: Calibration, zero: ZeroRecord | None) -> MeanLoads:
    """Return the mean loads by the calibration model through all trims if nonlinear, else by the nearest trim."""
    all_trims, health = calibration.all_trims, record.health
    deviations: Array | None = None
    if all_trims is not None and all_trims.loads_model.is_nonlinear:
        deviations = read_deviations(record, all_trims.loads_model.channel_names)

    def solve(spectra: Harmonics, reference: ZeroRecord | None) -> MeanLoads:
        if all_trims is not None and _computes_means(all_trims, len(calibration.trims)):
            return nonlinear_mean_loads(spectra, calibration, all_trims.loads_model, health, reference, deviations)
        return linear_mean_loads(spectra, calibration, health, reference)

    gravity = stated_gravity(record.run.conditions)
    turned = zero_in_attitude(zero, gravity, calibration)
    loads = mean_loads_at_temperature(record, calibration, turned, solve)
    return without_change_of_weight(loads, gravity, zero, calibration)


def _computes_means(all_trims: AllTrimsCalibration, trims: int) -> bool:
    """Whether the model of all trims computes mean loads, not the matrices of the trims.

    The non-iterative method does where the calibration has it. With random terms alone it does where there is one
    matrix and the schedule told every product: that nearest in load is closer than terms of which none is significant,
    and errors of products that nobody saw would widen sigma.
    """
    if all_trims.model.is_nonlinear or all_trims.non_iterative is not None:
        return True
    untested = all_trims.untested_products
    return all_trims.random_terms is not None and trims == 1 and (untested is None or not len(untested.pairs))


def _combine_loads(
    record: RotorRecord,
    mean_solution: MeanLoads,
    harmonic_solution: SolvedLoads,
    source: ResponseSource,
    geometry: Geometry,
) -> RunLoads:
    """Return the loads with harmonic 0 from the mean loads and the others from the harmonic loads."""
    run, spectra, m = record.run, record.spectra, len(mean_solution.components)
    variance = np.diagonal(harmonic_solution.inflated_covariance, axis1=1, axis2=2)
    unmeasured = np.isnan(mean_solution.loads)
    mean = np.where(unmeasured, complex(np.nan, np.nan), mean_solution.loads)
    return RunLoads(
        run=run.name,
        kind=run.kind,
        response=source.description,
        trim=mean_solution.trim,
        components=mean_solution.components,
        frequency_hz=np.asarray(np.arange(len(spectra.frequency_hz)) * record.azimuth.mean_rate, float),
        amplitude=np.concatenate([mean[None, :], harmonic_solution.loads]),
        sigma_cosine=np.concatenate([mean_solution.sigma[None, :], np.sqrt(variance[:, :m])]),
        sigma_sine=np.concatenate([np.where(unmeasured, np.nan, 0.0)[None, :], np.sqrt(variance[:, m:])]),
        flags=(mean_solution.flags, *(("",) * m for _ in harmonic_solution.loads)),
        redundancy=np.concatenate([[mean_solution.redundancy], harmonic_solution.redundancy_chi2]),
        redundancy_limit=np.concatenate([[mean_solution.redundancy_limit], harmonic_solution.limit]),
        condition=np.concatenate([[mean_solution.condition], harmonic_solution.condition]),
        left_out=record.health.left_out,
        interval=spectra.interval,
        rotor=None if record.rotor == 1 else record.rotor,
        conditions=RunConditions(run.rotor_speed, run.recorded, run.note, dict(run.conditions)),
        mean_method=mean_solution.method or None,
        unnoticed=_unnoticed_errors(record, geometry, source, harmonic_solution),
    )


def _add_dynamic_error(
    solution: SolvedLoads, record: RotorRecord, geometry: Geometry, source: ResponseSource
) -> SolvedLoads:
    """Return the loads by a static matrix with the error of leaving out the dynamics; other loads as they are.

    The error is estimated by the loads that the rig as declared gives for the same record: its standard deviation is
    their difference, and that of the declared rig by its tolerances. A rig without declared mechanics has no estimate.
    """
    if not isinstance(source, StaticSource):
        return solution
    # Identification takes half a second to import, which other responses do without.
    from balance_cli.estimation.measured_spectra import Spectra
    from balance_cli.reduction.model_sources import model_source
    from balance_cli.steps.identify import IdentifyOptions, identify

    try:
        declared = identify(Spectra((), (), {}, {}), geometry, IdentifyOptions(method="computed"))
        reference = harmonic_loads(record, geometry, model_source(declared))
    except (UserError, np.linalg.LinAlgError):
        return solution
    square = np.tile(np.abs(solution.loads - reference.loads) ** 2, 2)
    error = square[:, :, None] * np.eye(square.shape[1]) + reference.covariance
    return replace(solution, model_covariance=solution.model_covariance + error)
