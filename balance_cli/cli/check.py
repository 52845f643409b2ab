"""The command `balance check`: what each file is, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.consistency import check_findings, finding_summary
from balance_cli.cli.errors import EXIT_USER_ERROR
from balance_cli.cli.options import InputFile, ListedFile
from balance_cli.io.errors import UserError
from balance_cli.io.result_view import plural

if TYPE_CHECKING:
    from balance_cli.campaign.recording.run import Run
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.cli.file_check import FileFinding
    from balance_cli.diagnosis.consistency.findings import ConsistencyFinding


@balance_command("check")
@click.argument("files", type=ListedFile(), nargs=-1, required=True, metavar="FILE...")
@click.option("-g", "--geometry", type=InputFile(), metavar="GEOMETRY", help="Geometry that the files should match.")
def command(session: Session, files: tuple[Path, ...], geometry: Path | None) -> None:
    """Say what each file is and what is wrong with it.

    A file is known by its content: a geometry, a run file, a result of another command. All faults of a file are
    listed, channels that are dead or clipped among them. Exit status 2 where any file has a fault.

    With a geometry, by -g or among the files, the runs and point tables with known loads are also cross-checked as a
    campaign: units, signs, exchanged channels and loads, stiffness, the position of the hub.
    """
    from balance_cli.cli.file_check import check_file
    from balance_cli.model.balance import check_effects

    rig = None if geometry is None else session.geometry(geometry, mechanics=False)
    if rig is not None:
        check_effects(rig, str(geometry))
    findings = {path: check_file(path, rig) for path in session.progress(files, "files")}
    runs = _runs_of_rig(findings, rig)
    consistency = _cross_check(findings, rig, runs)
    faults = {
        path: [*finding.faults, *_duplicate_name_faults(path, findings), *_campaign_faults(runs[path], consistency)]
        for path, finding in findings.items()
    }
    faulty = sum(bool(file_faults) for file_faults in faults.values())
    session.status = EXIT_USER_ERROR if faulty else 0
    lines = [line for path in findings for line in (f"{path}: {findings[path].about}", *_fault_lines(faults[path]))]
    for item in consistency:
        if not item.is_fault:
            session.warn(item.sentence)
    session.extra_summary["consistency"] = [finding_summary(item) for item in consistency]
    session.finish(
        {"files": {str(path): _summary(findings[path], faults[path]) for path in findings}, "faulty": faulty},
        [*lines, f"{plural(len(findings), 'file')}, {faulty} with faults"],
    )


def _declared_geometry(findings: Mapping[Path, FileFinding], geometry: Geometry | None) -> Geometry | None:
    """The given geometry, or the only one among the files."""
    declared = [finding.geometry for finding in findings.values() if finding.geometry is not None]
    if geometry is None and len({item.model_dump_json() for item in declared}) == 1:
        return declared[0]
    return geometry


def _runs_of_rig(findings: Mapping[Path, FileFinding], given: Geometry | None) -> dict[Path, tuple[Run, ...]]:
    """The runs of each file that can be compared with others: a run file, or a point table with loads."""
    from balance_cli.cli.file_check import POINT_TABLE, runs_of_point_table

    geometry = _declared_geometry(findings, given)
    runs: dict[Path, tuple[Run, ...]] = dict.fromkeys(findings, ())
    for path, finding in findings.items():
        if geometry is not None and finding.kind == POINT_TABLE and not finding.faults:
            runs[path] = runs_of_point_table(path, geometry)
        elif finding.run is not None:
            runs[path] = (finding.run,)
    return runs


def _cross_check(
    findings: Mapping[Path, FileFinding], given: Geometry | None, runs: Mapping[Path, tuple[Run, ...]]
) -> tuple[ConsistencyFinding, ...]:
    """Findings of the runs as a campaign, by the geometry; none without one."""
    geometry = _declared_geometry(findings, given)
    if geometry is None:
        return ()
    of_rig: dict[str, Run] = {}
    for path, of_file in runs.items():
        for run in of_file:
            if run.rig == geometry.rig and not findings[path].is_unreadable:
                of_rig.setdefault(run.name, run)
    return check_findings(geometry, tuple(of_rig.values()))


def _campaign_faults(runs: Sequence[Run], consistency: Sequence[ConsistencyFinding]) -> list[UserError]:
    """The faults that concern the runs of a file; what all runs show is said of the first of them."""
    from balance_cli.steps.cross_checks import finding_place

    names = {run.name for run in runs}
    return [
        UserError(item.sentence, place=finding_place(item), remedy="Correct the files, or the geometry")
        for item in consistency
        if item.is_fault and names & set(item.runs[:1] if item.in_all_runs else item.runs)
    ]


def _duplicate_name_faults(path: Path, findings: Mapping[Path, FileFinding]) -> list[UserError]:
    """A fault where an earlier file has the same run name."""
    finding = findings[path]
    if finding.kind != "run" or not finding.name:
        return []
    first = next(file for file, earlier in findings.items() if (earlier.kind, earlier.name) == ("run", finding.name))
    if first == path:
        return []
    return [UserError(f"{first} has the same run name, `{finding.name}`", str(path), "run", "Rename one of them")]


def _fault_lines(faults: list[UserError]) -> list[str]:
    return [f"  fault: {replace(fault, file='')}" for fault in faults]


def _summary(finding: FileFinding, faults: list[UserError]) -> dict[str, Any]:
    identity = {"kind": finding.kind, "about": finding.about, "name": finding.name, "rig": finding.rig}
    listed = [{"place": fault.place, "fault": fault.fault, "remedy": fault.remedy} for fault in faults]
    run_kind = {"run_kind": finding.run_kind} if finding.run_kind else {}
    return {**identity, **run_kind, "digest": finding.digest, "faults": listed}
