"""The files of a fit: runs, and measured frequency responses among them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from balance_cli.cli.common import Session
from balance_cli.io.formats import TRANSFER_FORMAT
from balance_cli.io.sniff import sniff_format

if TYPE_CHECKING:
    from balance_cli.campaign.recording.run import Run
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.estimation.measured_responses import MeasuredResponses
    from balance_cli.estimation.measured_spectra import Spectra
    from balance_cli.signals.run_spectrum import RunSpectrum


@dataclass(frozen=True)
class FittedFiles:
    """The runs of a fit and the measured responses among them."""

    runs: tuple[Run, ...]
    responses: tuple[MeasuredResponses, ...]

    @property
    def lines(self) -> tuple[RunSpectrum, ...]:
        """The lines of the responses."""
        from balance_cli.estimation.measured_responses import add_responses
        from balance_cli.estimation.measured_spectra import Spectra

        return add_responses(Spectra((), (), {}, {}), self.responses).lines


def read_fitted_files(session: Session, paths: Iterable[Path], geometry: Geometry, skip_bad: bool) -> FittedFiles:
    """Read runs and measured responses, and cross-check them with the geometry and each other.

    Raises UserError where they contradict each other or hold the same data.
    """
    from balance_cli.cli.consistency import require_consistent_runs
    from balance_cli.diagnosis.consistency.severity import identified_anyway
    from balance_cli.estimation.measured_responses import require_usable_responses

    run_paths, response_paths = split_files(paths)
    runs = session.runs(run_paths, geometry, skip_bad)
    responses = read_responses(session, response_paths)
    require_usable_responses(responses, runs, geometry)
    runs = require_consistent_runs(session, geometry, runs, skip_bad, identified_anyway)
    require_consistent_responses(session, geometry, responses)
    return FittedFiles(runs, responses)


def read_hold_out_files(
    session: Session, paths: Iterable[Path], geometry: Geometry, skip_bad: bool, fitted: FittedFiles
) -> FittedFiles:
    """Read the runs and responses of `--hold-out`. Raises UserError for data that are fitted, too."""
    from balance_cli.estimation.measured_responses import require_usable_responses

    run_paths, response_paths = split_files(paths)
    runs = session.runs(run_paths, geometry, skip_bad, role="hold-out", disjoint_from=fitted.runs)
    responses = read_responses(session, response_paths, role="hold-out")
    require_usable_responses((*fitted.responses, *responses), (*fitted.runs, *runs), geometry)
    return FittedFiles(runs, responses)


def fitted_spectra(session: Session, files: FittedFiles, geometry: Geometry, means: bool | None = None) -> Spectra:
    """Return the spectra of runs and responses, and list the runs that are not used."""
    from balance_cli.estimation.measured_responses import add_responses
    from balance_cli.estimation.measured_spectra import measured_spectra

    runs = session.progress(files.runs, "spectra", len(files.runs), False)
    spectra = add_responses(measured_spectra(runs, geometry, means), files.responses)
    for name, reason in spectra.unused.items():
        session.report_left_out(name, reason)
    return spectra


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
