"""What an updated model misses of check runs that it does not describe: its error in wind-on runs too."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.diagnosis.conclusions import is_described
from balance_cli.diagnosis.result import Diagnosis, HoldOut
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS, SearchSettings
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.response_error import ResponseError
from balance_cli.io.percent import named_percents
from balance_cli.reduction.check_contradiction import SIGNIFICANT
from balance_cli.reduction.harmonic_loads import harmonic_response
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.rotor_record import rotor_record
from balance_cli.reduction.trust import MODEL_ERROR_SHARE
from balance_cli.steps.hold_out import record_load_matrices


def add_hold_out_error(
    model: IdentifiedModel,
    runs: Sequence[Run],
    errors: Mapping[str, HoldOut],
    settings: SearchSettings = DEFAULT_SETTINGS,
) -> IdentifiedModel:
    """Return the model with the error of its response in the check runs that it does not describe.

    What acts with a turning rotor alone (a gyroscopic moment) is in no sweep at rest, but in check runs as in wind-on
    runs. The error widens the standard deviations of the loads that `reduce` gives; that of a load which no such run
    applied stays unknown. Components that the model misses beyond its sigma are named in it, and `reduce` flags them:
    check runs show the error of few frequencies. Without such runs the model stays.
    """
    checks = [run for run in runs if run.kind == "check" and run.name in errors]
    contradicted = contradicted_loads(errors[run.name] for run in checks)
    undescribed = [run for run in checks if not is_described(errors[run.name], settings)]
    if not undescribed and not contradicted:
        return model
    error = model.response_error
    for run in undescribed:
        error = _response_error(run, model).combine(error)
    return replace(model, response_error=error, contradicted=contradicted or None)


def note_contradicted_loads(diagnosis: Diagnosis, model: IdentifiedModel) -> Diagnosis:
    """Return the diagnosis with a note on the components that check runs contradict in the updated model."""
    if not model.contradicted:
        return diagnosis
    errors = named_percents(model.contradicted)
    note = f"check runs contradict loads by the updated model, {errors}: `reduce` flags these loads in all runs"
    return replace(diagnosis, notes=(*diagnosis.notes, note))


def contradicted_loads(errors: Iterable[HoldOut]) -> dict[str, float]:
    """Return the largest relative error of each component that check runs contradict, by the rule of `reduce`.

    It compares the error with what noise and the error of the response, before this is widened, make expect.
    """
    wrong: dict[str, float] = {}
    for item in errors:
        expected = {} if item.expected is None else item.expected.load_error
        for name, error in item.after.load_error.items():
            if error > max(MODEL_ERROR_SHARE, SIGNIFICANT * expected.get(name, np.inf)):
                wrong[name] = max(error, wrong.get(name, 0.0))
    return wrong


def _response_error(run: Run, model: IdentifiedModel) -> ResponseError:
    """Return the error of the response at the rotor harmonics of a check run: its residual over the loads.

    Where several loads act at once, the residual is divided among them in proportion to what each contributes.
    """
    source, geometry = model_source(model), model.geometry
    record = rotor_record(run, geometry, source)
    spectra, live = record.spectra, record.health.live
    rows = [geometry.channel_names.index(name) for name in live]
    T = harmonic_response(record, geometry, source)[:, rows] @ record_load_matrices(record, model)[1:]
    amplitude = spectra.amplitude[1:, spectra.columns((*live, *COMPONENTS))]
    channels, loads = amplitude[:, : len(live)], amplitude[:, len(live) :]
    residual = channels - np.einsum("hcj,hj->hc", T, loads)
    contribution = np.linalg.norm(T, axis=1) * np.abs(loads)
    tiny = np.finfo(float).tiny
    share = contribution / np.maximum(np.linalg.norm(contribution, axis=1, keepdims=True), tiny)
    factor = np.zeros((len(T), len(COMPONENTS), len(geometry.channel_names), 1), complex)
    factor[:, :, rows, 0] = residual[:, None, :] * (share / np.maximum(np.abs(loads), tiny))[:, :, None]
    return ResponseError(geometry.channel_names, spectra.frequency_hz[1:], factor)
