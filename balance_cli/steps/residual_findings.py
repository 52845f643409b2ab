"""Whether a calibration describes its own loads, as a finding that its artefact keeps and later commands repeat."""

from __future__ import annotations

from balance_cli.calibration.large_residual import describe_large_residuals, large_residuals
from balance_cli.calibration.result import Calibration
from balance_cli.diagnosis.consistency.findings import LARGE_RESIDUAL, WARNING, ConsistencyFinding


def residual_findings(calibration: Calibration) -> tuple[ConsistencyFinding, ...]:
    """Return a warning where back-calculated loads are far from the applied ones, beyond what repetitions scatter."""
    large = large_residuals(calibration.all_trims)
    if not large:
        return ()
    names = tuple(each.component for each in large)
    return (ConsistencyFinding(LARGE_RESIDUAL, WARNING, describe_large_residuals(large), components=names),)
