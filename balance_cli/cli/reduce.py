"""`balance reduce`: hub loads of check and wind runs, by rotor harmonics or in time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from balance_cli.cli.batch.options import BatchOptions, batch_options, gather_batch_options
from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.errors import EXIT_RUNS_SKIPPED
from balance_cli.cli.load_table_file import check_table_suffix, write_loads
from balance_cli.cli.options import InputFile, OutputFolder, deprecated_option, output_option
from balance_cli.cli.reduce_inputs import parse_frequencies, read_calibration, read_response
from balance_cli.cli.reduce_runs import MethodOptions, Reduction
from balance_cli.cli.reduce_spectra import check_band_options, reduce_to_spectra
from balance_cli.io.errors import UserError
from balance_cli.reduction.choices import FREQUENCIES, LOAD_MODELS, MEAN_LOAD_METHODS, METHODS, MOST_HARMONICS
from balance_cli.signals.response.choices import INTERPOLATIONS

if TYPE_CHECKING:
    from balance_cli.campaign.recording.run import Run
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.reduction.response_sources import ResponseSource
    from balance_cli.reduction.result import RunLoads
    from balance_cli.signals.nyquist_noise import UsualNoise


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
    metavar="N",
    type=click.IntRange(1, MOST_HARMONICS),
    help="Highest rotor harmonic.  [default: a multiple of the blades, at least two, at least 8, within the band]",
)
@click.option(
    "--rotor",
    metavar="N",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="The rotor whose harmonics are reduced, where runs have pulses of several. Lines of the others are taken out.",
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
    metavar="FROM TO",
    help="Spectral densities of the loads within this band [Hz], in place of rotor harmonics.",
)
@click.option(
    "--mean-loads",
    type=click.Choice(MEAN_LOAD_METHODS),
    help="Mean loads of a nonlinear calibration by iteration, or directly by the model of `calibrate --non-iterative`. "
    " [default: non-iterative where the calibration has that model]",
)
@click.option("--zero", type=InputFile(), metavar="RUN", help="Wind-off record, the zero of the mean loads.")
@click.option("--history", type=OutputFolder(), metavar="DIR", help="Also write load histories RUN.h5 to this folder.")
@click.argument("runs", type=InputFile(readable=False), nargs=-1, required=True, metavar="RUN...")
@batch_options
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
    rotor: int,
    frequencies: tuple[float, ...],
    band: tuple[float, float] | None,
    mean_loads: str | None,
    zero: Path | None,
    history: Path | None,
    runs: tuple[Path, ...],
    output: Path,
    **batch_parameters: Any,
) -> None:
    """Reduce runs to hub loads at the rotor harmonics.

    The dynamics of the balance are removed. Mean loads come from the strain and torque channels through the static
    calibration; without --calibration, as with piezo cells alone, only the harmonics are measured. Harmonic loads come
    from all channels through a modeled or measured response, weighted by noise. A zero run among RUN... serves as
    --zero.

    Records without 1/rev pulses are reduced at given --frequencies, or to spectral densities within a --band.

    Loads that change in time are estimated sample by sample by --method kalman and --method smoother, from all channels
    through a model of the physical form. --history writes them; the table contains their harmonics.

    Of several runs, those that cannot be used are listed and skipped, with exit status 4. The loads do not depend on
    the number of processes. After an interruption the same call resumes where it stopped.
    """
    batch = gather_batch_options(batch_parameters)
    skips = batch.skips(len(runs))
    _check_options(model, transfer, static, calibration is not None, zero is not None, output)
    method_options = MethodOptions(
        method, load_model if _is_given("load_model") else None, lag, harmonics or 0, frequencies, rotor
    )
    method_options.check(model is not None, history is not None, harmonics is not None)
    check_band_options(band, _is_given)
    cal = read_calibration(session, calibration, mean_loads)
    geometry, source, usual_noise = read_response(session, cal, model, transfer, interpolation)
    method_options.check_source(source, model)
    if band is not None:
        _reduce_to_spectra(session, geometry, source, usual_noise, band, runs, batch, output)
        return
    from balance_cli.cli.batch.reduction import BatchReduction

    reduction = Reduction(method_options, geometry, cal, source, None, history, usual_noise=usual_noise)
    reduction, loads = BatchReduction(session, batch, skips).reduce(reduction, runs, zero, output)
    _finish(session, reduction, loads, output, batch.shard)


def _reduce_to_spectra(
    session: Session,
    geometry: Geometry,
    source: ResponseSource,
    usual_noise: tuple[UsualNoise, ...],
    band: tuple[float, float],
    paths: tuple[Path, ...],
    batch: BatchOptions,
    output: Path,
) -> None:
    """Reduce runs to spectra, in this process."""
    from balance_cli.cli.consistency import require_consistent_runs
    from balance_cli.diagnosis.consistency.severity import known_anyway

    skips = batch.skips(len(paths))
    records = session.runs(paths, geometry, skips)
    records = require_consistent_runs(session, geometry, records, skips, known_anyway, usual_noise)
    reduce_to_spectra(session, geometry, source, _rotor_runs(session, records), band, skips, output)
    if session.skipped and not batch.skip_bad:
        session.status = EXIT_RUNS_SKIPPED


def _finish(
    session: Session, reduction: Reduction, runs: Mapping[str, RunLoads], output: Path, shard: tuple[int, int] | None
) -> None:
    """Write the loads and set summary and text; `balance merge` compares the runs of shards with each other."""
    from balance_cli.cli.consistency import flag_contradicted_runs
    from balance_cli.cli.reduce_text import reduction_text, summary
    from balance_cli.reduction.response_description import text_with_rotor
    from balance_cli.reduction.result import HubLoads
    from balance_cli.steps.contradicted_loads import compare_loads

    runs = flag_contradicted_runs(session, runs)
    if not reduction.method.frequencies:
        runs, compared = compare_loads(runs, reduction.calibration, shard is not None)
        session.warn_of_runs(compared, runs)
    options = reduction.method
    method = FREQUENCIES if options.frequencies and not options.in_time else options.name
    warnings = tuple(sorted(set(session.warnings)))  # in one order, whoever reduced which run first
    response = text_with_rotor(reduction.source.description, options.rotor)
    loads = HubLoads(method, response, reduction.geometry, runs, warnings or None)
    provenance = session.provenance()
    if shard is not None:
        provenance = replace(provenance, command=f"{provenance.command} --shard {shard[0]}/{shard[1]}")
    write_loads(session, output, loads, provenance)
    session.finish(summary(loads) if session.writes_json else {}, reduction_text(loads))


def _rotor_runs(session: Session, records: tuple[Run, ...]) -> list[Run]:
    """Return the check and wind runs among the records. UserError where there are none."""
    with session.collect_messages():
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
    if transfer is None and _is_given("interpolation"):
        raise UserError("applies to a measured response", "--interpolation", remedy="Give --transfer, or leave it out")
    check_table_suffix(output)


def _accept_run(session: Session, run: Run) -> bool:
    if run.kind in ("check", "wind"):
        return True
    if run.kind != "zero":
        session.report_left_out(run.name, f"a {run.kind} run contains no rotor loads")
    return False
