"""Errors of hub loads and responses on hold-out runs, which no fit has used, before and after updating a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.channel_health import live_channels
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.diagnosis.result import HoldOut, RunErrors
from balance_cli.estimation.fit_quality import fit_quality, frf_band
from balance_cli.estimation.identified_model import IdentifiedModel, identified_system
from balance_cli.estimation.measured_spectra import Spectra, measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.estimation.nonlinear_contribution import remove_nonlinear_contribution
from balance_cli.io.errors import UserError
from balance_cli.model.exciter_loads import exciters_resist_motion, true_load_matrices
from balance_cli.model.system_response import solve
from balance_cli.reduction.check_errors import HARMONICS_COMPARED, check_errors
from balance_cli.reduction.harmonic_loads import harmonic_loads, harmonic_response
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.result import CheckErrors
from balance_cli.reduction.rotor_record import RotorRecord, rotor_record
from balance_cli.reduction.weighted_least_squares import SolvedLoads
from balance_cli.signals.run_spectrum import RunSpectrum

ComplexArray = NDArray[np.complex128]

HOLD_OUT_KINDS = ("check", "sweep")
OTHER_EXCITERS = "made with other exciters: it is described without the mass and stiffness of those of the sweeps"


def hold_out_errors(run: Run, before: IdentifiedModel, after: IdentifiedModel) -> HoldOut:
    """Return the errors of a run by the model before and after updating, and the noise floor of its record.

    A `check` run has errors of its hub loads and of its response at the rotor harmonics 1 to 8, a `sweep` run those of
    its response in the band of `frf_band`. Raises UserError for other kinds, and where the run cannot be reduced.
    """
    require_known_loads(run)
    errors = _check_run_errors if run.kind == "check" else _sweep_run_errors
    new = errors(run, after)
    return HoldOut(errors(run, before).error, new.error, new.noise, new.set_up, new.expected)


@dataclass(frozen=True)
class HoldOutData:
    """Runs and measured responses that no fit sees; `kept_aside`: names of those that were not given for it."""

    runs: tuple[Run, ...]
    responses: tuple[RunSpectrum, ...]
    kept_aside: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The names of runs and responses."""
        return (*(run.name for run in self.runs), *(response.run for response in self.responses))


def hold_out_data(
    runs: Sequence[Run], responses: Sequence[RunSpectrum], kept_aside: Sequence[Run], spectra: Spectra
) -> tuple[HoldOutData, Spectra]:
    """Return what is held out, and the spectra without it.

    `runs` and `responses` were given for it; where nothing was, the runs that are `kept_aside`, else a response.
    """
    if runs or responses or kept_aside:
        names = tuple(run.name for run in kept_aside)
        return HoldOutData((*runs, *kept_aside), tuple(responses), names), spectra
    chosen = choose_response(spectra)
    lines = tuple(run for run in spectra.lines if not any(run is other for other in chosen))
    return HoldOutData((), chosen, tuple(run.run for run in chosen)), replace(spectra, lines=lines)


def response_errors(response: RunSpectrum, before: IdentifiedModel, after: IdentifiedModel) -> HoldOut:
    """Return the errors of a measured response, as of a sweep, by the model before and after updating."""
    new = _line_errors((response,), after)
    return HoldOut(_line_errors((response,), before).error, new.error, new.noise)


def choose_response(spectra: Spectra) -> tuple[RunSpectrum, ...]:
    """Return the measured response to keep aside where nothing is given: one that another one repeats, as of sweeps."""
    groups: dict[tuple[tuple[str, ...], float], list[RunSpectrum]] = {}
    for run in spectra.lines:
        groups.setdefault((run.components, run.rotor_speed), []).append(run)
    repeated = {key: group for key, group in groups.items() if len(group) > 1}
    candidates = [[run for run in group if run.run in spectra.responses] for group in repeated.values()]
    largest = max(candidates, key=len, default=[])
    return (min(largest, key=lambda run: run.level),) if largest else ()


def choose_hold_out(runs: Sequence[Run]) -> tuple[Run, ...]:
    """Return the runs to keep aside where none is given: all check runs; without any, a sweep that another one repeats.

    Of sweeps that excite the same components at the same rotor speed the one of the least level is kept aside; of
    several such groups, of the largest one. Empty where every run is needed.
    """
    checks = tuple(run for run in runs if run.kind == "check" and run.has_loads)
    if checks:
        return checks
    groups: dict[tuple[tuple[str, ...], float], list[Run]] = {}
    for run in runs:
        if run.kind == "sweep":
            groups.setdefault((run.excited, run.rotor_speed or 0.0), []).append(run)
    largest = max(groups.values(), key=len, default=[])
    return (min(largest, key=lambda run: tuple(run.level)),) if len(largest) > 1 else ()


def require_known_loads(run: Run) -> None:
    """Raise UserError for a run without known loads, with which a model could be compared."""
    place = run.file
    if run.kind not in HOLD_OUT_KINDS:
        remedy = "Hold out check runs (errors of hub loads) or sweeps (errors of responses)"
        raise UserError(f"a {run.kind} run has no known loads to compare with", place, "--hold-out", remedy)
    if not run.has_loads:
        raise UserError("has no `loads` to compare with", place, "loads", "Hold out a run whose loads were measured")


def require_comparable(run: Run, model: IdentifiedModel) -> None:
    """Raise UserError for a run without known loads, and for a check run whose loads a model cannot determine."""
    require_known_loads(run)
    if run.kind == "check":
        _check_run_errors(run, model)


@dataclass(frozen=True)
class _ModelErrors:
    """Errors of a run by a model, their noise floor, what is expected, and `set_up`, None where it is the sweeps'."""

    error: RunErrors
    noise: RunErrors
    expected: RunErrors | None = None
    set_up: str | None = None


def _check_run_errors(run: Run, model: IdentifiedModel) -> _ModelErrors:
    """Errors of a check run at the harmonics from 1 on. They need no calibration."""
    source, geometry = model_source(model), model.geometry
    record = rotor_record(run, geometry, source)
    matrices, set_up = _choose_load_matrices(record, model)
    solution = harmonic_loads(record, geometry, source)
    loads = check_errors(record, solution, geometry, source, matrices)
    frf_error, frf_noise, frf_expected = _harmonic_errors(record, model, source, matrices)
    error = RunErrors(loads.load_error, loads.interaction, frf_error)
    noise = RunErrors(loads.load_noise, loads.interaction_noise, frf_noise)
    expected = RunErrors(_expected_load_errors(loads, solution, record.components), {}, frf_expected)
    return _ModelErrors(error, noise, expected, set_up)


def _expected_load_errors(loads: CheckErrors, solution: SolvedLoads, components: tuple[str, ...]) -> dict[str, float]:
    """Return the errors of the applied loads that noise and the error of the response make, relative to the loads."""
    compared = slice(0, HARMONICS_COMPARED)
    variance = np.diagonal(solution.covariance - solution.noise_covariance, axis1=1, axis2=2)[compared]
    square = np.mean(variance[:, : len(components)] + variance[:, len(components) :], axis=0)
    size = np.mean(np.abs(loads.applied[1:][compared]) ** 2, axis=0)
    of = {name: components.index(name) for name in loads.load_error}
    return {name: float(np.hypot(loads.load_noise[name], np.sqrt(square[i] / size[i]))) for name, i in of.items()}


def record_load_matrices(record: RotorRecord, model: IdentifiedModel) -> ComplexArray:
    """Return the matrices (n+1, 6, 6) from recorded to true loads at harmonics 0 to n of a check run.

    Mass and stiffness beyond the force cells belong to the exciters of the sweeps, with which a check run may have been
    made or not: the matrices are those that describe its channels better.
    """
    return _choose_load_matrices(record, model)[0]


def _choose_load_matrices(record: RotorRecord, model: IdentifiedModel) -> tuple[ComplexArray, str | None]:
    """The matrices, and OTHER_EXCITERS where they are those without the exciters of the sweeps."""
    attached = _load_matrices(record, model, attached=True)
    if not exciters_resist_motion(identified_system(model).equations):
        return attached, None
    source, without = model_source(model), _load_matrices(record, model, attached=False)
    error, error_without = (_harmonic_errors(record, model, source, each)[0] for each in (attached, without))
    return (without, OTHER_EXCITERS) if error_without < error else (attached, None)


def _load_matrices(record: RotorRecord, model: IdentifiedModel, attached: bool) -> ComplexArray:
    """The matrices with the exciters that apply a load `attached` to the hub, or with none of them."""
    system, spectra = identified_system(model), record.spectra
    applied = attached & np.any(spectra.amplitude[:, spectra.columns(COMPONENTS)] != 0, axis=0)
    solution = solve(system, spectra.frequency_hz, record.spin)
    lines = np.arange(len(spectra.frequency_hz))
    matrices = true_load_matrices(system, solution, lines, np.broadcast_to(applied, (len(lines), 6)))
    return np.broadcast_to(matrices, (len(lines), 6, 6)).astype(complex)


def _harmonic_errors(
    record: RotorRecord, model: IdentifiedModel, source: ResponseSource, matrices: ComplexArray
) -> tuple[float, float, float]:
    """Relative rms of the measured channels minus the response times the applied loads, its noise floor, and both that
    and the error of the response.

    The anti-alias filter is the same in channels and loads, and cancels.
    """
    spectra = record.spectra
    channel_combination = source.channel_combination(spectra.frequency_hz[1:], record.health.live)
    T = harmonic_response(record, model.geometry, source)[:, channel_combination.rows] @ matrices[1:]
    # Channels and residual as combinations (h, r, c + 6) of all recorded signals.
    measured = np.concatenate([channel_combination.combination, np.zeros_like(T)], axis=2)
    residual = np.concatenate([channel_combination.combination, -T], axis=2)
    columns = spectra.columns((*record.health.live, *COMPONENTS))
    recorded = spectra.amplitude[1:, columns]
    covariance = spectra.covariance[1:][:, columns][:, :, columns]
    size, error = (np.linalg.norm(np.einsum("hrc,hc->hr", part, recorded)) for part in (measured, residual))
    noise = np.sqrt(np.real(np.einsum("hrc,hcd,hrd->", residual, covariance, residual.conj())))
    loads = np.einsum("hij,hj->hi", matrices[1:], recorded[:, -len(COMPONENTS) :])
    of_response = source.covariance(spectra.frequency_hz[1:], record.spin, loads)
    rows = np.array([*channel_combination.rows]) + np.array([[0], [of_response.shape[1] // 2]])
    response_error = np.sqrt(np.diagonal(of_response, axis1=1, axis2=2)[:, rows].sum())
    return float(error / size), float(noise / size), float(np.hypot(noise, response_error) / size)


def _sweep_run_errors(run: Run, model: IdentifiedModel) -> _ModelErrors:
    """Relative error of the response of a sweep, as in the quality of a fit, and its noise floor.

    The contribution of nonlinear forces is removed from the record first. In a record that does not repeat it would
    be taken for noise. Where a nonlinear force would be most of what its own cell reads, nothing is described.
    """
    system = identified_system(model)
    try:
        run = remove_nonlinear_contribution(run, system, model.geometry, live_channels(run, model.geometry).live)
    except np.linalg.LinAlgError:
        return _ModelErrors(RunErrors({}, {}, 1.0), RunErrors({}, {}, 0.0))
    return _line_errors(measured_spectra([run], model.geometry, means=False).lines, model)


def _line_errors(lines: Sequence[RunSpectrum], model: IdentifiedModel) -> _ModelErrors:
    """Relative error of the response of one run in the band of the model, and its noise floor."""
    spectra = Spectra(tuple(lines), (), {}, {}).in_band(model.band)
    batches = stack_runs(spectra.lines, (), model.geometry.channel_names)
    quality = fit_quality(batches, identified_system(model), 0.0, frf_band(batches, model.geometry)).runs[lines[0].run]
    return _ModelErrors(RunErrors({}, {}, quality.frf_error), RunErrors({}, {}, quality.frf_noise_floor))
