"""`balance run`: the whole chain on one campaign."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.errors import EXIT_RUNS_SKIPPED, EXIT_USER_ERROR
from balance_cli.cli.options import InputFile, InputFolder, OutputFolder, band_option
from balance_cli.io.errors import UserError
from balance_cli.io.formats import CALIBRATION_FORMAT, MODEL_FORMAT
from balance_cli.io.result_view import plural

if TYPE_CHECKING:
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.cli.pipeline.execution import Execution, Outcome
    from balance_cli.cli.pipeline.inventory import Inventory


@balance_command("run")
@click.argument("campaign", type=InputFolder(), metavar="CAMPAIGN")
@click.option("-g", "--geometry", type=InputFile(), metavar="GEOMETRY", help="Geometry, if it is not in CAMPAIGN.")
@click.option("--model", type=InputFile(), metavar="MODEL", help="A model made before; its loads are the first choice.")
@click.option("--calibration", type=InputFile(), metavar="CAL", help="A static calibration made before.")
@band_option("Identify and diagnose with lines within this band only [Hz], for a rig that has modes above its model.")
@click.option(
    "-j", "--jobs", metavar="N", type=click.IntRange(1, 64), default=1, show_default=True, help="Steps done at a time."
)
@click.option("-n", "--dry-run", is_flag=True, help="Only list the steps and their commands; nothing is written.")
@click.option("-o", "--output", type=OutputFolder(), required=True, metavar="RESULTS", help="Folder of the results.")
def command(
    session: Session,
    campaign: Path,
    geometry: Path | None,
    model: Path | None,
    calibration: Path | None,
    band: tuple[float, float] | None,
    jobs: int,
    dry_run: bool,
    output: Path,
) -> None:
    """Run the whole chain: from run files to hub loads and a page.

    CAMPAIGN is a folder with run files (*.h5), or with folders of them, and a geometry (geometry.yaml or geometry.yml).
    Steps that the rig or the runs do not allow are left out and named. A step is done again only if the content of its
    inputs changed; after an interruption the same call resumes where it stopped. The messages of a step are in
    RESULTS/logs.

    The output ends with the loads of each run by the best response, and a verdict on each run.
    """
    from balance_cli.cli.pipeline.execution import Execution
    from balance_cli.cli.pipeline.folder import locked_folder, require_own_results, write_input_list
    from balance_cli.cli.pipeline.inventory import take_inventory
    from balance_cli.cli.pipeline.state import load_state
    from balance_cli.cli.pipeline.steps import plan_steps

    if output.resolve() == campaign.resolve():
        raise UserError("is the campaign itself", str(output), remedy="Give another folder, for example one in it")
    state = load_state(output)
    inventory = take_inventory(campaign, geometry, state)
    inventory = replace(inventory, given=_given_artefacts(session, inventory.geometry, model, calibration))
    for path, reason in inventory.left_out.items():
        session.report_left_out(str(path), reason)
    plan = plan_steps(inventory, output, band)
    require_own_results(output, plan, state)
    show = _ProgressLines(session, len(plan.steps))
    execution = Execution(plan, output, state, inventory.digests, jobs, show.outcome, session.working)
    for name, reason in plan.left_out.items():
        session.echo(f"left out: {name}: {reason}")
    if dry_run:
        execution.preview()
        session.finish({"dry_run": True, **_summary(execution, inventory)})
        return
    with locked_folder(output):
        write_input_list(output, inventory)
        execution.run()
    _finish(session, execution, inventory)


def _given_artefacts(
    session: Session, geometry: Geometry, model: Path | None, calibration: Path | None
) -> dict[str, tuple[Path, str]]:
    """Return the artefacts that were made before {role: (path, digest)}; UserError where one is of another rig."""
    from balance_cli.calibration.result import Calibration
    from balance_cli.estimation.identified_model import IdentifiedModel

    types: dict[str, tuple[Path | None, str, type[Any]]] = {
        "model": (model, MODEL_FORMAT, IdentifiedModel),
        "calibration": (calibration, CALIBRATION_FORMAT, Calibration),
    }
    given = {}
    for role, (path, form, content) in types.items():
        if path is None:
            continue
        artefact = session.artefact(path, {form: content}, role)
        if artefact.content.geometry.rig != geometry.rig:
            fault = f"is of rig `{artefact.content.geometry.rig}`, the campaign of `{geometry.rig}`"
            raise UserError(fault, str(path), "rig", f"Give a {role} of this rig")
        given[role] = (path, artefact.digest)
    return given


class _ProgressLines:
    """Prints a line for each step."""

    def __init__(self, session: Session, total: int) -> None:
        self._session, self._total, self._done = session, total, 0

    def outcome(self, outcome: Outcome) -> None:
        """Print what became of a step."""
        self._done += 1
        line = f"[{self._done:>2}/{self._total}] {outcome.step:20} {outcome.result}"
        if outcome.seconds and not outcome.detail:
            line += f" in {outcome.seconds:.1f} s"
        if outcome.detail:
            line += f": {outcome.detail}"
        if outcome.warnings:
            line += f" ({plural(outcome.warnings, 'warning')}, see logs/{outcome.step}.txt)"
        self._session.echo(line)


def _finish(session: Session, execution: Execution, inventory: Inventory) -> None:
    """Set summary, text and exit status: that of the worst step, or 4 where only files were left out."""
    from balance_cli.cli.pipeline.loads import best_loads, loads_summary, loads_text, spectra_lines

    loads = best_loads(execution.results, execution.made)
    summary = {**_summary(execution, inventory), **loads_summary(loads)}
    statuses = [outcome.status for outcome in execution.outcomes.values() if outcome.result == "failed"]
    if statuses:
        session.status = EXIT_USER_ERROR if set(statuses) == {EXIT_USER_ERROR} else 1
    elif inventory.left_out or any(outcome.status == EXIT_RUNS_SKIPPED for outcome in execution.outcomes.values()):
        session.status = EXIT_RUNS_SKIPPED
    session.finish(summary, [*loads_text(loads), *spectra_lines(execution.results, execution.made)])


def _summary(execution: Execution, inventory: Inventory) -> dict[str, Any]:
    from balance_cli.cli.pipeline.execution import summary

    return {
        "geometry": inventory.geometry_path,
        "campaign_runs": {kind: [run.name for run in runs] for kind, runs in inventory.runs.items()},
        "steps": summary(execution.outcomes),
        "steps_left_out": execution.plan.left_out,
    }
