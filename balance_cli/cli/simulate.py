"""`balance simulate`: run files of a rig with known truth and chosen effects."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.options import NumberRange, OutputFolder, deprecated_option, geometry_option
from balance_cli.io.errors import UserError
from balance_cli.io.result_view import plural

if TYPE_CHECKING:
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.simulation import CampaignPlan, Noise, TrueRig
    from balance_cli.simulation.extensions.base import Extension


@balance_command("simulate")
@geometry_option
@click.option(
    "--plan",
    default="standard",
    show_default=True,
    metavar="PLAN",
    help="Which runs: `standard`, `short`, or a YAML file with a list of `runs`.",
)
@click.option("--only", multiple=True, metavar="RUN", help="Only this run of the plan (repeatable).")
@click.option(
    "--effect",
    "effects",
    multiple=True,
    metavar="NAME[@PLACE[,PLACE]]",
    help="An effect beyond the rigid plate, besides those that the geometry declares (repeatable).",
)
@click.option(
    "--parameter",
    "parameters",
    multiple=True,
    metavar="[EFFECT:]NAME=VALUE",
    help="A parameter of an effect, SI units; with several effects name it as in `--effect` (repeatable).",
)
@click.option(
    "--sample-tolerances",
    "draw",
    is_flag=True,
    help="Sample the true rig from the declared tolerances; otherwise it is as declared.",
)
@deprecated_option("--draw", "--sample-tolerances", "draw", is_flag=True)
@click.option(
    "--seed", metavar="N", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of all random numbers."
)
@click.option(
    "--noise",
    metavar="FACTOR",
    type=NumberRange(min=0),
    default=1.0,
    show_default=True,
    help="Noise, times that of the plan or of the recorded campaign; 0 leaves rounding out too.",
)
@click.option("--float64", "double", is_flag=True, help="Store the samples in double precision.")
@deprecated_option("--double", "--float64", "double", is_flag=True)
@click.option("-o", "--output", type=OutputFolder(), required=True, metavar="DIR", help="New or empty folder.")
def command(
    session: Session,
    geometry: Path,
    plan: str,
    only: tuple[str, ...],
    effects: tuple[str, ...],
    parameters: tuple[str, ...],
    draw: bool,
    seed: int,
    noise: float,
    double: bool,
    output: Path,
) -> None:
    """Simulate run files with known truth and chosen effects."""
    from dataclasses import replace

    from balance_cli.simulation import iterate_simulated_runs
    from balance_cli.simulation.noise import LARGEST_NOISE
    from balance_cli.simulation.rig import apply_effects

    if output.exists() and any(output.iterdir()):
        raise UserError("is not empty", str(output), remedy="Give a new or an empty folder")
    declared = session.geometry(geometry)
    if not noise <= LARGEST_NOISE:
        raise UserError(f"`{noise:g}` is not a factor up to {LARGEST_NOISE:g}", "--noise", remedy="Give 1 or so")
    runs = _load_plan(plan, only, declared)
    extra_effects, about = (
        _parse_effects(effects, parameters),
        {"geometry": declared.name, "seed": seed, "noise": noise},
    )
    level = replace(_noise_of(runs), single_precision=not double).scale_by(noise)
    try:
        rig = apply_effects(_make_true_rig(declared, draw, seed), (*declared.effects, *extra_effects))
        pairs = session.progress(iterate_simulated_runs(rig, runs, level, seed), "runs", total=len(runs.runs))
        summary = _write_campaign(session, output, rig, runs, pairs, about)
    except UserError as error:
        raise error.with_location(str(geometry)) from error
    session.finish(
        summary, [f"{plural(len(runs.runs), 'run')} of {declared.rig}, their truth in truth.yaml and truth.hdf5"]
    )


def _write_campaign(
    session: Session, output: Path, rig: TrueRig, plan: CampaignPlan, pairs: Iterable[Any], about: dict[str, Any]
) -> dict[str, Any]:
    """Prepare all files; returns the summary."""
    from balance_cli.campaign.recording.run_file import write_run
    from balance_cli.simulation.files import rig_to_dict, write_truth_arrays, write_truth_text

    truths, described = [], {}
    for run, truth in pairs:
        write_run(session.stage_in(output, f"{run.name}.h5"), run)
        truths.append(truth)
        described[run.name] = {"kind": run.kind, "samples": run.samples, "digest": run.digest}
    write_truth_arrays(session.stage_in(output, "truth.hdf5"), truths)
    write_truth_text(session.stage_in(output, "truth.yaml"), rig, about, plan)
    return {**about, "runs": described, "rig": rig_to_dict(rig)}


def _load_plan(plan: str, only: tuple[str, ...], geometry: Geometry) -> CampaignPlan:
    from balance_cli.simulation import campaign_plan
    from balance_cli.simulation.files import read_plan
    from balance_cli.simulation.preset_plans import PRESETS

    speed = geometry.rotor.speed if geometry.rotor else 17.5
    campaign = campaign_plan(plan, speed) if plan in PRESETS else read_plan(Path(plan))
    names = [run.run for run in campaign.runs]
    for name in only:
        if name not in names:
            raise UserError(f"the plan has no run `{name}`", "--only", remedy=f"It has {', '.join(names)}")
    return campaign.select_runs(only) if only else campaign


def _noise_of(plan: CampaignPlan) -> Noise:
    """The noise that the plan keeps, so that it can be rehearsed; else that of the recorded campaign."""
    from balance_cli.planning.channel_noise import PLANNED_SOURCE, planning_noise
    from balance_cli.simulation import Noise

    return planning_noise(plan.noise, (), 1.0, PLANNED_SOURCE) if plan.noise else Noise()


def _make_true_rig(geometry: Geometry, draw: bool, seed: int) -> TrueRig:
    from balance_cli.simulation import draw_rig, true_rig
    from balance_cli.simulation.truth import random_stream

    return draw_rig(geometry, random_stream(seed, "", "rig")) if draw else true_rig(geometry)


def _parse_effects(effects: tuple[str, ...], parameters: tuple[str, ...]) -> list[Extension]:
    """The effects of the command line with their parameters."""
    from balance_cli.simulation.extensions.library import extension

    values: dict[str, dict[str, str]] = {effect: {} for effect in effects}
    for text in parameters:
        place, name, value = _split_parameter(text)
        values[_effect_of_parameter(text, place, name, effects)][name] = value
    extensions = []
    for effect, given in values.items():
        name, _, places = effect.partition("@")
        try:
            extensions.append(extension(name, tuple(places.split(",")) if places else (), **given))
        except UserError as error:
            raise error.with_location("--effect") from error
    return extensions


def _split_parameter(text: str) -> tuple[str, str, str]:
    key, equals, value = text.partition("=")
    if not equals:
        raise UserError(f"`{text}` has no `=`", "--parameter", remedy="Write NAME=VALUE or EFFECT:NAME=VALUE")
    effect, _, name = key.rpartition(":")
    return effect, name, value


def _effect_of_parameter(text: str, place: str, name: str, effects: tuple[str, ...]) -> str:
    """The effect that a parameter belongs to: the one named, or the only one that has such a parameter."""
    from balance_cli.simulation.extensions.library import EXTENSIONS, parameter_names

    def has(effect: str) -> bool:
        kind = EXTENSIONS.get(_effect_name(effect))
        return kind is not None and name in parameter_names(kind)

    meant = [effect for effect in effects if place in (effect, _effect_name(effect))] if place else list(effects)
    meant = meant if len(meant) == 1 else [effect for effect in meant if has(effect)]
    if len(meant) == 1:
        return meant[0]
    fault = f"`{text}` belongs to {'more than one' if meant else 'no'} effect"
    known = f"Write EFFECT:NAME=VALUE; the effects are {', '.join(effects)}" if effects else "Give one with `--effect`"
    raise UserError(fault, "--parameter", remedy=known)


def _effect_name(effect: str) -> str:
    return effect.partition("@")[0]
