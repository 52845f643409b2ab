"""What a command says of its inputs: warnings, runs that are skipped or left out, gaps; on stderr and in the JSON."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from balance_cli.cli.labels import echo_message
from balance_cli.io.run_messages import RunMessage, message_lines, messages_of_runs

if TYPE_CHECKING:
    from balance_cli.campaign.recording.run import Run


class Messages:
    """The messages of one call, printed at once and kept for its summary.

    Those on runs within `collect_messages()` are printed at its end, one line where the same is said of many runs; the
    summary has each of them.
    """

    def __init__(self) -> None:
        self.warnings: list[str] = []
        self._skipped: dict[str, str] = {}
        self._left_out: dict[str, str] = {}
        self._gaps: dict[str, dict[str, dict[str, int]]] = {}
        self._hammer: dict[str, dict[str, Any]] = {}
        self._gathered: list[RunMessage] | None = None

    @contextmanager
    def collect_messages(self) -> Iterator[None]:
        """Print what is said of runs within this context at its end, also where it ends with an error."""
        if self._gathered is not None:
            yield
            return
        self._gathered = []
        try:
            yield
        finally:
            messages, self._gathered = self._gathered, None
            for text in message_lines(messages):
                self._echo_warning(text)

    def warn(self, text: str) -> None:
        """Print a warning on stderr and add it to the summary."""
        self.warnings.append(text)
        self._echo_warning(text)

    def warn_of_run(self, run: str, text: str) -> None:
        """As `warn`, of one run: `text` contains its name."""
        self.warnings.append(text)
        self._report_of_run(run, text)

    def warn_of_runs(self, texts: Iterable[str], names: Collection[str]) -> None:
        """As `warn_of_run` for each text, by the first of the named runs that it contains; one line for many runs."""
        with self.collect_messages():
            for message in messages_of_runs(texts, names):
                self.warn_of_run(message.run, message.text)

    @property
    def skipped(self) -> Mapping[str, str]:
        """The runs that were skipped {file: reason}."""
        return self._skipped

    def record_gaps(self, run: str, gaps: Mapping[str, Mapping[str, int]], text: str) -> None:
        """Record the bridged gaps of a run, if it has any, with a warning: `text` says what was bridged or left out."""
        if gaps:
            self._gaps[run] = {name: dict(counts) for name, counts in gaps.items()}
        if text:
            self.warn_of_run(run, f"{run}: {text}")

    def record_hammer(self, runs: Iterable[Run]) -> None:
        """Record the taps of hammer records, with a warning where some are not used."""
        from balance_cli.signals.impact import IMPACT, hammer_record

        for run in runs:
            record = hammer_record(run) if run.excitation == IMPACT else None
            if record is not None:
                self._hammer[run.name] = record.summary
                if record.note:
                    self.warn_of_run(run.name, f"{run.name}: {record.note}")

    def report_skipped(self, file: str, reason: str) -> None:
        """Report that a run is not used although the command goes on (`--skip-bad`)."""
        self._skipped[file] = reason
        self._report_of_run(file, f"skipped: {reason}")

    def report_left_out(self, name: str, reason: str) -> None:
        """Report that a run (or channel) was read but not used, and why."""
        self.record_left_out(name, reason)
        self._report_of_run(name, f"{name} left out: {reason}")

    def record_left_out(self, name: str, reason: str) -> None:
        """Record for the summary that a run has no results of its own, of which nobody needs to be warned."""
        self._left_out[name] = reason

    def _report_of_run(self, run: str, text: str) -> None:
        if self._gathered is None:
            self._echo_warning(text)
        else:
            self._gathered.append(RunMessage(run, text))

    def _echo_warning(self, text: str) -> None:
        echo_message("warning", text)
