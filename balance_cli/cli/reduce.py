"""`balance reduce`: hub loads of check and wind runs, by rotor harmonics or in time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from balance_cli.cli.common import Session, balance_command, output_option, skip_bad_option
from balance_cli.cli.options import InputFile, OutputFolder, deprecated_option
from balance_cli.cli.reduce_inputs import parse_frequencies, read_calibration, read_response, read_zero
from balance_cli.cli.reduce_runs import MethodOptions, Reduction
from balance_cli.cli.reduce_spectra import check_band_options, reduce_to_spectra
from balance_cli.io.errors import UserError
from balance_cli.io.formats import LOADS_FORMAT
from balance_cli.io.spreadsheet import text_cell
from balance_cli.reduction.choices import FREQUENCIES, INTERPOLATIONS, LOAD_MODELS, METHODS, TABLE_SUFFIXES

if TYPE_CHECKING:
    from balance_cli.campaign.recording.run import Run
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.reduction.response_sources import ResponseSource
    from balance_cli.reduction.result import HubLoads, RunLoads


@balance_command("reduce")
@click.option(
    "--calibration",
    type=InputFile(),
    metavar="CAL",
    help="Static calibration. Without it mean loads are `not measured`.",
)
@click.option("--model", type=InputFile(), metavar="MODEL", help="Response from this model.")
@click.option("--transfer", type=InputFile(), metavar="TF", help="Response as measured, interpolated.")
@click.option(
    "--static",
    "static",
    is_flag=True,
    help="Response by the static matrix at every harmonic: dynamics are not removed.",
)
@click.option(
    "--interpolation",
    type=click.Choice(INTERPOLATIONS),
    default=INTERPOLATIONS[0],
    show_default=True,
    help="How a measured response is interpolated at the harmonics.",
)
@click.option(
    "--method",
    type=click.Choice(METHODS),
    default=METHODS[0],
    show_default=True,
    help="harmonic: regression on azimuth over the record. kalman: loads in time by a Kalman filter, from the past of "
    "each sample. smoother: loads in time from the whole record.",
)
@click.option(
    "--load-model",
    type=click.Choice(LOAD_MODELS),
    default=LOAD_MODELS[0],
    show_default=True,
    help="With --method kalman or smoother, what is assumed of the loads. harmonics: locked to the azimuth, and random "
    "loads. random: random loads only. free: any loads within a band.",
)
@deprecated_option("--loads-as", "--load-model", "load_model", type=click.Choice(LOAD_MODELS))
@click.option(
    "--lag",
    type=float,
    metavar="SECONDS",
    help="With --method kalman: each estimate also uses this much of the record after it (0: none).  [default: 0.05]",
)
@click.option(
    "--harmonics",
    type=click.IntRange(1, 64),
    help="Highest rotor harmonic.  [default: a multiple of the blades, at least two, at least 8, within the band]",
)
@click.option(
    "--frequencies",
    callback=parse_frequencies,
    metavar="F,F,...",
    help="Loads at these frequencies [Hz] in place of rotor harmonics; phases count from the first sample. In time: "
    "the frequency whose multiples the loads are.",
)
@click.option(
    "--band",
    type=(float, float),
    metavar="LO HI",
    help="Spectral densities of the loads within this band [Hz], in place of rotor harmonics.",
)
@click.option("--zero", type=InputFile(), metavar="RUN", help="Wind-off record, the zero of the mean loads.")
@click.option("--history", type=OutputFolder(), metavar="DIR", help="Also write load histories RUN.h5 to this folder.")
@click.argument("runs", type=InputFile(readable=False), nargs=-1, required=True, metavar="RUN...")
@skip_bad_option
@output_option("LOADS", "Table of loads, .csv or .h5.")
def command(
    session: Session,
    calibration: Path | None,
    model: Path | None,
    transfer: Path | None,
    static: bool,
    interpolation: str,
    method: str,
    load_model: str,
    lag: float | None,
    harmonics: int | None,
    frequencies: tuple[float, ...],
    band: tuple[float, float] | None,
    zero: Path | None,
    history: Path | None,
    runs: tuple[Path, ...],
    skip_bad: bool,
    output: Path,
) -> None:
    """Reduce runs to rotor-harmonic hub loads, with the dynamics of the balance removed.

    Mean loads come from the strain and torque channels through the static calibration; without --calibration, as with
    piezo cells alone, only the harmonics are measured. Harmonic loads come from all channels through a modeled or
    measured response, weighted by noise. A zero run among RUN... serves as --zero.

    Records without 1/rev pulses are reduced at given --frequencies, or to spectral densities within a --band.

    Loads that change in time are estimated sample by sample by --method kalman and --method smoother, from all channels
    through a model of the physical form. --history writes them; the table contains their harmonics.
    """
    from balance_cli.cli.consistency import require_consistent_runs
    from balance_cli.diagnosis.consistency.severity import known_anyway

    _check_options(model, transfer, static, calibration is not None, zero is not None, output)
    method_options = MethodOptions(
        method, load_model if _is_given("load_model") else None, lag, harmonics or 0, frequencies
    )
    method_options.check(model is not None, history is not None, harmonics is not None)
    check_band_options(band, _is_given)
    cal = read_calibration(session, calibration)
    geometry, source = read_response(session, cal, model, transfer, interpolation)
    method_options.check_source(source, model)
    records = session.runs(runs, geometry, skip_bad)
    records = require_consistent_runs(session, geometry, records, skip_bad, known_anyway)
    if band is not None:
        reduce_to_spectra(session, geometry, source, _rotor_runs(session, records), band, skip_bad, output)
        return
    if harmonics is None and not frequencies:
        method_options = replace(method_options, harmonics=_default_harmonics(session, geometry, source, records))
    reduction = Reduction(method_options, geometry, cal, source, read_zero(session, cal, zero, records), history)
    _finish(session, reduction, _reduce_runs(session, reduction, records, skip_bad), output)


def _finish(session: Session, reduction: Reduction, runs: dict[str, RunLoads], output: Path) -> None:
    """Write the loads and set summary and text."""
    from balance_cli.cli.reduce_text import reduction_text, summary
    from balance_cli.reduction.result import HubLoads

    options = reduction.method
    method = FREQUENCIES if options.frequencies and not options.in_time else options.name
    loads = HubLoads(method, reduction.source.description, reduction.geometry, runs, tuple(session.warnings) or None)
    _write_load_table(session, output, loads)
    session.finish(summary(loads), reduction_text(loads))


def _default_harmonics(session: Session, geometry: Geometry, source: ResponseSource, records: tuple[Run, ...]) -> int:
    """Return the harmonics that all runs permit of those that are the default, with a warning where they are fewer."""
    from balance_cli.steps.reduction_inputs import default_harmonics, harmonics_within_band

    wanted = default_harmonics(geometry)
    runs = [run for run in records if run.kind in ("check", "wind")]
    possible = {run.name: harmonics_within_band(run, source, wanted) for run in runs}
    fewest = min(possible.values(), default=wanted)
    if fewest < wanted:
        name = min(possible, key=lambda run: possible[run])
        session.warn(f"{fewest} harmonics in place of {wanted}: those above are beyond the band of run {name}")
    return fewest


def _reduce_runs(
    session: Session, reduction: Reduction, records: tuple[Run, ...], skip_bad: bool
) -> dict[str, RunLoads]:
    """Reduce the check and wind runs among the records."""
    runs = _rotor_runs(session, records)
    run_loads: dict[str, RunLoads] = {}
    for run in session.progress(runs, "runs", len(runs)):
        with session.skip_if_unusable(run, skip_bad):
            run_loads[run.name] = reduction.reduce_run(session, run)
            for channel, reason in run_loads[run.name].left_out.items():
                session.warn(f"{run.name}: channel {channel} left out: {reason}")
    return run_loads


def _rotor_runs(session: Session, records: tuple[Run, ...]) -> list[Run]:
    """Return the check and wind runs among the records. UserError where there are none."""
    runs = [run for run in records if _accept_run(session, run)]
    if not runs:
        raise UserError("no check or wind run among the runs", "RUN...", remedy="Give the runs that are to be reduced")
    return runs


def _is_given(option: str) -> bool:
    """Return whether the option was given on the command line."""
    source = click.get_current_context().get_parameter_source(option)
    return source is not click.core.ParameterSource.DEFAULT


def _check_options(
    model: Path | None, transfer: Path | None, static: bool, has_calibration: bool, has_zero: bool, output: Path
) -> None:
    if (model is not None) + (transfer is not None) + static != 1:
        raise UserError(
            "exactly one response is needed", "--model, --transfer, --static", remedy="Give one of the three"
        )
    if not has_calibration and (static or has_zero):
        option = "--static" if static else "--zero"
        raise UserError("needs a static calibration", option, remedy="Add --calibration CAL, or leave it out")
    if output.suffix not in TABLE_SUFFIXES:
        raise UserError("the table is written as .csv or .h5", str(output), remedy="End its name with .csv or .h5")


def _accept_run(session: Session, run: Run) -> bool:
    if run.kind in ("check", "wind"):
        return True
    if run.kind != "zero":
        session.report_left_out(run.name, f"a {run.kind} run contains no rotor loads")
    return False


def _write_load_table(session: Session, output: Path, loads: HubLoads) -> None:
    if output.suffix == ".h5":
        session.save(output, LOADS_FORMAT, loads)
        return
    from balance_cli.reduction.result import load_table

    table = load_table(loads)
    table["run"] = table["run"].map(text_cell)
    session.write_text(output, table.to_csv(index=False, lineterminator="\n"))
