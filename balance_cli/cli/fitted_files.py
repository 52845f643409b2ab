"""The files of a fit: runs, and measured frequency responses among them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from balance_cli.cli.common import Session
from balance_cli.io.formats import TRANSFER_FORMAT
from balance_cli.io.sniff import sniff_format

if TYPE_CHECKING:
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.estimation.measured_responses import MeasuredResponses


def split_files(paths: Iterable[Path]) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Return the paths of runs, and those of files with measured responses, which are told by their content."""
    paths = tuple(paths)
    responses = tuple(path for path in paths if sniff_format(path) == TRANSFER_FORMAT)
    return tuple(path for path in paths if path not in responses), responses


def read_responses(session: Session, paths: Sequence[Path], role: str = "transfer") -> tuple[MeasuredResponses, ...]:
    """Read files with measured responses, and record them as inputs with this role."""
    from balance_cli.cli.consistency import repeat_findings
    from balance_cli.estimation.measured_responses import RUN_ROLES, MeasuredResponses
    from balance_cli.signals.response.transfer import Transfer

    items = []
    for path in paths:
        artefact = session.artefact(path, {TRANSFER_FORMAT: Transfer}, role)
        transfer: Transfer = artefact.content
        sources = frozenset(
            entry.digest
            for entry in artefact.provenance.inputs
            if entry.role in RUN_ROLES and entry.name not in transfer.unused_runs
        )
        items.append(MeasuredResponses(transfer, str(path), sources))
        repeat_findings(session, transfer)
    return tuple(items)


def require_consistent_responses(session: Session, geometry: Geometry, items: Sequence[MeasuredResponses]) -> None:
    """Cross-check measured responses with the geometry, and warn of what their sigma does not contain.

    Raises UserError for a fault, after the runs of the command have been checked.
    """
    if not items:
        return
    from balance_cli.cli.consistency import report_findings
    from balance_cli.diagnosis.consistency.severity import identified_anyway
    from balance_cli.estimation.measured_responses import response_warnings
    from balance_cli.steps.cross_checks import cross_check_responses

    report_findings(session, cross_check_responses(geometry, items, identified_anyway))
    for text in response_warnings(items):
        session.warn(text)
