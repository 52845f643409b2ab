"""`balance calibrate`: static matrices C0 and T0 from the static runs, one set for each trim."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.earlier_calibrations import compare_with_earlier
from balance_cli.cli.options import (
    InputFile,
    OutputFile,
    deprecated_option,
    hold_out_option,
    output_option,
    skip_bad_option,
)
from balance_cli.cli.static_runs import (
    moment_center_option,
    open_static_runs,
    optional_geometry_option,
    rig_of_inputs,
    table_reading,
    units_option,
)
from balance_cli.cli.term_options import significance_option, term_choice, terms_option
from balance_cli.io.errors import UserError
from balance_cli.io.formats import CALIBRATION_FORMAT

if TYPE_CHECKING:
    from balance_cli.calibration.result import Calibration
    from balance_cli.campaign.recording.run import Run
    from balance_cli.campaign.rig.geometry import Geometry


WITHOUT_MODEL = (
    "no calibration model of all trims: within the load series, or by the channels that all trims have, the loads are "
    "not told apart; C0 and T0 are linear, and --terms has no effect"
)
"""Warning where a calibration has the matrices of its trims alone."""


@balance_command("calibrate")
@optional_geometry_option
@click.argument("runs", type=InputFile(), nargs=-1, metavar="[RUN...]")
@terms_option
@significance_option
@click.option(
    "--non-iterative",
    "direct",
    is_flag=True,
    help="Also fit the loads as functions of the readings; reduce then computes mean loads without iteration.",
)
@deprecated_option("--direct", "--non-iterative", "direct", is_flag=True)
@hold_out_option("Static run that is held out of the fit to check the prediction intervals (repeatable).")
@click.option(
    "--matrix",
    type=OutputFile(),
    metavar="FILE",
    help="Also write the matrix of the model: .csv for spreadsheets and --from-matrix, .txt for reading.",
)
@click.option(
    "--linear-matrix",
    "linear_matrix",
    type=OutputFile(),
    metavar="FILE",
    help="Also write the linear matrix T0, loads from readings: .csv, or .cal in the XML of ATI sensors.",
)
@click.option(
    "--from-matrix",
    "from_matrix",
    type=InputFile(),
    metavar="FILE",
    help="Take the calibration from this matrix instead of from runs: .csv as written here, or .cal of ATI sensors.",
)
@click.option(
    "--against",
    "against",
    type=InputFile(),
    multiple=True,
    metavar="OLD_CAL",
    help="Report what changed since this calibration, by coefficient, with significance. Repeatable, the "
    "oldest first: the output then includes a control chart over all of them, with a test for drift.",
)
@units_option
@moment_center_option
@skip_bad_option
@output_option("CAL")
def command(session: Session, geometry: Path | None, runs: tuple[Path, ...], output: Path, **options: Any) -> None:
    """Fit the static calibration: matrices by trim, and one model.

    The matrices C0 and T0 are linear, and belong to one trim each; the calibration model holds for all trims. The model
    has the terms of AIAA R-091: for each channel those that are significant and that reduce the cross-validation error
    of the load series. Outliers and suspect load series are listed and excluded.

    RUN is a run file, or a point table as CSV with units in its head: a column for each load and each channel, and
    optionally `series`, `point`, `run` and `trim`. Calibration alone needs no masses, stiffness or damping in the
    geometry, and none at all for a point table of the hub loads Fx to Mz that states the units of its readings.

    With --from-matrix the model is read from a matrix made elsewhere, and no run is needed.
    """
    from balance_cli.cli.calibration_summary import calibration_summary
    from balance_cli.cli.calibration_text import calibration_text
    from balance_cli.cli.consistency import report_findings, require_consistent_runs, with_findings
    from balance_cli.cli.matrix_files import linear_matrix_text, matrix_file_text, read_matrix_calibration
    from balance_cli.cli.scale_text import scale_evidence_of, scale_text
    from balance_cli.diagnosis.consistency.severity import measured_anyway
    from balance_cli.diagnosis.consistency.static_units import matrix_unit_findings
    from balance_cli.steps.residual_findings import residual_findings
    from balance_cli.steps.trim_agreement import trim_findings

    choices = _Choices(**options)
    _check_options(runs, choices)
    reading = table_reading(choices.units, choices.moment_center)
    rig = rig_of_inputs(session, geometry, (*runs, *choices.hold_out), reading, choices.from_matrix)
    held_out = functools.partial(
        open_static_runs, session, choices.hold_out, rig, reading, choices.skip_bad, "hold-out"
    )
    if choices.from_matrix is None:
        calibration_runs = open_static_runs(session, runs, rig, reading, choices.skip_bad)
        calibration_runs = require_consistent_runs(session, rig, calibration_runs, choices.skip_bad, measured_anyway)
        result = _calibrate_from_runs(session, rig, calibration_runs, held_out(calibration_runs), choices)
    else:
        checks = _select_static_hold_out(session, held_out())
        result = read_matrix_calibration(session, rig, choices.from_matrix, checks)
    residual = residual_findings(result)
    report_findings(session, residual)
    _warn(session, result)
    report_findings(session, (*trim_findings(result), *matrix_unit_findings(result)))
    session.save(output, CALIBRATION_FORMAT, with_findings(session, result))
    if choices.matrix is not None:
        session.write_text(choices.matrix, matrix_file_text(result, choices.matrix))
    if choices.linear_matrix is not None:
        session.write_text(choices.linear_matrix, linear_matrix_text(result, choices.linear_matrix))
    compared = bool(choices.against)
    summary = {**calibration_summary(result), "scale_evidence": scale_evidence_of(result, compared)}
    text = [*(finding.sentence for finding in residual), *calibration_text(result), *scale_text(result, compared)]
    if choices.against:
        summary |= compare_with_earlier(session, result, choices.against, output.name, text)
    session.finish(summary, text)


@dataclass(frozen=True)
class _Choices:
    """The options of a call beside its inputs and output; `direct`: the non-iterative model is fitted too."""

    terms: str
    significance: float | None
    direct: bool
    hold_out: tuple[Path, ...]
    matrix: Path | None
    linear_matrix: Path | None
    from_matrix: Path | None
    units: str | None
    moment_center: tuple[float, float, float] | None
    skip_bad: bool
    against: tuple[Path, ...]


def _warn(session: Session, result: Calibration) -> None:
    from balance_cli.cli.calibration_text import math_model_warnings

    for trim in result.trims.values():
        for name, reason in trim.excluded_channels.items():
            session.warn(f"trim {trim.trim}: channel {name} left out: {reason}")
    _warn_of_units(session, result)
    for warning in math_model_warnings(result.all_trims) if result.all_trims else (WITHOUT_MODEL,):
        session.warn(warning)


def _warn_of_units(session: Session, result: Calibration) -> None:
    """Warn of loads that seem to be in another unit, once for all trims."""
    from balance_cli.calibration.load_units import doubtful_units
    from balance_cli.campaign.rig.load_components import load_components

    first = next(iter(result.trims.values()))
    if first.rows:
        for note in doubtful_units(first, load_components(result.geometry).units):
            session.warn(note)


def _check_options(runs: tuple[Path, ...], choices: _Choices) -> None:
    """Raise UserError for a call with both sources or none, with options of the other one, or an unknown suffix."""
    from_matrix, matrix, linear_matrix = choices.from_matrix, choices.matrix, choices.linear_matrix
    if from_matrix is None and not runs:
        raise UserError("no run is given", "RUN...", remedy="Give the static runs, or a matrix with --from-matrix")
    if from_matrix is not None and runs:
        fault = "the calibration comes from runs or from a matrix, not from both"
        raise UserError(fault, "RUN..., --from-matrix", remedy="Give one of them; --hold-out RUN checks a matrix")
    if from_matrix is not None and (choices.terms != "search" or choices.significance is not None):
        option = "--terms" if choices.significance is None else "--significance"
        raise UserError("a matrix has its own terms", f"{option}, --from-matrix", remedy=f"Leave {option} out")
    if from_matrix is not None and choices.direct:
        fault = "a matrix has no rows to fit"
        raise UserError(fault, "--non-iterative, --from-matrix", remedy="Leave --non-iterative out")
    if matrix is not None and matrix.suffix not in (".csv", ".txt"):
        raise UserError("a matrix is written as .csv or .txt", str(matrix), remedy="Give it one of these suffixes")
    if linear_matrix is not None and linear_matrix.suffix not in (".csv", ".cal"):
        fault = "a linear matrix is written as .csv or .cal"
        raise UserError(fault, str(linear_matrix), remedy="Give it one of these suffixes")


def _calibrate_from_runs(
    session: Session, rig: Geometry, runs: Sequence[Run], hold_out: Sequence[Run], choices: _Choices
) -> Calibration:
    from balance_cli.steps.calibrate import calibrate

    for run in runs:
        if run.kind != "static":
            session.report_left_out(run.name, f"a {run.kind} run; only static runs are used")
    checks = _select_static_hold_out(session, hold_out)
    choice = term_choice(session, choices.terms, choices.significance, rig)
    with session.working("calibration"):
        return calibrate(runs, rig, choice, checks, choices.direct)


def _select_static_hold_out(session: Session, hold_out_runs: Sequence[Run]) -> list[Run]:
    """Select the hold-out runs that can check a calibration, and report the others."""
    for run in hold_out_runs:
        if run.kind != "static" or not run.has_loads:
            session.report_left_out(run.name, f"a {run.kind} run without static loads to compare with")
    return [run for run in hold_out_runs if run.kind == "static" and run.has_loads]
