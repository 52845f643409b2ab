"""What a model lacks: diagnosis and model updating."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial

from balance_cli.api.arguments import check_arguments
from balance_cli.api.inputs import RunLike, require_band, require_disjoint, to_runs
from balance_cli.diagnosis.conclusions import judge_hold_out
from balance_cli.diagnosis.consistency.severity import identified_anyway
from balance_cli.diagnosis.result import Diagnosis
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS, SearchSettings
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.steps.cross_checks import cross_check, keep_findings
from balance_cli.steps.diagnose import diagnose as run_diagnosis
from balance_cli.steps.free_simulation import SimulationTask, diagnose_with_free_simulation
from balance_cli.steps.hold_out import choose_hold_out, hold_out_errors, require_comparable
from balance_cli.steps.hold_out_model_error import add_hold_out_error, note_contradicted_loads


@check_arguments
def diagnose(
    model: IdentifiedModel,
    runs: RunLike | Iterable[RunLike],
    *,
    hold_out: RunLike | Iterable[RunLike] = (),
    band: tuple[float, float] | None = None,
    settings: SearchSettings = DEFAULT_SETTINGS,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Diagnosis, IdentifiedModel]:
    """Find the effects that a model lacks, as `balance diagnose` does; returns the diagnosis and the updated model.

    Give the sweeps and static runs of the model. Check runs and sweeps of `hold_out` are read after the last decision
    and compared before and after the update; without any, check runs or one of the sweeps are kept aside for it and
    named in `notes`. Lines within `band` [Hz] are used, by default those within the band of the identification.
    `settings` holds the thresholds of the search; `progress` is called with a
    description and the completed fraction. Raises UserError for a model in the paper's form, where no run is a
    sweep, and where the runs contradict the geometry or each other (`consistency` keeps what is no fault).

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
    fitted, checks = to_runs(runs, model.geometry), to_runs(hold_out, model.geometry)
    require_disjoint(fitted, checks)
    findings = cross_check(model.geometry, fitted, identified_anyway)
    for run in checks:
        require_comparable(run, model)
    kept_aside = () if checks else choose_hold_out(fitted)
    fitted = tuple(run for run in fitted if run not in kept_aside)
    spectra = measured_spectra(fitted, model.geometry, means=True)
    task = SimulationTask(model, spectra, fitted, (*checks, *kept_aside))
    diagnosis, updated = diagnose_with_free_simulation(task, partial(run_diagnosis, progress=progress), settings)
    errors = {run.name: hold_out_errors(run, model, updated) for run in task.hold_out}
    updated = add_hold_out_error(updated, task.hold_out, errors, settings)
    diagnosis = judge_hold_out(diagnosis, errors, [run.name for run in kept_aside])
    diagnosis = note_contradicted_loads(diagnosis, updated)
    return keep_findings(diagnosis, findings), keep_findings(updated, findings)
