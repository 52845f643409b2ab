"""The cross-checks of the runs of a step: faults end it, warnings go with its result."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol, TypeVar

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.consistency.findings import COPIED_RECORD, ConsistencyFinding
from balance_cli.diagnosis.consistency.severity import ConsequenceRule, findings_for_command
from balance_cli.io.errors import UserError
from balance_cli.signals.nyquist_noise import UsualNoise

if TYPE_CHECKING:
    from balance_cli.estimation.measured_responses import MeasuredResponses

REMEDY = "Correct the files, or the geometry; `balance check -g GEOMETRY RUN...` lists everything"


class ChecksRuns(Protocol):
    """A result that keeps what the cross-checks said of the runs that it was made from."""

    @property
    def consistency(self) -> tuple[str, ...] | None:
        """The findings in words; None where there is none."""
        ...


Result = TypeVar("Result", bound=ChecksRuns)


def cross_check(
    geometry: Geometry, runs: Sequence[Run], is_harmless: ConsequenceRule, usual_noise: Sequence[UsualNoise] = ()
) -> tuple[ConsistencyFinding, ...]:
    """Cross-check the runs of a step, with the noise of sweeps made before, and return what is not a fault for it.

    Raises UserError for the first fault.
    """
    from balance_cli.diagnosis.consistency.campaign import campaign_findings  # a reduction compares nothing

    findings = findings_for_command(campaign_findings(geometry, runs, usual_noise), is_harmless)
    for finding in findings:
        if finding.is_fault:
            raise contradiction_error(finding, {run.name: run.file for run in runs})
    return findings


def cross_check_responses(
    geometry: Geometry, items: Sequence[MeasuredResponses], is_harmless: ConsequenceRule
) -> tuple[ConsistencyFinding, ...]:
    """Cross-check the measured responses of a step with a geometry with mechanics, as `cross_check` does."""
    if not items:
        return ()
    from balance_cli.steps.frf_checks import response_findings

    findings = response_findings([item.transfer for item in items], geometry, is_harmless)
    for finding in findings:
        if finding.is_fault:
            files = {response.run: item.file for item in items for response in item.transfer.responses}
            raise contradiction_error(finding, files)
    return findings


def contradiction_error(finding: ConsistencyFinding, paths: Mapping[str, str]) -> UserError:
    """Return the error of a finding that is a fault; `paths` {run: file}."""
    file = paths[finding.runs[0]] if len(finding.runs) == 1 else "RUN..."
    return UserError(finding.sentence, file, finding_place(finding), REMEDY)


def finding_place(finding: ConsistencyFinding) -> str:
    """Return the part of a run file, or the key of a geometry, that a finding is about."""
    if finding.kind == COPIED_RECORD:
        return "samples"
    if finding.components:
        return "loads"
    return "channels" if finding.channels else "geometry"


def keep_findings(result: Result, findings: Iterable[ConsistencyFinding]) -> Result:
    """Return a result that keeps what the cross-checks said of its runs, and of earlier ones."""
    sentences = tuple(dict.fromkeys((*(result.consistency or ()), *(finding.sentence for finding in findings))))
    return replace(result, consistency=sentences or None)  # type: ignore[type-var]


def earlier_warnings(*results: ChecksRuns | None) -> tuple[str, ...]:
    """Return what the cross-checks said when the results were made, each finding once."""
    texts = dict.fromkeys(text for result in results for text in (result and result.consistency) or ())
    return tuple(f"of the runs that calibration or response were made from: {text}" for text in texts)
