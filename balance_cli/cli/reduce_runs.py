"""The runs of `balance reduce`: each is reduced by harmonics or in time, and its load history is written."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from balance_cli.io.errors import UserError
from balance_cli.reduction.choices import HARMONIC, KALMAN, LOAD_MODELS, SMOOTHER

if TYPE_CHECKING:
    from balance_cli.calibration.result import Calibration
    from balance_cli.campaign.recording.run import Run
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.reduction.history_file import HistoryFile
    from balance_cli.reduction.kalman.load_history import LoadHistory
    from balance_cli.reduction.response_sources import ResponseSource
    from balance_cli.reduction.result import RunLoads
    from balance_cli.reduction.wind_off import ZeroRecord
    from balance_cli.signals.nyquist_noise import UsualNoise
    from balance_cli.steps.reduce_in_time import TimeOptions


DEFAULT_TONE_MULTIPLES = 8
"""Multiples of a given frequency that a filter follows if nobody asks, as many as harmonics of a rotor."""
LONGEST_NAME = 200
"""Bytes of a run name that is also the name of a file, of 255 that file systems allow, with a margin for suffixes."""


@dataclass(frozen=True)
class MethodOptions:
    """The method and its options as given.

    `name` of METHODS, `load_model` of LOAD_MODELS, `lag` [s]; None: not given. `frequencies` [Hz] of tones in place of
    rotor harmonics; in time, the one whose multiples the loads are. `rotor` is that of the harmonics.
    """

    name: str
    load_model: str | None
    lag: float | None
    harmonics: int
    frequencies: tuple[float, ...] = ()
    rotor: int = 1

    @property
    def in_time(self) -> bool:
        """Whether the method is a filter or smoother."""
        return self.name != HARMONIC

    def check(self, has_model: bool, has_history: bool = False, has_harmonics: bool = False) -> None:
        """Raise UserError where the options do not go together."""
        if self.frequencies and not self.in_time and (has_history or has_harmonics):
            option = "--history" if has_history else "--harmonics"
            fault = "does not go with loads at given frequencies"
            raise UserError(fault, option, remedy="Leave one out, or add --method smoother")
        if self.rotor != 1 and (self.in_time or self.frequencies):
            option = f"--method {self.name}" if self.in_time else "--frequencies"
            raise UserError(f"does not go with {option}", "--rotor", remedy="Leave one out")
        if self.in_time and len(self.frequencies) > 1:
            fault = f"{len(self.frequencies)} frequencies, where a filter follows the multiples of one"
            raise UserError(fault, "--frequencies", remedy="Give one, or use --method harmonic")
        if self.load_model is not None and not self.in_time:
            fault = "a load model applies to filters and smoothers only"
            raise UserError(fault, "--load-model", remedy="Add --method kalman or --method smoother, or leave it out")
        if self.lag is not None and self.name != KALMAN:
            raise UserError("a lag applies to a filter only", "--lag", remedy="Add --method kalman, or leave it out")
        if self.lag is not None and not (math.isfinite(self.lag) and self.lag >= 0):
            fault = f"lag must be finite and non-negative, not {self.lag:g} s"
            raise UserError(fault, "--lag", remedy="Give seconds, 0 for no lag")
        if self.in_time and not has_model:
            from balance_cli.reduction.response_sources import no_state_space_error

            raise no_state_space_error(self.name)

    def check_source(self, source: ResponseSource, path: Path | None) -> None:
        """Raise UserError where the method needs a state space and the response, from `path`, has none."""
        from balance_cli.reduction.response_sources import no_state_space_error

        if self.in_time and source.system is None:
            raise no_state_space_error(self.name, str(path))

    def options(self) -> TimeOptions:
        """Return the options of the step."""
        from balance_cli.steps.reduce_in_time import TimeOptions

        options = TimeOptions(
            self.name == SMOOTHER, self.load_model or LOAD_MODELS[0], harmonics=self.harmonics or DEFAULT_TONE_MULTIPLES
        )
        return options if self.lag is None else replace(options, lag=self.lag)


@dataclass(frozen=True)
class Reduction:
    """Method, geometry, response and calibration of one call, and the folder of the histories (None: not written).

    Without a calibration the mean loads are not measured. `compare_runs`: whether the call has runs with known loads,
    which are compared with each other. `usual_noise`: of the channels in the sweeps that the response was measured in.
    """

    method: MethodOptions
    geometry: Geometry
    calibration: Calibration | None
    source: ResponseSource
    zero: ZeroRecord | None
    histories: Path | None
    compare_runs: bool = False
    usual_noise: tuple[UsualNoise, ...] = ()

    def with_harmonics(self, harmonics: int) -> Reduction:
        """Return the reduction to so many harmonics of the rotor, where the call does not say how many."""
        if self.method.harmonics or self.method.frequencies:
            return self
        return replace(self, method=replace(self.method, harmonics=harmonics))

    def reduce_run(self, run: Run, history_file: Path | None = None) -> RunLoads:
        """Reduce one run and write its history, if a file is given. UserError where it cannot be reduced."""
        from balance_cli.reduction.assumed_filter import flag_assumed_filter

        with ExitStack() as stack:
            history = _HistoryWriter(stack, history_file, run.name, self.calibration is not None)
            loads = self._reduce_by_method(run, history)
        return flag_assumed_filter(loads, run, self.geometry, [item.sample_rate for item in self.usual_noise])

    def _reduce_by_method(self, run: Run, history: _HistoryWriter) -> RunLoads:
        if self.method.in_time:
            return self._reduce_in_time(run, history)
        return self._reduce_tones(run) if self.method.frequencies else self._reduce_harmonics(run, history)

    def _reduce_tones(self, run: Run) -> RunLoads:
        from balance_cli.steps.reduce_frequencies import reduce_run_at_frequencies

        frequencies = self.method.frequencies
        return reduce_run_at_frequencies(run, frequencies, self.geometry, self.calibration, self.source, self.zero)

    def _reduce_harmonics(self, run: Run, history: _HistoryWriter) -> RunLoads:
        from balance_cli.steps.reduce import ReduceOptions, reduce_run

        options = ReduceOptions(self.method.harmonics, self.method.rotor)
        try:
            loads = reduce_run(run, self.geometry, self.calibration, self.source, self.zero, options)
        except UserError as error:
            from balance_cli.steps.reduce_sound_part import reduce_sound_part

            given = self.geometry, self.calibration, self.source, self.zero, options
            loads = reduce_sound_part(error, run, *given)
        if history.is_enabled:
            from balance_cli.reduction.history_file import harmonic_history
            from balance_cli.signals.rotor.other_rotors import rotor_azimuth

            of_rotor = replace(run, pulse_times=rotor_azimuth(run, self.method.rotor).pulse_times)
            for block in harmonic_history(of_rotor, loads):
                history.file.add(block)
        return loads

    def _reduce_in_time(self, run: Run, history: _HistoryWriter) -> RunLoads:
        from balance_cli.steps.reduce_in_time import reduce_run_in_time
        from balance_cli.steps.reduction_inputs import loads_with_filter_tests

        options = self.method.options()
        _check_lag(run, self.method.lag)
        if self.method.frequencies:
            from balance_cli.steps.reduce_frequencies import with_pulses_at

            run = with_pulses_at(run, self.method.frequencies[0])
        time_reduction = reduce_run_in_time(
            run, self.geometry, self.calibration, self.source, self.zero, options, history.sink
        )
        if time_reduction.track is not None and history.is_enabled:
            history.file.add_harmonics(time_reduction.track, time_reduction.loads.components)
        return loads_with_filter_tests(time_reduction, options)


def _check_lag(run: Run, lag: float | None) -> None:
    from balance_cli.signals.run_samples import sample_rate

    duration = run.samples / sample_rate(run)
    if lag is not None and lag > duration:
        fault = f"lag {lag:g} s is longer than the record `{run.name}` of {duration:g} s"
        raise UserError(fault, "--lag", remedy="Give a shorter lag, or use --method smoother")


def check_name(name: str, path: Path, folder: Path | None) -> None:
    """Raise UserError where the name of the run in a file cannot be that of its history in a folder."""
    is_long = len(name.encode("utf-8", "replace")) > LONGEST_NAME
    if folder is not None and (Path(name).name != name or is_long):
        fault = f"run name `{name[:LONGEST_NAME]}` cannot be a file name"
        raise UserError(fault, str(path), "attribute `run`", "Rename the run")


class _HistoryWriter:
    """The history file of a run, created with its first block: until then the run may still be refused."""

    def __init__(self, stack: ExitStack, path: Path | None, run: str, has_mean: bool) -> None:
        self._stack, self._path, self._run, self._has_mean = stack, path, run, has_mean
        self._file: HistoryFile | None = None

    @property
    def is_enabled(self) -> bool:
        """Whether histories are written."""
        return self._path is not None

    @property
    def sink(self) -> Callable[[LoadHistory], None] | None:
        """The receiver of blocks; None where histories are not written."""
        return (lambda block: self.file.add(block)) if self.is_enabled else None

    @property
    def file(self) -> HistoryFile:
        """The file, created at first use."""
        from balance_cli.reduction.history_file import HistoryFile

        if self._file is None:
            assert self._path is not None
            self._file = self._stack.enter_context(HistoryFile(self._path, self._run, self._has_mean))
        return self._file
