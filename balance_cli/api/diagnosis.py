"""What a model lacks: diagnosis and model updating."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial

from balance_cli.api.arguments import check_arguments
from balance_cli.api.fitted import FittedLike, to_fitted
from balance_cli.api.inputs import require_band, require_disjoint
from balance_cli.diagnosis.conclusions import judge_hold_out
from balance_cli.diagnosis.consistency.severity import identified_anyway
from balance_cli.diagnosis.result import Diagnosis
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS, SearchSettings
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.measured_responses import (
    add_responses,
    require_independent_lines,
    require_usable_responses,
)
from balance_cli.estimation.measured_spectra import Spectra, measured_spectra
from balance_cli.steps.cross_checks import cross_check, cross_check_responses, keep_findings
from balance_cli.steps.diagnose import diagnose as run_diagnosis
from balance_cli.steps.free_simulation import SimulationTask, diagnose_with_free_simulation
from balance_cli.steps.hold_out import (
    choose_hold_out,
    hold_out_data,
    hold_out_errors,
    require_comparable,
    response_errors,
)
from balance_cli.steps.hold_out_model_error import add_hold_out_error, note_contradicted_loads


@check_arguments
def diagnose(
    model: IdentifiedModel,
    runs: FittedLike | Iterable[FittedLike],
    *,
    hold_out: FittedLike | Iterable[FittedLike] = (),
    band: tuple[float, float] | None = None,
    settings: SearchSettings = DEFAULT_SETTINGS,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Diagnosis, IdentifiedModel]:
    """Find the effects that a model lacks, as `balance diagnose` does; returns the diagnosis and the updated model.

    Give the sweeps and static runs of the model, or measured responses in place of the sweeps. Check runs, sweeps and
    responses of `hold_out` are read after the last decision and compared before and after the update; without any,
    check runs, one of the sweeps or one of the responses are kept aside for it and named in `notes`. Lines within
    `band` [Hz] are used, by default those within the band of the identification. `settings` holds the thresholds of the
    search; `progress` is called with a description and the completed fraction. Raises UserError for a model in the
    paper's form, where no run is a sweep, and where the runs contradict the geometry or each other (`consistency` keeps
    what is no fault).

    On the sample campaign this takes about half a minute:

    >>> import balance_cli as bal
    >>> from glob import glob
    >>> runs = glob("sample_data/static-*.h5") + glob("sample_data/sweep-*.h5")
    >>> checks = glob("sample_data/check-*.h5")
    >>> model = bal.identify(runs, "configs/rts-6.yaml")  # doctest: +SKIP
    >>> diagnosis, updated = bal.diagnose(model, runs, hold_out=checks)  # doctest: +SKIP
    >>> diagnosis.verdict  # doctest: +SKIP
    'explained'
    """
    require_band(band)
    model = model if band is None else replace(model, band=band)
    fitted, responses = to_fitted(runs, model.geometry)
    require_independent_lines(responses)
    checks, held = to_fitted(hold_out, model.geometry)
    require_disjoint(fitted, checks)
    require_usable_responses((*responses, *held), (*fitted, *checks), model.geometry)
    findings = cross_check(model.geometry, fitted, identified_anyway)
    findings = (*findings, *cross_check_responses(model.geometry, responses, identified_anyway))
    for run in checks:
        require_comparable(run, model)
    kept_aside = () if checks or held else choose_hold_out(fitted)
    fitted = tuple(run for run in fitted if run not in kept_aside)
    spectra = add_responses(measured_spectra(fitted, model.geometry, means=True), responses)
    held_lines = add_responses(Spectra((), (), {}, {}), held).lines
    data, spectra = hold_out_data(checks, held_lines, kept_aside, spectra)
    task = SimulationTask(model, spectra, fitted, data.runs)
    diagnosis, updated = diagnose_with_free_simulation(task, partial(run_diagnosis, progress=progress), settings)
    errors = {response.run: response_errors(response, model, updated) for response in data.responses}
    errors |= {run.name: hold_out_errors(run, model, updated) for run in data.runs}
    updated = add_hold_out_error(updated, data.runs, errors, settings)
    diagnosis = note_contradicted_loads(judge_hold_out(diagnosis, errors, data.kept_aside), updated)
    return keep_findings(diagnosis, findings), keep_findings(updated, findings)
