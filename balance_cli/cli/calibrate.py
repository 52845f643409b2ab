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
    runs_argument,
    skip_bad_option,
)
from balance_cli.cli.options import InputFile

if TYPE_CHECKING:
    from balance_cli.calibrated import Calibration, TrimCalibration
    from balance_cli.runs import Run

FORMAT = "balance-calibration/1"


@balance_command("calibrate")
@geometry_option
@runs_argument
@click.option(
    "--terms",
    type=click.Choice(["search", "linear"]),
    default="search",
    show_default=True,
    help="Terms of the model through all trims: those that are found in each channel, or the loads alone.",
)
@click.option(
    "--hold-out",
    "hold_out",
    type=InputFile(),
    multiple=True,
    metavar="RUN",
    help="Static run that takes no part and checks the prediction intervals (repeatable).",
)
@skip_bad_option
@output_option("CAL")
def command(
    session: Session,
    geometry: Path,
    runs: tuple[Path, ...],
    terms: str,
    hold_out: tuple[Path, ...],
    skip_bad: bool,
    output: Path,
) -> None:
    """Static matrices C0 and T0, one set per trim, and one model of all channels through all trims.

    The model has the terms that balances are calibrated with (AIAA R-091): a channel has those that are significant and
    that help to predict loading sequences that took no part. What is plainly wrong is named and takes no part.
    """
    from balance_cli.calibrate import calibrate
    from balance_cli.cli.calibration_text import gage_warnings

    rig = session.geometry(geometry)
    opened = session.runs(runs, rig, skip_bad)
    held = session.runs(hold_out, rig, skip_bad, role="hold-out", apart_from=opened)
    for run in opened:
        if run.kind != "static":
            session.left_out(run.name, f"a {run.kind} run; only static runs are used")
    result = calibrate(opened, rig, terms == "search", _static(session, held))
    for trim in result.trims.values():
        for name, reason in trim.left_out.items():
            session.warn(f"trim {trim.trim}: channel {name} left out: {reason}")
    for words in gage_warnings(result.gage) if result.gage else ():
        session.warn(words)
    session.save(output, FORMAT, result)
    session.finish(_summary(result), _text(result))


def _static(session: Session, held: tuple[Run, ...]) -> list[Run]:
    """The hold-out runs that can check a calibration."""
    for run in held:
        if run.kind != "static" or not run.has_loads:
            session.left_out(run.name, f"a {run.kind} run without static loads to compare with")
    return [run for run in held if run.kind == "static" and run.has_loads]


def _summary(result: Calibration) -> dict[str, Any]:
    from balance_cli.cli.calibration_text import gage_summary

    return {
        "geometry": result.geometry.name,
        "trims": {name: _of_trim(trim) for name, trim in result.trims.items()},
        "gage": gage_summary(result.gage) if result.gage else None,
    }


def _of_trim(trim: TrimCalibration) -> dict[str, Any]:
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
        "channel_hysteresis": _matrix(channels, components, trim.hysteresis.channels, trim.hysteresis.channels_sigma),
        "C0": _matrix(channels, components, trim.C0, trim.C0_sigma),
        "T0": _matrix(components, channels, trim.T0, trim.T0_sigma),
        "channels_left_out": trim.left_out,
    }


def _matrix(rows: tuple[str, ...], columns: tuple[str, ...], value: Any, sigma: Any) -> dict[str, Any]:
    """{row: {column: {value, sigma}}}."""
    return {
        row: {column: {"value": value[i, j], "sigma": sigma[i, j]} for j, column in enumerate(columns)}
        for i, row in enumerate(rows)
    }


def _text(result: Calibration) -> Iterator[str]:
    from balance_cli.cli.calibration_text import gage_text

    for trim in result.trims.values():
        yield f"Trim {trim.trim}: {trim.rows} rows of {', '.join(trim.runs)}; condition {trim.condition:.1f}"
        yield f"  residual over noise {trim.lack_of_fit:.2f} (1: a straight line is all there is)"
        yield "  component  full range   residual % FS   up less down % FS"
        for j, name in enumerate(trim.components):
            full = trim.full_range[j]
            loop, sigma = 100 * trim.hysteresis.loads[j] / full, 100 * trim.hysteresis.loads_sigma[j] / full
            yield f"  {name:9s} {full:11.1f} {trim.residual_percent_fs[name]:15.4f}   {loop:9.4f} +- {sigma:.4f}"
    if result.gage:
        yield from gage_text(result.gage)
