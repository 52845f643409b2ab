"""The cross-checks of a campaign in the commands: faults end a command (or skip a run), the rest are warnings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from balance_cli.cli.common import Session

if TYPE_CHECKING:
    from pathlib import Path

    from balance_cli.calibration.result import Calibration
    from balance_cli.campaign.recording.run import Run
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.diagnosis.consistency.findings import ConsistencyFinding
    from balance_cli.diagnosis.consistency.severity import ConsequenceRule
    from balance_cli.reduction.response_sources import ResponseSource
    from balance_cli.reduction.result import RunLoads
    from balance_cli.signals.nyquist_noise import UsualNoise
    from balance_cli.steps.cross_checks import ChecksRuns

Result = TypeVar("Result", bound="ChecksRuns")


def require_consistent_runs(
    session: Session,
    geometry: Geometry,
    runs: tuple[Run, ...],
    skip_bad: bool,
    is_harmless: ConsequenceRule,
    usual_noise: Sequence[UsualNoise] = (),
) -> tuple[Run, ...]:
    """Cross-check the runs of a command, with the noise of sweeps made before, and return those that it may use.

    Raises UserError for a fault; with `skip_bad` the runs that show it are skipped, unless all runs do.
    """
    from balance_cli.diagnosis.consistency.campaign import campaign_findings

    paths = {run.name: run.file for run in runs}
    bad = inconsistent_runs(session, campaign_findings(geometry, runs, usual_noise), paths, skip_bad, is_harmless)
    with session.collect_messages():
        for name, reason in bad.items():
            session.report_skipped(paths[name], f"{paths[name]}: {reason}")
    return tuple(run for run in runs if run.name not in bad)


def inconsistent_runs(
    session: Session,
    findings: Sequence[ConsistencyFinding],
    paths: dict[str, str],
    skip_bad: bool,
    is_harmless: ConsequenceRule,
) -> dict[str, str]:
    """Report the findings on the runs {name: path} of a command, and return {name: reason} of those to be skipped.

    Raises UserError for a fault; with `skip_bad` the runs that show it are returned, unless all runs do.
    """
    from balance_cli.diagnosis.consistency.severity import findings_for_command
    from balance_cli.steps.cross_checks import contradiction_error

    findings = (*session.response_findings, *findings_for_command(findings, is_harmless))
    session.findings = findings
    session.extra_summary["consistency"] = [finding_summary(finding) for finding in findings]
    bad: dict[str, str] = {}
    with session.collect_messages():
        for finding in findings:
            if not finding.is_fault:
                _warn_of_finding(session, finding)
            elif finding.in_all_runs or not skip_bad or len(bad) == len(paths):
                raise contradiction_error(finding, paths)
            else:
                bad.update(dict.fromkeys(finding.runs, finding.sentence))
    return bad


def _warn_of_finding(session: Session, finding: ConsistencyFinding) -> None:
    if len(finding.runs) == 1:
        session.warn_of_run(finding.runs[0], finding.sentence)
    else:
        session.warn(finding.sentence)


def report_findings(session: Session, findings: Sequence[ConsistencyFinding]) -> None:
    """Warn of findings on a result, and add them to those of its runs."""
    session.findings = (*session.findings, *findings)
    if findings:
        session.extra_summary["consistency"] = [finding_summary(finding) for finding in session.findings]
    for finding in findings:
        session.warn(finding.sentence)


def finding_summary(finding: ConsistencyFinding) -> dict[str, Any]:
    """Return the JSON summary of a finding, with the keys of docs/json.md."""
    return {
        "kind": finding.kind,
        "severity": finding.severity,
        "text": finding.sentence,
        "runs": finding.runs,
        "in_all_runs": finding.in_all_runs,
        "channels": finding.channels,
        "components": finding.components,
        "cells": finding.cells,
        "factor": finding.factor,
        "hub": finding.position,
    }


def check_findings(geometry: Geometry, runs: Sequence[Run]) -> tuple[ConsistencyFinding, ...]:
    """Return the findings for `balance check`, which judges the files for any use."""
    from balance_cli.diagnosis.consistency.campaign import campaign_findings

    return campaign_findings(geometry, runs)


def with_findings(session: Session, result: Result) -> Result:
    """Return a result that keeps what the cross-checks of this command said of its runs, and of earlier ones."""
    from balance_cli.steps.cross_checks import keep_findings

    return keep_findings(result, session.findings)


def repeat_findings(session: Session, *results: ChecksRuns | None) -> None:
    """Warn of what the cross-checks said when the results were made, each finding once."""
    from balance_cli.steps.cross_checks import earlier_warnings

    for text in earlier_warnings(*results):
        session.warn(text)


def compare_static_response(
    session: Session, calibration: Calibration | None, source: ResponseSource, geometry: Geometry, path: Path
) -> None:
    """Keep what contradicts in a calibration and the response from `path`; UserError where the difference is gross."""
    from balance_cli.steps import contradicted_loads

    session.response_findings = contradicted_loads.compare_static_response(calibration, source, geometry, str(path))


def flag_contradicted_runs(session: Session, runs: Mapping[str, RunLoads]) -> Mapping[str, RunLoads]:
    """Return the loads with those of runs flagged that contradict the geometry or the other runs."""
    from balance_cli.steps import contradicted_loads

    return contradicted_loads.flag_contradicted_runs(runs, session.findings)
