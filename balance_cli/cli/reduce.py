"""`balance reduce`: hub loads of check and wind runs, by rotor harmonics or in time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from balance_cli.cli.common import Session, balance_command, output_option, skip_bad_option
from balance_cli.cli.options import InputFile, OutputFolder, deprecated_option
from balance_cli.cli.reduce_runs import MethodOptions, Reduction
from balance_cli.io.errors import UserError
from balance_cli.io.formats import LOADS_FORMAT
from balance_cli.io.spreadsheet import text_cell
from balance_cli.reduction.choices import INTERPOLATIONS, LOAD_MODELS, METHODS, TABLE_SUFFIXES

if TYPE_CHECKING:
    from balance_cli.calibration.result import Calibration
    from balance_cli.campaign.recording.run import Run
    from balance_cli.reduction.mean_loads import ZeroRecord
    from balance_cli.reduction.response_sources import ResponseSource
    from balance_cli.reduction.result import HubLoads, RunLoads


@balance_command("reduce")
@click.option("--calibration", type=InputFile(), required=True, metavar="CAL", help="Static calibration.")
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
@click.option("--harmonics", type=click.IntRange(1, 64), default=8, show_default=True, help="Highest rotor harmonic.")
@click.option("--zero", type=InputFile(), metavar="RUN", help="Wind-off record, the zero of the mean loads.")
@click.option("--history", type=OutputFolder(), metavar="DIR", help="Also write load histories RUN.h5 to this folder.")
@click.argument("runs", type=InputFile(readable=False), nargs=-1, required=True, metavar="RUN...")
@skip_bad_option
@output_option("LOADS", "Table of loads, .csv or .h5.")
def command(
    session: Session,
    calibration: Path,
    model: Path | None,
    transfer: Path | None,
    static: bool,
    interpolation: str,
    method: str,
    load_model: str,
    lag: float | None,
    harmonics: int,
    zero: Path | None,
    history: Path | None,
    runs: tuple[Path, ...],
    skip_bad: bool,
    output: Path,
) -> None:
    """Reduce runs to rotor-harmonic hub loads, with the dynamics of the balance removed.

    Mean loads come from the strain and torque channels through the static calibration. Harmonic loads come from all
    channels through a modeled or measured response, weighted by noise. A zero run among RUN... serves as --zero.

    Loads that change in time are estimated sample by sample by --method kalman and --method smoother, from all channels
    through a model of the physical form. --history writes them; the table contains their harmonics.
    """
    from balance_cli.calibration.result import Calibration
    from balance_cli.cli.reduce_text import reduction_text, summary
    from balance_cli.reduction.result import HubLoads

    _check_options(model, transfer, static, output)
    method_options = MethodOptions(method, load_model if _is_given("load_model") else None, lag, harmonics)
    method_options.check(model is not None)
    cal: Calibration = session.artefact(calibration, {"balance-calibration/1": Calibration}, "calibration").content
    source = _response_source(session, cal, model, transfer, interpolation)
    method_options.check_source(source, model)
    records = session.runs(runs, cal.geometry, skip_bad)
    reduction = Reduction(method_options, cal, source, _load_zero_record(session, cal, zero, records), history)
    run_loads = _reduce_runs(session, reduction, records, skip_bad)
    loads = HubLoads(method, source.description, cal.geometry, run_loads, tuple(session.warnings) or None)
    _write_load_table(session, output, loads)
    session.finish(summary(loads), reduction_text(loads))


def _reduce_runs(
    session: Session, reduction: Reduction, records: tuple[Run, ...], skip_bad: bool
) -> dict[str, RunLoads]:
    """Reduce the check and wind runs among the records. UserError where there are none."""
    runs = [run for run in records if _accept_run(session, run)]
    if not runs:
        raise UserError("no check or wind run among the runs", "RUN...", remedy="Give the runs that are to be reduced")
    run_loads: dict[str, RunLoads] = {}
    for run in session.progress(runs, "runs", len(runs)):
        with session.skip_if_unusable(run, skip_bad):
            run_loads[run.name] = reduction.reduce_run(session, run)
            for channel, reason in run_loads[run.name].left_out.items():
                session.warn(f"{run.name}: channel {channel} left out: {reason}")
    return run_loads


def _is_given(option: str) -> bool:
    """Return whether the option was given on the command line."""
    source = click.get_current_context().get_parameter_source(option)
    return source is not click.core.ParameterSource.DEFAULT


def _check_options(model: Path | None, transfer: Path | None, static: bool, output: Path) -> None:
    if (model is not None) + (transfer is not None) + static != 1:
        raise UserError(
            "exactly one response is needed", "--model, --transfer, --static", remedy="Give one of the three"
        )
    if output.suffix not in TABLE_SUFFIXES:
        raise UserError("the table is written as .csv or .h5", str(output), remedy="End its name with .csv or .h5")


def _response_source(
    session: Session, calibration: Calibration, model: Path | None, transfer: Path | None, interpolation: str
) -> ResponseSource:
    """Return the response. UserError where its geometry is not that of the calibration."""
    from balance_cli.steps.reduction_inputs import require_same_geometry

    if model is not None:
        from balance_cli.estimation.identified_model import IdentifiedModel
        from balance_cli.reduction import model_sources

        identified: IdentifiedModel = session.artefact(model, {"balance-model/1": IdentifiedModel}, "model").content
        require_same_geometry(identified.geometry, calibration, str(model))
        return model_sources.model_source(identified)
    from balance_cli.reduction.response_sources import static_source, transfer_source

    if transfer is not None:
        from balance_cli.signals.response.transfer import Transfer

        measured: Transfer = session.artefact(transfer, {"balance-transfer/1": Transfer}, "transfer").content
        require_same_geometry(measured.geometry, calibration, str(transfer))
        return transfer_source(measured, interpolation)
    return static_source(calibration)


def _load_zero_record(
    session: Session, calibration: Calibration, path: Path | None, records: tuple[Run, ...]
) -> ZeroRecord | None:
    from balance_cli.steps.reduction_inputs import zero_reference

    if path is not None:
        return zero_reference(session.runs([path], calibration.geometry, role="zero"), calibration)
    return zero_reference([run for run in records if run.kind == "zero"], calibration)


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
