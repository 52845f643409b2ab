"""What a command says of its inputs: warnings, runs that are skipped or left out, gaps; on stderr and in the JSON."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from balance_cli.cli.labels import echo_message

if TYPE_CHECKING:
    from balance_cli.campaign.recording.run import Run


class Messages:
    """The messages of one call, printed at once and kept for its summary."""

    def __init__(self) -> None:
        self.warnings: list[str] = []
        self._skipped: dict[str, str] = {}
        self._left_out: dict[str, str] = {}
        self._gaps: dict[str, dict[str, dict[str, int]]] = {}
        self._hammer: dict[str, dict[str, Any]] = {}

    def warn(self, text: str) -> None:
        """Print a warning on stderr and add it to the summary."""
        self.warnings.append(text)
        self._echo_warning(text)

    @property
    def skipped(self) -> Mapping[str, str]:
        """The runs that were skipped {file: reason}."""
        return self._skipped

    def record_gaps(self, run: str, gaps: Mapping[str, Mapping[str, int]], text: str) -> None:
        """Record the bridged gaps of a run, if it has any, with a warning: `text` says what was bridged or left out."""
        if gaps:
            self._gaps[run] = {name: dict(counts) for name, counts in gaps.items()}
        if text:
            self.warn(f"{run}: {text}")

    def record_hammer(self, runs: Iterable[Run]) -> None:
        """Record the taps of hammer records, with a warning where some are not used."""
        from balance_cli.signals.impact import IMPACT, hammer_record

        for run in runs:
            record = hammer_record(run) if run.excitation == IMPACT else None
            if record is not None:
                self._hammer[run.name] = record.summary
                if record.note:
                    self.warn(f"{run.name}: {record.note}")

    def report_skipped(self, file: str, reason: str) -> None:
        """Report that a run is not used although the command goes on (`--skip-bad`)."""
        self._skipped[file] = reason
        self._echo_warning(f"skipped: {reason}")

    def report_left_out(self, name: str, reason: str) -> None:
        """Report that a run (or channel) was read but not used, and why."""
        self._left_out[name] = reason
        self._echo_warning(f"{name} left out: {reason}")

    def _echo_warning(self, text: str) -> None:
        echo_message("warning", text)
