"""The loop of `balance watch`: takes files as they become whole, and keeps loads, page and journal."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from balance_cli.cli.common import Session
from balance_cli.cli.errors import internal_error_text
from balance_cli.cli.load_text import load_lines, trust_line
from balance_cli.cli.pipeline.state import signature
from balance_cli.cli.watching.folder import WatchedFolder
from balance_cli.cli.watching.journal import LEFT_OUT, REDUCED, SKIPPED, JournalEntry, append_entry, read_entries
from balance_cli.cli.watching.page import write_page
from balance_cli.cli.watching.quick_look import NoRotorLoadsError, QuickLook
from balance_cli.io.artefacts import load_artefact, save_artefact
from balance_cli.io.errors import UserError
from balance_cli.io.formats import LOADS_FORMAT
from balance_cli.io.result_view import plural
from balance_cli.reduction.result import HubLoads
from balance_cli.reduction.run_verdict import run_verdict

LOADS_NAME, JOURNAL_NAME, PAGE_NAME = "loads.h5", "journal.jsonl", "page.html"
RESULT_NAMES = (LOADS_NAME, JOURNAL_NAME, PAGE_NAME)
WRITING_INTERVAL = 2.0
"""[s] between two pages while many files wait: a page takes longer than the reduction of a run."""
PATIENCE = 10.0
"""[s]. A program that records into a file may pause for so long between blocks of samples."""


@dataclass
class Watch:
    """One call: the folder, the loads so far, and the files in which they are kept.

    A file that cannot be used counts as skipped when it has not changed for `patience` [s].
    """

    session: Session
    folder: WatchedFolder
    quick_look: QuickLook
    output: Path
    page_runs: int
    patience: float = PATIENCE
    results: dict[str, str] = field(default_factory=dict)

    @property
    def counts(self) -> dict[str, int]:
        """How many files had each result."""
        return {word: list(self.results.values()).count(word) for word in (REDUCED, LEFT_OUT, SKIPPED)}

    def loop(self, every: float, once: bool, idle: float | None) -> None:
        """Take files until the call is to end."""
        last_new = time.monotonic()
        while True:
            if self._take(self.folder.poll()):
                last_new = time.monotonic()
            if once and not self.folder.has_changing_files():
                return
            if idle is not None and time.monotonic() - last_new > idle:
                return
            time.sleep(every)

    def restore(self) -> None:
        """Take over what an earlier call into the same folder has done with the same response."""
        inputs = self._inputs_digest()
        entries = {entry.file: entry for entry in read_entries(self.output / JOURNAL_NAME) if entry.inputs == inputs}
        reduced = {entry.run: self.folder.path / entry.file for entry in entries.values() if entry.result == REDUCED}
        path = self.output / LOADS_NAME
        if reduced and path.is_file():
            zero_of = {entry.run: entry.zero for entry in entries.values() if entry.zero is not None}
            self.quick_look.restore(load_artefact(path, {LOADS_FORMAT: HubLoads}), reduced, zero_of)
        for entry in entries.values():
            if entry.result != REDUCED or entry.run in self.quick_look.runs:
                self.folder.known[self.folder.path / entry.file] = entry.stamp
                self.results[entry.file] = entry.result
        zeros = [entry for entry in entries.values() if entry.kind == "zero" and entry.result == LEFT_OUT]
        for entry in sorted(zeros, key=lambda entry: entry.modified):
            self._restore_zero(self.folder.path / entry.file)
        self.quick_look.find_outdated()
        self._take_outdated()

    def _restore_zero(self, path: Path) -> None:
        """Take over a zero run; one that cannot be read is examined again."""
        try:
            self.quick_look.restore_zero(path)
        except UserError:
            self.folder.mark_not_done(path)

    def _take_outdated(self) -> None:
        """Let the runs that have another zero now be reduced again."""
        for path in self.quick_look.outdated:
            self.folder.mark_not_done(path)
        self.quick_look.outdated.clear()

    def summary(self) -> dict[str, Any]:
        """Return the keys `files` {file: result}, `loads` and `page` (null where no run was reduced)."""
        paths = {"loads": self.output / LOADS_NAME, "page": self.output / PAGE_NAME}
        return {"files": self.results} | {name: path if path.is_file() else None for name, path in paths.items()}

    def text(self) -> list[str]:
        """Return what became of the files, in a line."""
        counts = ", ".join(f"{count} {word}" for word, count in self.counts.items() if count)
        return [f"{plural(len(self.results), 'file')}: {counts or 'nothing'}"]

    def _inputs_digest(self) -> str:
        """Return the digest of response, calibration, options and version: what the loads depend on beside the run."""
        provenance = self.session.provenance()
        options = [f"{name}={value}" for name, value in provenance.options.items() if name in ("harmonics",)]
        return signature(options, sorted(f"{item.role} {item.digest}" for item in provenance.inputs))

    def _take(self, ready: tuple[Path, ...]) -> bool:
        """Examine files, and write loads, page and journal, at least every WRITING_INTERVAL; return if any is done."""
        done = False
        waiting: list[JournalEntry] = []
        last = time.monotonic()
        for path in ready:
            entries = self._examine(path)
            done, waiting = done or bool(entries), [*waiting, *entries]
            if time.monotonic() - last > WRITING_INTERVAL:
                self._write(waiting)
                waiting, last = [], time.monotonic()
        if waiting:
            self._write(waiting)
        return done

    def _examine(self, path: Path) -> tuple[JournalEntry, ...]:
        """Reduce the run of a file, and return its entry for the journal; none where the file may not be whole yet."""
        stamp = self.folder.mark_done(path)
        now = datetime.now(UTC).isoformat(timespec="seconds")
        identity = (now, path.name, stamp.size, stamp.modified, self._inputs_digest())
        try:
            loads, warnings = self.quick_look.add_file(path)
            verdict, numbers = run_verdict(loads).sentence, self.quick_look.summarize(loads)
        except NoRotorLoadsError as other:
            entry = JournalEntry(*identity, LEFT_OUT, other.run, other.kind, reason=str(other))
        except UserError as error:
            if self.folder.seconds_unchanged(path) < self.patience:
                self.folder.mark_not_done(path)
                return ()
            entry = JournalEntry(*identity, SKIPPED, reason=str(error))
        except Exception as error:  # one run must not end the watch of a campaign
            entry = JournalEntry(*identity, SKIPPED, reason=internal_error_text(error))
        else:
            entry = replace(
                JournalEntry(*identity, REDUCED, loads.run, loads.kind),
                verdict=verdict,
                flags=loads.flag_counts,
                warnings=warnings,
                loads=numbers,
                zero=self.quick_look.zero_of.get(loads.run),
            )
        self._take_outdated()
        self.results[path.name] = entry.result
        self._show(entry)
        return (entry,)

    def _show(self, entry: JournalEntry) -> None:
        """Report what became of a file, with the loads of its run."""
        if entry.result == SKIPPED:
            self.session.report_skipped(entry.file, entry.reason)
        elif entry.result == LEFT_OUT and entry.kind == "zero":
            self.session.echo(f"{entry.file}: {entry.reason}")
            self.session.record_left_out(entry.file, entry.reason)
        elif entry.result == LEFT_OUT:
            self.session.report_left_out(entry.file, entry.reason)
        else:
            self.session.echo(f"{entry.file}: {entry.verdict}")
            loads = self.quick_look.runs[entry.run]
            for line in (*load_lines(loads, self.quick_look.reduction.geometry), trust_line(loads)):
                self.session.echo(line)

    def _write(self, entries: list[JournalEntry]) -> None:
        """Write loads and page, then the journal: after an interruption in between, the runs are reduced again."""
        if self.quick_look.is_changed:
            loads = self.quick_look.hub_loads()
            save_artefact(self.output / LOADS_NAME, LOADS_FORMAT, loads, self.quick_look.provenance())
            write_page(self.output / PAGE_NAME, self.quick_look, self.page_runs)
            self.quick_look.is_changed = False
        for entry in entries:
            seconds = time.time() - entry.modified / 1e9
            append_entry(self.output / JOURNAL_NAME, replace(entry, seconds=round(seconds, 3)))
