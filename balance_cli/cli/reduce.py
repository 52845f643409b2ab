"""`balance reduce`: hub loads of check and wind runs, by rotor harmonics or in time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from balance_cli.cli.common import Session, balance_command, output_option, skip_bad_option
from balance_cli.cli.options import InputFile, OutputFolder
from balance_cli.cli.reduce_runs import LOAD_MODEL_CHOICES, METHODS, MethodOptions, Reduction, no_state_space_error
from balance_cli.io.errors import UserError

if TYPE_CHECKING:
    from balance_cli.calibration.result import Calibration
    from balance_cli.campaign.recording.run import Run
    from balance_cli.reduction.mean_loads import ZeroRecord
    from balance_cli.reduction.response_sources import ResponseSource
    from balance_cli.reduction.result import HubLoads, RunLoads

FORMAT = "balance-loads/1"
INTERPOLATIONS = ("local", "spline", "first-order", "nearest")


@balance_command("reduce")
@click.option("--calibration", type=InputFile(), required=True, metavar="CAL", help="Static calibration.")
@click.option("--model", type=InputFile(), metavar="MODEL", help="Response from this model.")
@click.option("--transfer", type=InputFile(), metavar="TF", help="Response as measured, interpolated.")
@click.option("--static", "static", is_flag=True, help="The static matrix at every harmonic: no dynamics undone.")
@click.option(
    "--interpolation",
    type=click.Choice(INTERPOLATIONS),
    default="local",
    show_default=True,
    help="How a measured response is taken to the harmonics.",
)
@click.option(
    "--method",
    type=click.Choice(METHODS),
    default=METHODS[0],
    show_default=True,
    help="Regression on azimuth over the whole record; loads in time by a Kalman filter, each sample given the past; "
    "or by a smoother, given the whole record.",
)
@click.option(
    "--loads-as",
    type=click.Choice(LOAD_MODEL_CHOICES),
    default=LOAD_MODEL_CHOICES[0],
    show_default=True,
    help="What is known of the loads in time: harmonics locked to the azimuth beside random loads; random loads alone; "
    "nothing within a band.",
)
@click.option(
    "--lag",
    type=float,
    metavar="SECONDS",
    help="With --method kalman: each sample given so many seconds after it, too (0: none).  [default: 0.05]",
)
@click.option("--harmonics", type=click.IntRange(1, 64), default=8, show_default=True, help="Highest rotor harmonic.")
@click.option("--zero", type=InputFile(), metavar="RUN", help="Wind-off record that the mean loads count from.")
@click.option("--history", type=OutputFolder(), metavar="DIR", help="Write load histories RUN.h5 there too.")
@click.argument("runs", type=InputFile(), nargs=-1, required=True, metavar="RUN...")
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
    loads_as: str,
    lag: float | None,
    harmonics: int,
    zero: Path | None,
    history: Path | None,
    runs: tuple[Path, ...],
    skip_bad: bool,
    output: Path,
) -> None:
    """Rotor-harmonic hub loads, with the dynamics of the balance undone.

    The mean comes from the strain and torque channels through the static calibration, the harmonics from all channels
    through the response of a model or of a measurement, weighted by noise. A zero run among RUN... serves as --zero.

    For loads that change in time, --method kalman and --method smoother estimate them sample by sample from all
    channels through a model of the physical form; --history writes them, the table holds their harmonics.
    """
    from balance_cli.calibration.result import Calibration
    from balance_cli.cli.reduce_text import reduction_text, summary
    from balance_cli.reduction.result import HubLoads

    _check_options(model, transfer, static, output)
    how = MethodOptions(method, loads_as if _is_given("loads_as") else None, lag, harmonics)
    how.check(model is not None)
    cal: Calibration = session.artefact(calibration, {"balance-calibration/1": Calibration}, "calibration").content
    source = _response_source(session, cal, model, transfer, interpolation)
    _check_source(how, source, model)
    records = session.runs(runs, cal.geometry, skip_bad)
    reduction = Reduction(how, cal, source, _load_zero_record(session, cal, zero, records), history)
    reduced: dict[str, RunLoads] = {}
    used = [run for run in records if _accept_run(session, run)]
    if not used:
        raise UserError("no check or wind run among the runs", "RUN...", remedy="Give the runs that are to be reduced")
    for run in session.progress(used, "runs", len(used)):
        with session.skip_if_unusable(run, skip_bad):
            reduced[run.name] = reduction.reduced(session, run)
            for channel, reason in reduced[run.name].left_out.items():
                session.warn(f"{run.name}: channel {channel} left out: {reason}")
    loads = HubLoads(method, source.description, cal.geometry, reduced)
    _write_load_table(session, output, loads)
    session.finish(summary(loads), reduction_text(loads))


def _is_given(option: str) -> bool:
    """Whether the user gave this option."""
    source = click.get_current_context().get_parameter_source(option)
    return source is not click.core.ParameterSource.DEFAULT


def _check_options(model: Path | None, transfer: Path | None, static: bool, output: Path) -> None:
    if (model is not None) + (transfer is not None) + static != 1:
        raise UserError(
            "exactly one response is needed", "--model, --transfer, --static", remedy="Give one of the three"
        )
    if output.suffix not in (".csv", ".h5"):
        raise UserError("the table is written as .csv or .h5", str(output), remedy="Let its name end so")


def _response_source(
    session: Session, calibration: Calibration, model: Path | None, transfer: Path | None, interpolation: str
) -> ResponseSource:
    """The response that was asked for. UserError where its geometry is not that of the calibration."""
    from balance_cli.reduction import response_sources as responses

    if model is not None:
        from balance_cli.estimation.identified_model import IdentifiedModel

        identified: IdentifiedModel = session.artefact(model, {"balance-model/1": IdentifiedModel}, "model").content
        _check_geometry(identified.geometry, calibration, model)
        return responses.model_source(identified)
    if transfer is not None:
        from balance_cli.signals.response.transfer import Transfer

        measured: Transfer = session.artefact(transfer, {"balance-transfer/1": Transfer}, "transfer").content
        _check_geometry(measured.geometry, calibration, transfer)
        return responses.transfer_source(measured, interpolation)
    return responses.static_source(calibration)


def _check_source(method: MethodOptions, source: ResponseSource, model: Path | None) -> None:
    from balance_cli.reduction.response_sources import ModelSource

    if method.in_time and not isinstance(source, ModelSource):
        raise no_state_space_error(method.name, str(model))


def _check_geometry(geometry: Any, calibration: Calibration, path: Path) -> None:
    from balance_cli.campaign.rig.geometry_file import geometry_digest

    bare, other = (item.model_copy(update={"effects": ()}) for item in (geometry, calibration.geometry))
    if geometry_digest(bare) != geometry_digest(other):
        raise UserError(
            f"was made from another geometry (`{geometry.name}`) than the calibration (`{calibration.geometry.name}`)",
            str(path),
            "geometry",
            "Make both from the same geometry file",
        )


def _load_zero_record(
    session: Session, calibration: Calibration, path: Path | None, records: tuple[Run, ...]
) -> ZeroRecord | None:
    from balance_cli.campaign.recording.channel_health import live_channels
    from balance_cli.reduction.mean_loads import zero_record

    zeros = [run for run in records if run.kind == "zero"]
    if path is not None:
        zeros = list(session.runs([path], calibration.geometry, role="zero"))
        if zeros[0].kind != "zero":
            raise UserError(
                f"is a {zeros[0].kind} run", str(path), "attribute `kind`", "Give a wind-off record of kind `zero`"
            )
    if len(zeros) > 1:
        raise UserError(
            "more than one zero run: " + ", ".join(run.name for run in zeros), "RUN...", remedy="Choose one with --zero"
        )
    if not zeros:
        return None
    wanted = [channel.name for channel in calibration.geometry.channels if channel.measures_dc]
    live = live_channels(zeros[0], calibration.geometry).live
    return zero_record(zeros[0], [name for name in wanted if name in live])


def _accept_run(session: Session, run: Run) -> bool:
    if run.kind in ("check", "wind"):
        return True
    if run.kind != "zero":
        session.left_out(run.name, f"a {run.kind} run has no rotor loads to reduce")
    return False


def _write_load_table(session: Session, output: Path, loads: HubLoads) -> None:
    if output.suffix == ".h5":
        session.save(output, FORMAT, loads)
        return
    from balance_cli.reduction.result import load_table

    load_table(loads).to_csv(session.stage(output), index=False)
