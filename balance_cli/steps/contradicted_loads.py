"""What contradicts loads: calibration against response, the cross-checks of their runs, and the runs of each other."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Iterable, Mapping

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.consistency.findings import STATIC_RESPONSE, ConsistencyFinding
from balance_cli.diagnosis.consistency.severity import contradicts_loads, leaves_loads_untested
from balance_cli.io.errors import UserError
from balance_cli.reduction.check_contradiction import flag_by_check_runs
from balance_cli.reduction.flags import MODEL_CONTRADICTED, UNTESTED
from balance_cli.reduction.mean_loads_nonlinear import ALL_TRIMS
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.result import RunLoads
from balance_cli.reduction.trim_signs import flag_opposite_means, opposite_means
from balance_cli.steps.static_agreement import static_findings
from balance_cli.steps.trim_agreement import trim_findings

STATIC_REMEDY = "Give calibration and response of the same rig in the same units and polarity"


def compare_static_response(
    calibration: Calibration | None, source: ResponseSource, geometry: Geometry, file: str = ""
) -> tuple[ConsistencyFinding, ...]:
    """Return the warnings about a calibration and the response, with its geometry, that runs are reduced by.

    Raises UserError, with the `file` of the response, where their static parts differ by more than any effect explains.
    """
    findings = static_findings(calibration, source, geometry)
    for finding in findings:
        if finding.is_fault:
            raise UserError(finding.sentence, file, "calibration", STATIC_REMEDY)
    named = {trim for finding in findings for trim in finding.trims}
    return (*findings, *(finding for finding in trim_findings(calibration) if not named & set(finding.trims)))


def flag_contradicted_runs(
    runs: Mapping[str, RunLoads], findings: Iterable[ConsistencyFinding]
) -> Mapping[str, RunLoads]:
    """Return the loads with those of runs flagged that contradict the geometry or the other runs.

    A factor of channels that all runs have is known to the calibration and the model, and changes no load. Where a trim
    contradicts the response, the runs whose mean loads rest on it, or on all trims, are flagged. More noise in all
    channels contradicts nothing: the residual test contains the noise of the run, and a factor of all is untested.
    """
    findings = tuple(findings)
    flagged: ChainMap[str, RunLoads] = ChainMap({}, runs)  # type: ignore[arg-type]  # which is only read
    for finding in findings:
        if finding.kind == STATIC_RESPONSE:
            runs_of_trim = [name for name, loads in runs.items() if loads.trim in (*finding.trims, ALL_TRIMS)]
            flagged.update({name: _note_contradiction(flagged[name], finding) for name in runs_of_trim})
        if not contradicts_loads(finding.kind, finding.in_all_runs, finding.factor):
            continue
        for name in set(finding.runs) & set(flagged):
            flagged[name] = _note_contradiction(flagged[name], finding)
    return flagged if flagged.maps[0] else runs


def compare_loads(
    runs: Mapping[str, RunLoads], calibration: Calibration | None, is_shard: bool = False
) -> tuple[Mapping[str, RunLoads], tuple[str, ...]]:
    """Compare the loads of wind runs with each other and with the trims, and those of check runs with the known ones.

    Return them flagged, and the warnings. Runs of a shard are compared with others when the shards are merged.
    """
    opposite = tuple(opposite_means(runs.values(), calibration))
    flagged, warnings = flag_opposite_means(runs, opposite), tuple(item.warning for item in opposite)
    if is_shard:
        return flagged, warnings
    flagged, compared = compare_with_other_runs(flagged)
    return flagged, (*warnings, *compared)


def compare_with_other_runs(runs: Mapping[str, RunLoads]) -> tuple[Mapping[str, RunLoads], tuple[str, ...]]:
    """Return the loads flagged by what wind runs say of each other, and check runs of all; and the warnings."""
    channels = (f"{loads.wrong_channels} in {name}" for name, loads in runs.items() if loads.wrong_channels)
    flagged, warnings = _compare_with_each_other(runs) if len(runs) > 1 else (runs, ())
    flagged, contradictions = flag_by_check_runs(flagged)
    return flagged, (*channels, *warnings, *(item.sentence for item in contradictions))


def _compare_with_each_other(runs: Mapping[str, RunLoads]) -> tuple[Mapping[str, RunLoads], tuple[str, ...]]:
    """Flag runs that are one record, and those whose harmonics are those of another one at another azimuth."""
    from balance_cli.reduction.copied_runs import copied_runs, copy_warning, flag_copied_runs
    from balance_cli.reduction.turned_harmonics import compare_wind_runs, flag_turned_runs, turn_warnings

    comparisons, copies = compare_wind_runs(runs), copied_runs(runs)
    flagged = flag_turned_runs(flag_copied_runs(runs, copies), comparisons)
    return flagged, (*map(copy_warning, copies), *turn_warnings(comparisons))


def _note_contradiction(loads: RunLoads, finding: ConsistencyFinding) -> RunLoads:
    flag = UNTESTED if leaves_loads_untested(finding.kind, finding.factor) else MODEL_CONTRADICTED
    return loads.with_flag(flag, finding.sentence)
