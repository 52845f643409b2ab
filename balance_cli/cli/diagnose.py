"""`balance diagnose`: find the effects that a model lacks, and update the model."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.options import (
    InputFile,
    NumberRange,
    OutputFile,
    band_option,
    hold_out_option,
    output_option,
    runs_argument,
    skip_bad_option,
)
from balance_cli.io.errors import UserError
from balance_cli.io.formats import DIAGNOSIS_FORMAT, MODEL_FORMAT

if TYPE_CHECKING:
    from balance_cli.campaign.recording.run import Run
    from balance_cli.cli.fitted_files import FittedFiles
    from balance_cli.diagnosis.result import Diagnosis, HoldOut
    from balance_cli.diagnosis.settings import SearchSettings
    from balance_cli.estimation.identified_model import IdentifiedModel
    from balance_cli.estimation.measured_spectra import Spectra
    from balance_cli.steps.hold_out import HoldOutData

EXIT_DISCREPANCY = 3
"""Exit status of --fail-on-discrepancy where the model lacks something."""


@balance_command("diagnose")
@click.argument("model", type=InputFile(), metavar="MODEL")
@runs_argument
@hold_out_option("Check run, sweep or file of responses that no fit may see, for errors before and after (repeatable).")
@click.option(
    "--model-out", type=OutputFile(), required=True, metavar="MODEL", help="Where the updated model is written."
)
@click.option(
    "--time-limit",
    type=NumberRange(min=0.0),
    default=300.0,
    show_default=True,
    metavar="SECONDS",
    help="Computing time after which no further effect is tried and fits end early; a note says that it was reached.",
)
@click.option(
    "--suspect",
    "suspected",
    multiple=True,
    metavar="NAME[@PLACE]",
    help="Effect to try first and to test in any case, as a single hypothesis (repeatable).",
)
@click.option(
    "--exclude",
    "excluded",
    multiple=True,
    metavar="NAME[@PLACE]",
    help="Effect to leave out of the search, at this place or everywhere (repeatable).",
)
@band_option("Use lines within this band only [Hz]; by default those of the band in which MODEL was identified.")
@click.option("--fail-on-discrepancy", is_flag=True, help="Exit status 3 unless the verdict is `nothing missing`.")
@skip_bad_option
@output_option("DIAGNOSIS")
def command(
    session: Session,
    model: Path,
    runs: tuple[Path, ...],
    hold_out: tuple[Path, ...],
    model_out: Path,
    time_limit: float,
    suspected: tuple[str, ...],
    excluded: tuple[str, ...],
    band: tuple[float, float] | None,
    fail_on_discrepancy: bool,
    skip_bad: bool,
    output: Path,
) -> None:
    """Find the effects that a model lacks, and update the model.

    The errors before and after are reported. Sweeps and static runs among RUN... are fitted, and measured responses
    (files of `sweep-tf` or `import-frf`); runs of other kinds are left out and named. The runs and responses of
    --hold-out are used once, after the last decision; without any, the check runs among RUN..., or a sweep or response
    that another one repeats, are kept aside for it. MODEL is a physical model: computed, identified, or updated before.
    The updated model is physical, too.
    """
    from balance_cli.cli.consistency import with_findings
    from balance_cli.cli.diagnosis_text import diagnosis_summary, diagnosis_text
    from balance_cli.cli.fitted_files import fitted_spectra, read_hold_out_files
    from balance_cli.diagnosis.result import NOTHING_MISSING
    from balance_cli.steps.hold_out import choose_hold_out, hold_out_data

    before = _load_start_model(session, model, band)
    settings = _search_settings(before, time_limit, suspected, excluded)
    files = _read_data(session, runs, before, skip_bad)
    held = read_hold_out_files(session, hold_out, before.geometry, skip_bad, files)
    held_runs = _select_usable_hold_out(session, held.runs, before, skip_bad)
    kept_aside = () if hold_out else choose_hold_out(files.runs)
    files = replace(files, runs=tuple(run for run in files.runs if run not in kept_aside))
    spectra = fitted_spectra(session, files, before.geometry, means=True)
    _check_spectra(session, spectra)
    data, spectra = hold_out_data(held_runs, held.lines, kept_aside, spectra)
    _warn_about_hold_out(session, before, data, spectra)
    diagnosis, updated_model = _run_diagnosis(before, spectra, files.runs, data.runs, settings)
    errors = _hold_out_errors(session, data, before, updated_model, skip_bad)
    diagnosis, updated_model = _judge_by_hold_out(diagnosis, updated_model, data, errors)
    session.save(output, DIAGNOSIS_FORMAT, with_findings(session, diagnosis))
    session.save(model_out, MODEL_FORMAT, with_findings(session, updated_model))
    if fail_on_discrepancy and diagnosis.verdict != NOTHING_MISSING:
        session.status = EXIT_DISCREPANCY
    session.finish(diagnosis_summary(diagnosis, updated_model), diagnosis_text(diagnosis))


def _load_start_model(session: Session, path: Path, band: tuple[float, float] | None) -> IdentifiedModel:
    """Return the model to start from, for lines within a `band`, None for its own.

    Raises UserError for the paper's form, which cannot have effects.
    """
    from balance_cli.estimation.identified_model import IdentifiedModel

    model: IdentifiedModel = session.artefact(path, {MODEL_FORMAT: IdentifiedModel}, "model").content
    if model.form == "paper":
        remedy = "Give a model of `balance identify --form physical` (the default)"
        raise UserError("is in the paper's form, which has no place for an effect", str(path), "form", remedy)
    return model if band is None else replace(model, band=band)


def _search_settings(
    model: IdentifiedModel, time_limit: float, suspected: tuple[str, ...], excluded: tuple[str, ...]
) -> SearchSettings:
    """Return the settings for what is suspected or excluded. Raises UserError for an unknown effect or place."""
    from balance_cli.diagnosis.search.candidates import check_exclusion, suspected_candidates
    from balance_cli.diagnosis.settings import DEFAULT_SETTINGS

    for option, words in (("--suspect", suspected), ("--exclude", excluded)):
        for word in words:
            try:
                if option == "--suspect":
                    suspected_candidates(word, model.geometry)
                else:
                    check_exclusion(word, model.geometry)
            except UserError as error:
                raise UserError(error.fault, place=option, remedy=error.remedy) from error
    return replace(DEFAULT_SETTINGS, time_limit=time_limit, suspected=suspected, excluded=excluded)


def _read_data(session: Session, paths: tuple[Path, ...], model: IdentifiedModel, skip_bad: bool) -> FittedFiles:
    """Return the runs and responses to be fitted. Raises UserError for responses whose errors are smooth."""
    from balance_cli.cli.fitted_files import read_fitted_files
    from balance_cli.estimation.measured_responses import require_independent_lines

    files = read_fitted_files(session, paths, model.geometry, skip_bad)
    require_independent_lines(files.responses)
    return files


def _select_usable_hold_out(
    session: Session, hold_out_runs: tuple[Run, ...], before: IdentifiedModel, skip_bad: bool
) -> tuple[Run, ...]:
    """Return the hold-out runs that can be compared with a model. It is checked before the fits, which take long."""
    from balance_cli.steps.hold_out import require_comparable

    usable_runs = []
    for run in hold_out_runs:
        with session.skip_if_unusable(run, skip_bad):
            require_comparable(run, before)
            usable_runs.append(run)
    return tuple(usable_runs)


def _check_spectra(session: Session, spectra: Spectra) -> None:
    for run, channels in spectra.channels_left_out.items():
        for name, reason in channels.items():
            session.warn(f"run {run}: channel {name} left out: {reason}")
    if not spectra.lines:
        remedy = "Give at least one sweep run, or measured responses"
        raise UserError("no sweep run among the runs", "RUN...", remedy=remedy)


def _warn_about_hold_out(session: Session, before: IdentifiedModel, data: HoldOutData, spectra: Spectra) -> None:
    """Warn where there are no hold-out runs, and where they are no test."""
    if not data.names:
        remedy = "keep check runs for --hold-out"
        if spectra.responses:
            remedy = "no response repeats another one; give --hold-out a file of responses, or check runs"
        session.warn(f"no hold-out run: the updated model is not tested on new data; {remedy}")
    if data.kept_aside:
        session.warn(f"no --hold-out: {', '.join(data.kept_aside)} kept aside to test the updated model")
    for name in data.names:
        if before.method != "computed" and name in before.quality.runs:
            session.warn(f"{name} is held out here, but the model was fitted to it: its error before is no test")


def _run_diagnosis(
    before: IdentifiedModel,
    spectra: Spectra,
    records: tuple[Run, ...],
    hold_out_runs: tuple[Run, ...],
    settings: SearchSettings,
) -> tuple[Diagnosis, IdentifiedModel]:
    from balance_cli.cli.progress import progress_bar
    from balance_cli.steps.diagnose import diagnose
    from balance_cli.steps.free_simulation import SimulationTask, diagnose_with_free_simulation

    task = SimulationTask(before, spectra, records, hold_out_runs)
    with progress_bar() as progress:
        return diagnose_with_free_simulation(task, partial(diagnose, progress=progress), settings)


def _hold_out_errors(
    session: Session, data: HoldOutData, before: IdentifiedModel, after: IdentifiedModel, skip_bad: bool
) -> dict[str, HoldOut]:
    from balance_cli.steps.hold_out import hold_out_errors, response_errors

    errors = {response.run: response_errors(response, before, after) for response in data.responses}
    for run in session.progress(data.runs, "hold-out runs", len(data.runs), False):
        with session.skip_if_unusable(run, skip_bad):
            errors[run.name] = hold_out_errors(run, before, after)
    return errors


def _judge_by_hold_out(
    diagnosis: Diagnosis,
    updated: IdentifiedModel,
    data: HoldOutData,
    errors: dict[str, HoldOut],
) -> tuple[Diagnosis, IdentifiedModel]:
    from balance_cli.diagnosis.conclusions import judge_hold_out
    from balance_cli.steps.hold_out_model_error import add_hold_out_error, note_contradicted_loads

    judged = judge_hold_out(diagnosis, errors, data.kept_aside)
    tested = add_hold_out_error(updated, data.runs, errors)
    return note_contradicted_loads(judged, tested), tested
