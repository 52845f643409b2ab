"""`balance calibrate`: static matrices C0 and T0 from the static runs, one set for each trim."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from balance_cli.cli.common import (
    Session,
    balance_command,
    geometry_option,
    output_option,
    skip_bad_option,
)
from balance_cli.cli.options import InputFile, OutputFile, hold_out_option
from balance_cli.io.errors import UserError

if TYPE_CHECKING:
    from balance_cli.calibration.result import Calibration, TrimCalibration
    from balance_cli.campaign.recording.run import Run
    from balance_cli.campaign.rig.geometry import Geometry

FORMAT = "balance-calibration/1"


@balance_command("calibrate")
@geometry_option
@click.argument("runs", type=InputFile(), nargs=-1, metavar="RUN...")
@click.option(
    "--terms",
    type=click.Choice(["search", "linear"]),
    default="search",
    show_default=True,
    help="Terms of the model through all trims: those that are found in each channel, or the loads alone.",
)
@click.option(
    "--direct",
    is_flag=True,
    help="Fit the loads as functions of the readings, too; reduce then takes mean loads from these, without iteration.",
)
@hold_out_option("Static run that takes no part and checks the prediction intervals (repeatable).")
@click.option(
    "--matrix",
    type=OutputFile(),
    metavar="FILE",
    help="Write the matrix of the model, too: .csv for spreadsheets and --from-matrix, .txt for reading.",
)
@click.option(
    "--from-matrix",
    "from_matrix",
    type=InputFile(),
    metavar="FILE",
    help="Take the calibration from this matrix (.csv) instead of from runs.",
)
@skip_bad_option
@output_option("CAL")
def command(
    session: Session,
    geometry: Path,
    runs: tuple[Path, ...],
    terms: str,
    direct: bool,
    hold_out: tuple[Path, ...],
    matrix: Path | None,
    from_matrix: Path | None,
    skip_bad: bool,
    output: Path,
) -> None:
    """Static matrices C0 and T0, one set per trim, and one model of all channels through all trims.

    The model has the terms that balances are calibrated with (AIAA R-091): a channel has those that are significant and
    that help to predict loading sequences that took no part. What is plainly wrong is named and takes no part.

    With --from-matrix the model is that of a matrix that somebody else made, and no run is needed.
    """
    from balance_cli.cli.calibration_text import math_model_warnings

    _check_options(runs, terms, direct, matrix, from_matrix)
    rig = session.geometry(geometry)
    if from_matrix is None:
        result = _calibrate_from_runs(session, rig, runs, hold_out, (terms, direct), skip_bad)
    else:
        result = _read_matrix_calibration(session, rig, from_matrix, hold_out, skip_bad)
    for trim in result.trims.values():
        for name, reason in trim.left_out.items():
            session.warn(f"trim {trim.trim}: channel {name} left out: {reason}")
    for words in math_model_warnings(result.gage) if result.gage else ():
        session.warn(words)
    session.save(output, FORMAT, result)
    if matrix is not None:
        session.write_text(matrix, _matrix_file_text(result, matrix))
    session.finish(_summary(result), _text(result))


def _check_options(
    runs: tuple[Path, ...], terms: str, direct: bool, matrix: Path | None, from_matrix: Path | None
) -> None:
    """UserError for a call that asks for both sources or for none, or for a matrix of no known kind."""
    if from_matrix is None and not runs:
        raise UserError("no run is given", "RUN...", remedy="Give the static runs, or a matrix with --from-matrix")
    if from_matrix is not None and runs:
        fault = "the calibration comes from runs or from a matrix, not from both"
        raise UserError(fault, "RUN..., --from-matrix", remedy="Give one of them; --hold-out RUN checks a matrix")
    if from_matrix is not None and terms != "search":
        raise UserError("a matrix has its own terms", "--terms, --from-matrix", remedy="Leave --terms out")
    if from_matrix is not None and direct:
        raise UserError("a matrix has no rows to fit", "--direct, --from-matrix", remedy="Leave --direct out")
    if matrix is not None and matrix.suffix not in (".csv", ".txt"):
        raise UserError("a matrix is written as .csv or .txt", str(matrix), remedy="Let its name end so")


def _calibrate_from_runs(
    session: Session,
    rig: Geometry,
    runs: tuple[Path, ...],
    hold_out: tuple[Path, ...],
    model: tuple[str, bool],
    skip_bad: bool,
) -> Calibration:
    """The calibration of runs; `model`: how terms are chosen, and whether the direct model is wanted."""
    from balance_cli.steps.calibrate import calibrate

    calibration_runs = session.runs(runs, rig, skip_bad)
    hold_out_runs = session.runs(hold_out, rig, skip_bad, role="hold-out", disjoint_from=calibration_runs)
    for run in calibration_runs:
        if run.kind != "static":
            session.left_out(run.name, f"a {run.kind} run; only static runs are used")
    terms, direct = model
    return calibrate(calibration_runs, rig, terms == "search", _select_static_hold_out(session, hold_out_runs), direct)


def _read_matrix_calibration(
    session: Session, rig: Geometry, path: Path, hold_out: tuple[Path, ...], skip_bad: bool
) -> Calibration:
    from balance_cli.steps.calibration_from_matrix import calibration_from_matrix

    stated = session.matrix(path)
    hold_out_runs = session.runs(hold_out, rig, skip_bad, role="hold-out")
    try:
        result = calibration_from_matrix(stated, rig, _select_static_hold_out(session, hold_out_runs))
    except UserError as error:
        raise error.at(file=str(path)) from error
    session.warn("the matrix states no errors of its own: sigma of mean loads will not hold them")
    return result


def _matrix_file_text(result: Calibration, path: Path) -> str:
    """The text of the matrix, of the kind that the suffix asks for. UserError where there is no model."""
    from balance_cli.calibration.matrix import matrix_from_model
    from balance_cli.calibration.matrix_text import matrix_csv, matrix_text

    if result.gage is None:
        fault = "there is no matrix: the trims have too few channels in common, or other loads were applied"
        raise UserError(fault, str(path), remedy="Mend the channels, apply the carried loads, or leave --matrix out")
    stated = matrix_from_model(result.gage.model, result.geometry.rig)
    return matrix_csv(stated) if path.suffix == ".csv" else matrix_text(stated)


def _select_static_hold_out(session: Session, hold_out_runs: tuple[Run, ...]) -> list[Run]:
    """The hold-out runs that can check a calibration."""
    for run in hold_out_runs:
        if run.kind != "static" or not run.has_loads:
            session.left_out(run.name, f"a {run.kind} run without static loads to compare with")
    return [run for run in hold_out_runs if run.kind == "static" and run.has_loads]


def _summary(result: Calibration) -> dict[str, Any]:
    from balance_cli.cli.calibration_text import math_model_summary

    return {
        "geometry": result.geometry.name,
        "trims": {name: _trim_summary(trim) for name, trim in result.trims.items()},
        "gage": math_model_summary(result.gage) if result.gage else None,
    }


def _trim_summary(trim: TrimCalibration) -> dict[str, Any]:
    components, channels = trim.components, trim.channel_names
    return {
        "residual_percent_fs": trim.residual_percent_fs,
        "condition": trim.condition,
        "runs": trim.runs,
        "rows": trim.rows,
        "dof": trim.dof,
        "lack_of_fit": trim.lack_of_fit,
        "full_range": dict(zip(components, trim.full_range, strict=True)),
        "mean_load": dict(zip(components, trim.mean_load, strict=True)),
        "channel_residual_percent_fs": trim.channel_residual_percent_fs,
        "hysteresis_percent_fs": {
            name: {"value": 100 * value / full, "sigma": 100 * sigma / full}
            for name, value, sigma, full in zip(
                components, trim.hysteresis.loads, trim.hysteresis.loads_sigma, trim.full_range, strict=True
            )
        },
        "channel_hysteresis": _matrix_summary(
            channels, components, trim.hysteresis.channels, trim.hysteresis.channels_sigma
        ),
        "C0": _matrix_summary(channels, components, trim.C0, trim.C0_sigma),
        "T0": _matrix_summary(components, channels, trim.T0, trim.T0_sigma),
        "channels_left_out": trim.left_out,
    }


def _matrix_summary(rows: tuple[str, ...], columns: tuple[str, ...], value: Any, sigma: Any) -> dict[str, Any]:
    """{row: {column: {value, sigma}}}."""
    return {
        row: {column: {"value": value[i, j], "sigma": sigma[i, j]} for j, column in enumerate(columns)}
        for i, row in enumerate(rows)
    }


def _text(result: Calibration) -> Iterator[str]:
    from balance_cli.cli.calibration_text import math_model_text

    for trim in result.trims.values():
        if not trim.runs:
            yield f"From a matrix, straight part at zero load: condition {trim.condition:.1f}"
            continue
        yield f"Trim {trim.trim}: {trim.rows} rows of {', '.join(trim.runs)}; condition {trim.condition:.1f}"
        yield f"  residual over noise {trim.lack_of_fit:.2f} (1: a straight line is all there is)"
        yield "  component  full range   residual % FS   up less down % FS"
        for j, name in enumerate(trim.components):
            full = trim.full_range[j]
            loop, sigma = 100 * trim.hysteresis.loads[j] / full, 100 * trim.hysteresis.loads_sigma[j] / full
            yield f"  {name:9s} {full:11.1f} {trim.residual_percent_fs[name]:15.4f}   {loop:9.4f} +- {sigma:.4f}"
    if result.gage:
        yield from math_model_text(result.gage)
