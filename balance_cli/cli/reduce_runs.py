"""How `balance reduce` takes one run after another: by harmonics or in time, with its load history."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from balance_cli.cli.common import Session
from balance_cli.io.errors import UserError

if TYPE_CHECKING:
    from balance_cli.calibration.result import Calibration
    from balance_cli.campaign.recording.run import Run
    from balance_cli.reduction.history_file import HistoryFile
    from balance_cli.reduction.kalman.load_history import LoadHistory
    from balance_cli.reduction.mean_loads import ZeroRecord
    from balance_cli.reduction.response_sources import ModelSource, ResponseSource
    from balance_cli.reduction.result import RunLoads
    from balance_cli.steps.reduce_in_time import TimeOptions, TimeReduction

METHODS = ("harmonic", "kalman", "smoother")
LOAD_MODEL_CHOICES = ("harmonics", "random", "free")


@dataclass(frozen=True)
class MethodOptions:
    """What was asked for: `name` one of METHODS, `loads_as` one of LOADS_AS (None: not asked), `lag` [s], harmonics."""

    name: str
    loads_as: str | None
    lag: float | None
    harmonics: int

    @property
    def in_time(self) -> bool:
        """Whether by a filter or smoother."""
        return self.name != "harmonic"

    def check(self, has_model: bool) -> None:
        """UserError where the options do not go together."""
        if self.loads_as is not None and not self.in_time:
            fault = "what is known of the loads matters in time only"
            raise UserError(fault, "--loads-as", remedy="Add --method kalman or --method smoother, or leave it out")
        if self.lag is not None and self.name != "kalman":
            raise UserError(
                "only a filter looks back after a lag", "--lag", remedy="Add --method kalman, or leave it out"
            )
        if self.lag is not None and not (math.isfinite(self.lag) and self.lag >= 0):
            raise UserError(f"a lag of {self.lag:g} s is none", "--lag", remedy="Give seconds, 0 for none")
        if self.in_time and not has_model:
            raise no_state_space_error(self.name)

    def options(self) -> TimeOptions:
        """Those of the step."""
        from balance_cli.steps.reduce_in_time import TimeOptions

        known = TimeOptions(self.name == "smoother", self.loads_as or LOAD_MODEL_CHOICES[0], harmonics=self.harmonics)
        return known if self.lag is None else replace(known, lag=self.lag)


def no_state_space_error(method: str, path: str = "") -> UserError:
    """The response that was given cannot be taken sample by sample."""
    return UserError(
        "the response has no state space, which reduction in time needs",
        path,
        f"--method {method}",
        "Give --model with a model of the physical form (`balance identify` without --form paper), "
        "or use --method harmonic",
    )


@dataclass(frozen=True)
class Reduction:
    """One call: how, by what response and calibration, and where histories go (None: nowhere)."""

    method: MethodOptions
    calibration: Calibration
    source: ResponseSource
    zero: ZeroRecord | None
    histories: Path | None

    def reduced(self, session: Session, run: Run) -> RunLoads:
        """Loads of one run, its history prepared. UserError where it cannot be reduced."""
        _check_name(run, self.histories)
        with ExitStack() as stack:
            history = _HistoryWriter(session, stack, self.histories, run.name)
            return self._reduce_in_time(run, history) if self.method.in_time else self._reduce_harmonics(run, history)

    def _reduce_harmonics(self, run: Run, history: _HistoryWriter) -> RunLoads:
        from balance_cli.reduction.history_file import harmonic_history
        from balance_cli.steps.reduce import ReduceOptions, reduce_run

        options = ReduceOptions(self.method.harmonics)
        loads = reduce_run(run, self.calibration.geometry, self.calibration, self.source, self.zero, options)
        if history.is_enabled:
            for block in harmonic_history(run, loads):
                history.file.add(block)
        return loads

    def _reduce_in_time(self, run: Run, history: _HistoryWriter) -> RunLoads:
        from balance_cli.steps.reduce_in_time import reduce_run_in_time

        options = self.method.options()
        time_reduction = reduce_run_in_time(
            run, self.calibration.geometry, self.calibration, self._model(), self.zero, options, history.sink
        )
        if time_reduction.track is not None and history.is_enabled:
            history.file.add_harmonics(time_reduction.track, time_reduction.loads.components)
        return _add_filter_tests(time_reduction, options)

    def _model(self) -> ModelSource:
        from balance_cli.reduction.response_sources import ModelSource

        if not isinstance(self.source, ModelSource):
            raise AssertionError("checked before the first run")
        return self.source


def _add_filter_tests(time_reduction: TimeReduction, options: TimeOptions) -> RunLoads:
    """The loads, and beside them how they were found; a channel that was lost for a while only is not left out."""
    from balance_cli.reduction.result import TimeDomainResult

    lag = None if options.smooth else options.lag
    how = TimeDomainResult(
        options.loads,
        lag,
        time_reduction.innovations,
        time_reduction.track,
        time_reduction.noise,
        time_reduction.bridged,
    )
    left_out = {
        name: reason for name, reason in time_reduction.loads.left_out.items() if name not in time_reduction.noise
    }
    return replace(time_reduction.loads, in_time=how, left_out=left_out)


def _check_name(run: Run, folder: Path | None) -> None:
    if folder is not None and Path(run.name).name != run.name:
        raise UserError(f"run name `{run.name}` is no file name", str(run.path), "attribute `run`", "Rename the run")


class _HistoryWriter:
    """The history file of a run, which is there from the first block on: before that a run may still be refused."""

    def __init__(self, session: Session, stack: ExitStack, folder: Path | None, run: str) -> None:
        self._session, self._stack, self._folder, self._run = session, stack, folder, run
        self._file: HistoryFile | None = None

    @property
    def is_enabled(self) -> bool:
        """Whether there is to be one."""
        return self._folder is not None

    @property
    def sink(self) -> Callable[[LoadHistory], None] | None:
        """Takes the blocks; None where nobody wants them."""
        return (lambda block: self.file.add(block)) if self.is_enabled else None

    @property
    def file(self) -> HistoryFile:
        """The file, made when first asked for."""
        from balance_cli.reduction.history_file import HistoryFile

        if self._file is None:
            assert self._folder is not None
            part = self._session.stage_in(self._folder, f"{self._run}.h5")
            self._file = self._stack.enter_context(HistoryFile(part, self._run))
        return self._file
