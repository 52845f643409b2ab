"""`balance reduce` over any number of runs: survey, reduction, comparison of the runs, and what is skipped."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from balance_cli.campaign.recording.run_file import duplicate_run_error, open_matching_run
from balance_cli.campaign.rig.geometry_checks import missing_mechanics
from balance_cli.cli.batch import work
from balance_cli.cli.batch.executors import batch_workers
from balance_cli.cli.batch.journal import Journal, journal_path
from balance_cli.cli.batch.kept_surveys import KeptSurveys
from balance_cli.cli.batch.options import BatchOptions
from balance_cli.cli.batch.ordered import WorkerPool, worker_pool
from balance_cli.cli.batch.work import ROTOR_KINDS, Item, RunResult, RunSurvey
from balance_cli.cli.common import Session
from balance_cli.cli.consistency import inconsistent_runs
from balance_cli.cli.errors import EXIT_RUNS_SKIPPED
from balance_cli.cli.reduce_inputs import read_zero
from balance_cli.cli.reduce_runs import Reduction, check_name
from balance_cli.diagnosis.consistency.findings import ConsistencyFinding
from balance_cli.diagnosis.consistency.noise_levels import compare_noise
from balance_cli.diagnosis.consistency.severity import known_anyway
from balance_cli.io.atomic import os_errors_as_user_error
from balance_cli.io.errors import UserError
from balance_cli.io.stored_mapping import StoredMapping
from balance_cli.io.version import __version__
from balance_cli.reduction.result import RunLoads
from balance_cli.signals.nyquist_noise import RunNoise
from balance_cli.signals.response_rows import ResponseRows
from balance_cli.steps.reduction_inputs import default_harmonics, fewer_harmonics_warning

FEWEST_JOURNALED = 8
"""Runs from which a journal is kept; fewer are reduced again in a second."""


@dataclass
class BatchReduction:
    """The reduction of the runs of one call.

    `skips`: whether runs that cannot be used are listed and left out, or end the call.
    """

    session: Session
    options: BatchOptions
    skips: bool
    surveys: dict[Path, RunSurvey] = field(default_factory=dict)
    loads: StoredMapping[RunLoads] = field(default_factory=StoredMapping)
    rows: list[ResponseRows] = field(default_factory=list)
    levels: dict[str, tuple[float, ...]] = field(default_factory=dict)
    noise: list[RunNoise] = field(default_factory=list)
    paths: dict[str, str] = field(default_factory=dict)
    errors: dict[Path, UserError] = field(default_factory=dict)
    histories: list[Path] = field(default_factory=list)
    zero_digests: tuple[str, ...] = ()

    def reduce(
        self, reduction: Reduction, paths: tuple[Path, ...], zero: Path | None, output: Path
    ) -> tuple[Reduction, Mapping[str, RunLoads]]:
        """Return the reduction with its zero, and the loads of the check and wind runs by name.

        Raises UserError where no run is left, and for the first bad run unless bad runs are skipped.
        """
        with worker_pool(batch_workers(self.options.jobs, self.options.executor)) as pool:
            with self.session.collect_messages():
                self._survey(pool, reduction, paths)
            reduction = self._complete(reduction, zero)
            with self.session.collect_messages():
                self._reduce_runs(pool, reduction, output)
                self._finish(reduction)
        if not self.loads:
            raise self._all_skipped()
        if self.session.skipped and not self.options.skip_bad:
            self.session.status = EXIT_RUNS_SKIPPED
        return reduction, self.loads

    def _survey(self, pool: WorkerPool, reduction: Reduction, paths: tuple[Path, ...]) -> None:
        """Learn the kind of every run, and require names to be unique."""
        inputs = [(item.role, item.digest) for item in self.session.provenance().inputs]
        stored = KeptSurveys(self.options.survey, [inputs, reduction.method.rotor])
        known, data = stored.find_all(paths), work.pickle_reduction(reduction)
        results = pool.results(work.survey_run, (Item(path, data) for path in paths if path not in known))
        by_name: dict[str, Path] = {}
        for path in self.session.progress(paths, "reading", len(paths)):
            survey = known.get(path) or next(results)[1]
            if not isinstance(survey, UserError):
                first = by_name.setdefault(survey.name, path)
                survey = survey if first is path else self._duplicate(reduction, path, first)
            if isinstance(survey, UserError):
                self._skip(path, survey)
            else:
                self.surveys[path] = survey
        if not self.surveys:
            raise self._all_skipped()
        stored.keep(self.surveys)
        for survey in self.surveys.values():
            if survey.kind not in (*ROTOR_KINDS, "zero"):
                self.session.report_left_out(survey.name, f"a {survey.kind} run contains no rotor loads")
        if not any(survey.kind in ROTOR_KINDS for survey in self.surveys.values()):
            remedy = "Give the runs that are to be reduced"
            raise UserError("no check or wind run among the runs", "RUN...", remedy=remedy)

    def _duplicate(self, reduction: Reduction, path: Path, first: Path) -> UserError:
        """Return the error of a second run of one name. Raises it where the two runs differ: neither is the right one.

        A copy is skipped like a bad run.
        """
        runs = [open_matching_run(item, reduction.geometry) for item in (path, first)]
        error = duplicate_run_error(*runs)
        if runs[0].digest != runs[1].digest:
            raise error
        return error

    def _complete(self, reduction: Reduction, zero: Path | None) -> Reduction:
        """Return the reduction with what is the same for all runs: the wind-off record, and what is compared."""
        zeros = [path for path, survey in self.surveys.items() if survey.kind == "zero"] if zero is None else []
        records = tuple(open_matching_run(path, reduction.geometry) for path in zeros)
        self.zero_digests = tuple(run.digest for run in records)
        rotating = [path for path, survey in self.surveys.items() if survey.kind in ROTOR_KINDS]
        # A wind run shows best whether the zero was made under load.
        first = min(rotating, key=lambda path: (self.surveys[path].kind != "wind", self.surveys[path].name))
        shown = open_matching_run(first, reduction.geometry)
        record = read_zero(self.session, reduction.calibration, zero, records, shown)
        comparable = any(survey.kind not in ("wind", "zero") for survey in self.surveys.values())
        compares = comparable and not missing_mechanics(reduction.geometry)
        return replace(reduction, zero=record, compare_runs=compares)

    def _reduce_runs(self, pool: WorkerPool, reduction: Reduction, output: Path) -> None:
        selection = [path for path in self._shard() if self._may_have_history(path, reduction)]
        with self._journal(reduction, output, len(selection)) as journal:
            data = work.pickle_reduction(reduction)
            done = {path for path in selection if self._is_done(path, journal, reduction)}
            if done:
                self.session.echo(f"{len(done)} of {len(selection)} runs were reduced before an interruption")
            items = {path: self._item(path, reduction, data, journal) for path in selection}
            rest = (items[path] for path in selection if path not in done)
            results = pool.results(work.reduce_file, rest)
            for path in self.session.progress(selection, "runs", len(selection)):
                stored = journal.find(path) if journal is not None and path in done else None
                item, result = (items[path], stored) if stored is not None else next(results)
                self._keep_history(item, result, journal)
                if isinstance(result, UserError):
                    self._add_error(path, result, reduction)
                    continue
                if journal is not None and stored is None and result.error is None:
                    journal.add(path, result)
                self._take(path, result)
                if result.error is not None:
                    self._add_error(path, result.error, reduction)
            if journal is not None:
                self._stage_histories(reduction)

    def _shard(self) -> list[Path]:
        """Return the runs of this call; those that are compared with others, and the zero, belong to every shard."""
        if self.options.shard is None:
            return list(self.surveys)
        index, count = self.options.shard
        rotor = [path for path, survey in self.surveys.items() if survey.kind in ROTOR_KINDS]
        shard = set(rotor[index - 1 :: count])
        if not shard:
            fault = f"shard {index} of {count} holds none of {len(rotor)} runs"
            raise UserError(fault, "--shard", remedy="Make fewer shards")
        return [path for path, survey in self.surveys.items() if path in shard or survey.kind not in ROTOR_KINDS]

    @contextmanager
    def _journal(self, reduction: Reduction, output: Path, count: int) -> Iterator[Journal[RunResult] | None]:
        """Yield the journal of the call; None for a few runs.

        It is removed when the outputs are in place, or the call was refused.
        """
        if count < FEWEST_JOURNALED:
            yield None
            return
        provenance = self.session.provenance()
        inputs = [*((item.role, item.digest) for item in provenance.inputs), *self.zero_digests]
        compared = [reduction.method.harmonics, reduction.compare_runs, reduction.histories is not None]
        asked = json.dumps([__version__, provenance.options, inputs, compared])
        journal = Journal(journal_path(output), hashlib.sha256(asked.encode()).hexdigest(), RunResult)
        self.session.after_close(journal.close)
        yield journal

    def _is_done(self, path: Path, journal: Journal[RunResult] | None, reduction: Reduction) -> bool:
        """Whether an interrupted call has reduced a run, and has left its history where one is asked for."""
        stored = None if journal is None else journal.find(path)
        if journal is None or stored is None:
            return False
        return reduction.histories is None or stored.loads is None or journal.history(stored.name).exists()

    def _item(self, path: Path, reduction: Reduction, data: bytes, journal: Journal[RunResult] | None) -> Item:
        survey = self.surveys[path]
        item = Item(path, data, harmonics=survey.harmonics)
        if reduction.histories is None or survey.kind not in ROTOR_KINDS:
            return item
        if journal is not None and journal.is_mine:
            return replace(item, history=journal.history(survey.name))
        return replace(item, history=self.session.stage_in(reduction.histories, f"{survey.name}.h5"))

    def _may_have_history(self, path: Path, reduction: Reduction) -> bool:
        """Whether the name of a run can be that of its history; else the run is skipped."""
        try:
            check_name(self.surveys[path].name, path, reduction.histories)
        except UserError as error:
            self._skip(path, error)
            return False
        return True

    def _keep_history(self, item: Item, result: RunResult | UserError, journal: Journal[RunResult] | None) -> None:
        """Withdraw the history of a run that was not reduced, or has none."""
        if item.history is None:
            return
        reduced = not isinstance(result, UserError) and result.error is None
        kept_beside = journal is not None and journal.is_mine
        if reduced and item.history.exists():
            if kept_beside:
                self.histories.append(item.history)
        elif kept_beside:
            item.history.unlink(missing_ok=True)
        else:
            self.session.unstage(item.history)

    def _stage_histories(self, reduction: Reduction) -> None:
        """Move the histories that were kept during the batch to where the outputs of the call are."""
        for history in self.histories:
            assert reduction.histories is not None
            target = self.session.stage_in(reduction.histories, history.name)
            with os_errors_as_user_error(target):
                shutil.move(history, target)

    def _take(self, path: Path, result: RunResult) -> None:
        """Keep what the end of the batch needs of a run."""
        self.session.record_input(result.name, "run", result.digest)
        self.session.record_gaps(result.name, result.gaps, result.gap_text)
        self.paths[result.name] = str(path)
        if result.loads is not None:
            self.loads[result.name] = result.loads
        if result.rows is not None:
            self.rows.append(result.rows)
            self.levels[result.name] = result.level
        if result.noise is not None:
            self.noise.append(result.noise)

    def _add_error(self, path: Path, error: UserError, reduction: Reduction) -> None:
        """Keep the error of a run, or raise it; an error that the comparison of the runs explains comes first."""
        if not self.skips:
            self._compare(reduction)
            raise error
        self.errors[path] = error

    def _finish(self, reduction: Reduction) -> None:
        """Cross-check the runs, and report those that are skipped and the channels left out of the others."""
        self._compare(reduction)
        for path, error in self.errors.items():
            if str(path) not in self.session.skipped:
                self._skip(path, error)
        self._warn_of_fewer_harmonics(reduction)
        for name, loads in self.loads.items():
            for channel, reason in loads.left_out.items():
                self.session.warn_of_run(name, f"{name}: channel {channel} left out: {reason}")

    def _warn_of_fewer_harmonics(self, reduction: Reduction) -> None:
        """Warn of the reduced runs that permit fewer harmonics than those that are the default."""
        wanted, method = default_harmonics(reduction.geometry), reduction.method
        if method.harmonics or method.frequencies:
            return
        for survey in self.surveys.values():
            if survey.harmonics < wanted and survey.name in self.loads:
                text = fewer_harmonics_warning(survey.name, survey.harmonics, wanted)
                self.session.warn_of_run(survey.name, text)

    def _compare(self, reduction: Reduction) -> None:
        """Cross-check the runs with known loads, and skip those that contradict the others."""
        bad = inconsistent_runs(self.session, self._findings(reduction), self.paths, self.skips, known_anyway)
        for name, reason in bad.items():
            self.loads.pop(name, None)
            self.session.report_skipped(self.paths[name], f"{self.paths[name]}: {reason}")

    def _findings(self, reduction: Reduction) -> Sequence[ConsistencyFinding]:
        """Compare the noise of all runs, and the runs with known loads: wind runs do not import what that takes."""
        noise = compare_noise(self.noise, reduction.geometry.channel_names, reduction.usual_noise)
        if not self.rows:
            return noise
        from balance_cli.diagnosis.consistency.campaign import findings_from_rows

        return (*findings_from_rows(reduction.geometry, self.rows, self.levels), *noise)

    def _skip(self, path: Path, error: UserError) -> None:
        if not self.skips:
            raise error
        self.session.report_skipped(str(path), str(error))

    def _all_skipped(self) -> UserError:
        reasons = self.session.skipped
        remedy = f"First reason: {next(iter(reasons.values()))}" if reasons else "Give check or wind runs"
        return UserError("all runs were skipped", remedy=remedy)
