"""The loads of the runs of a watched folder: each run is reduced by harmonics as it appears."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.recording.run_file import open_runs
from balance_cli.cli.common import Session
from balance_cli.cli.consistency import require_consistent_runs
from balance_cli.cli.load_text import blade_harmonic
from balance_cli.cli.reduce_runs import Reduction
from balance_cli.cli.watching.zeros import ZeroRun, ZeroRuns
from balance_cli.diagnosis.consistency.severity import known_anyway
from balance_cli.io.artefacts import Artefact, Input, Provenance
from balance_cli.io.errors import UserError
from balance_cli.io.formats import RUN_FORMAT
from balance_cli.io.sniff import sniff_format
from balance_cli.reduction.polar import polar_sigma
from balance_cli.reduction.result import HubLoads, RunLoads
from balance_cli.reduction.wind_off import ZeroRecord
from balance_cli.steps.reduction_inputs import (
    default_harmonics,
    fewer_harmonics_warning,
    harmonics_within_band,
    loaded_zero_warning,
    zero_reference,
)

ROTOR_KINDS = ("check", "wind")


class NoRotorLoadsError(Exception):
    """A file that is no fault and has no loads: a run of another kind, or a result; with the name and kind of a run."""

    def __init__(self, reason: str, run: str = "", kind: str = "") -> None:
        super().__init__(reason)
        self.run, self.kind = run, kind


@dataclass
class QuickLook:
    """The reduction of all runs of a folder, and the loads so far {run: loads}.

    `harmonics`: None for the default of each run. `has_own_zero`: a zero record was given, so those in the folder are
    not used. `files` {run: file} tells two files with one run name. `run_inputs` {run: digest}. `is_changed`: the loads
    changed since they were written, for the caller to reset. `zero`: the wind-off record that was given, `zeros` are
    those of the folder, and `zero_of` {run: zero run or empty} says which served. `outdated`: files of runs that have
    another zero since it appeared, for the caller to take.
    """

    session: Session
    reduction: Reduction
    harmonics: int | None
    has_own_zero: bool
    runs: dict[str, RunLoads] = field(default_factory=dict)
    files: dict[str, Path] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    run_inputs: dict[str, Input] = field(default_factory=dict)
    is_changed: bool = False
    zero: Run | None = None
    zeros: ZeroRuns = field(default_factory=ZeroRuns)
    zero_of: dict[str, str] = field(default_factory=dict)
    outdated: list[Path] = field(default_factory=list)

    def restore(self, artefact: Artefact, files: Mapping[str, Path], zero_of: Mapping[str, str]) -> None:
        """Take over the loads of an earlier call, of the runs in `files`, and which zeros served."""
        self.zero_of = dict(zero_of)
        loads: HubLoads = artefact.content
        self.runs = {name: run for name, run in loads.runs.items() if name in files}
        self.files = {name: path for name, path in files.items() if name in self.runs}
        self.warnings = list(loads.warnings or ())
        self.run_inputs = {item.name: item for item in artefact.provenance.inputs if item.role == "run"}

    def add_file(self, path: Path) -> tuple[RunLoads, tuple[str, ...]]:
        """Reduce the run of a file, and return its loads and the warnings about it.

        Raises UserError where the file cannot be used, NoRotorLoadsError for a run of another kind or a result.
        """
        before = len(self.session.warnings)
        self._forget_file(path)
        declared = sniff_format(path)
        if declared not in (None, RUN_FORMAT):
            raise NoRotorLoadsError(f"is a file of format `{declared}`")
        run = open_runs((path,), self.reduction.geometry)[0][0]
        self._check_name(run, path)
        reduction = self.reduction
        require_consistent_runs(self.session, reduction.geometry, (run,), False, known_anyway, reduction.usual_noise)
        if run.kind not in ROTOR_KINDS:
            self._take_other_kind(run)
        loads = self._reduction_of(run).reduce_run(run)
        for channel, reason in loads.left_out.items():
            self.session.warn(f"{run.name}: channel {channel} left out: {reason}")
        self.runs[run.name], self.files[run.name], self.is_changed = loads, path, True
        self.run_inputs[run.name] = Input(run.name, "run", run.digest)
        new_warnings = tuple(self.session.warnings[before:])
        self.warnings += [text for text in new_warnings if text not in self.warnings]
        return loads, new_warnings

    def use_zero(self, run: Run) -> None:
        """Let the mean loads of all runs count from this wind-off record."""
        calibration = self.reduction.calibration
        if calibration is not None:
            self.reduction, self.zero = replace(self.reduction, zero=zero_reference([run], calibration)), run

    def restore_zero(self, path: Path) -> None:
        """Take over a zero run of an earlier call. UserError where it can no longer be read."""
        if not self.has_own_zero:
            self._add_zero(open_runs((path,), self.reduction.geometry)[0][0])

    def hub_loads(self, names: Iterable[str] | None = None) -> HubLoads:
        """Return the loads of these runs, or of all."""
        reduction = self.reduction
        selected = {name: self.runs[name] for name in names} if names is not None else dict(self.runs)
        warnings = tuple(self.warnings) or None
        return HubLoads(reduction.method.name, reduction.source.description, reduction.geometry, selected, warnings)

    def provenance(self) -> Provenance:
        """Return the provenance of the loads: the response, the calibration, the zero record and all runs."""
        fixed = self.session.provenance()
        return replace(fixed, inputs=(*fixed.inputs, *(self.run_inputs[name] for name in self.runs)))

    def summarize(self, loads: RunLoads) -> dict[str, dict[str, Any]]:
        """Return mean and blade harmonic of each component, with sigma."""
        harmonic = blade_harmonic(self.reduction.geometry, len(loads.frequency_hz) - 1)
        amplitude_sigma = polar_sigma(loads.amplitude, loads.sigma_cosine, loads.sigma_sine)[0]
        return {
            component: {
                "mean": float(loads.amplitude[0, m].real),
                "mean_sigma": float(loads.sigma_cosine[0, m]),
                "harmonic": harmonic,
                "amplitude": float(abs(loads.amplitude[harmonic, m])),
                "amplitude_sigma": float(amplitude_sigma[harmonic, m]),
            }
            for m, component in enumerate(loads.components)
        }

    def _forget_file(self, path: Path) -> None:
        """Drop the loads of the run that a file held before it changed."""
        for name in [name for name, file in self.files.items() if file == path]:
            del self.files[name], self.runs[name]
            self.is_changed = True

    def _check_name(self, run: Run, path: Path) -> None:
        other = self.files.get(run.name)
        if other is not None and other.is_file():
            fault = f"has the run name `{run.name}`, as {other.name} has"
            raise UserError(fault, str(path), "attribute `run`", "Give each run its own name")

    def _take_other_kind(self, run: Run) -> None:
        if run.kind == "zero":
            if not self.has_own_zero:
                self._add_zero(run)
                self.find_outdated()
            reason = "--zero is used" if self.has_own_zero else "zero of the mean loads"
            raise NoRotorLoadsError(reason, run.name, run.kind)
        raise NoRotorLoadsError(f"a {run.kind} run contains no rotor loads", run.name, run.kind)

    def _add_zero(self, run: Run) -> None:
        """Let the mean loads of runs count from a zero run."""
        calibration = self.reduction.calibration
        self.zeros.add(ZeroRun(run, None if calibration is None else zero_reference([run], calibration)))

    def find_outdated(self) -> None:
        """Find the runs that have another zero than that which served; one that has been deleted serves on."""
        there = {"", *(zero.run.name for zero in self.zeros.zeros)}
        for name, file in self.files.items():
            conditions = self.runs[name].conditions
            recorded = None if conditions is None else conditions.recorded
            served = self.zero_of.get(name)
            # Without a stated time a zero serves what comes after it.
            if served not in there or self.reduction.calibration is None or not self.zeros.decide(recorded):
                continue
            if self._zero_name(self.zeros.of_time(recorded)) != served:
                self.outdated.append(file)

    @staticmethod
    def _zero_name(zero: ZeroRun | None) -> str:
        return "" if zero is None else zero.run.name

    def _zero_for(self, run: Run) -> tuple[Run | None, ZeroRecord | None]:
        """Return the zero run of a run, and what its mean loads count from."""
        if self.has_own_zero:
            return self.zero, self.reduction.zero
        zero = self.zeros.of_time(run.recorded)
        self.zero_of[run.name] = self._zero_name(zero)
        if self.reduction.calibration is not None and (other := self.zeros.warning(run.name, run.recorded)):
            self.session.warn(other)
        return (None, None) if zero is None else (zero.run, zero.record)

    def _reduction_of(self, run: Run) -> Reduction:
        """Return the reduction with the harmonics that this run permits, without a zero that it shows to be loaded."""
        zero, record = self._zero_for(run)
        reduction = replace(self.reduction, zero=record)
        if record is not None and zero is not None and (loaded := loaded_zero_warning([zero], run)):
            self.session.warn(loaded)
            reduction = replace(reduction, zero=None)
        if self.harmonics is not None:
            return reduction
        wanted = default_harmonics(self.reduction.geometry)
        harmonics = harmonics_within_band(run, self.reduction.source, wanted)
        if harmonics < wanted:
            self.session.warn(fewer_harmonics_warning(run.name, harmonics, wanted))
        return replace(reduction, method=replace(reduction.method, harmonics=harmonics))
