"""Reduced hub loads: the results of `reduce`, as artefacts, the report and scripts use them."""

from __future__ import annotations

from collections import ChainMap, Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from balance_cli.calibration.load_method import MATRIX
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.percent import percent_text
from balance_cli.io.result_view import ResultView, plural, warning_lines
from balance_cli.reduction.flags import FILTER_CONTRADICTED, FLAGS, SEPARATOR, join_flags
from balance_cli.reduction.kalman.innovations import InnovationTests
from balance_cli.reduction.kalman.load_history import LoadTrack
from balance_cli.reduction.reliability import NotableChange, UndeclaredMass, UnnoticedErrors

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LOAD_TABLE_COLUMNS = (
    "run",
    "component",
    "unit",
    "harmonic",
    "frequency_hz",
    "cosine",
    "sine",
    "amplitude",
    "phase_deg",
    "sigma_cosine",
    "sigma_sine",
    "flag",
)


@dataclass(frozen=True)
class CheckErrors:
    """Reduced against applied loads of a check run, over harmonics 1 to 8 (`load_error` in docs/json.md).

    load_error {component applied: relative error}, interaction {component not applied: relative to the largest applied
    force}; load_noise and interaction_noise: the noise floor of each, from the noise of the record. `applied` (n+1, m)
    are the loads as the exciter measured them, without the anti-alias filter. `wrong_channels`: what is wrong with one
    or two channels, in words, where that explains the errors. `added_variance` (n+1, m): variance of reduced minus
    applied loads less that of the reduced ones; negative where both have an error in common. None in artefacts of
    former versions.
    """

    load_error: dict[str, float]
    interaction: dict[str, float]
    load_noise: dict[str, float]
    interaction_noise: dict[str, float]
    applied: ComplexArray
    wrong_channels: str | None = None
    added_variance: Array | None = field(default=None, metadata={"omit_if_none": True})


@dataclass(frozen=True)
class TimeDomainResult:
    """How a Kalman filter or smoother estimated the loads, and the tests of its innovations.

    `load_model`: what was assumed of the loads (`choices.LOAD_MODELS`); `lag` [s] of a fixed-lag filter, None for a
    smoother; `innovations`: None where no segment has all channels; `track`: harmonics from revolution to revolution,
    None where the load model has none; `noise` {channel: standard deviation of the noise of one sample, V};
    `gap_notes`: gaps, and channels that were not used for a time, in words. Two fields have other names in files.
    """

    load_model: str = field(metadata={"stored_as": "loads_as"})
    lag: float | None
    innovations: InnovationTests | None
    track: LoadTrack | None
    noise: dict[str, float]
    gap_notes: tuple[str, ...] = field(metadata={"stored_as": "bridged"})


@dataclass(frozen=True)
class RunConditions:
    """Under which conditions a run was made: nominal rotor speed [Hz], time, note, and attributes of its file."""

    rotor_speed: float
    recorded: str | None = None
    note: str | None = None
    attributes: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, repr=False)
class RunLoads(ResultView):
    """Hub loads of one run: m components, harmonics 0 to n.

    frequency_hz (n+1,): n times the mean pulse rate of the record; amplitude (n+1, m) = cosine - j sine; sigma_cosine,
    sigma_sine (n+1, m); flags (n+1, m) words, empty where nothing is wrong; redundancy (chi-square per degree of
    freedom of the residual test), redundancy_limit, condition (n+1,), NaN where they do not exist; interval [s] that
    was used; `in_time`: of a reduction by a filter or smoother; `rotor`: the number of the rotor whose harmonics they
    are, None for the first; `conditions`: None in artefacts of former versions; `unnoticed`: what the residual test
    does not show of errors of the sensors at harmonics 1 to n, None where there is no such test. `mean_method`: what
    computed harmonic 0, in words; None where it was not measured, and in artefacts of former versions.
    `wrong_channels`: the mistake in the channels that explains what they contradict; None where none is known.
    `undeclared_mass`: what no channel shows of a mass that the response does not have; None where masses are not known.
    """

    run: str
    kind: str
    response: str
    trim: str
    components: tuple[str, ...]
    frequency_hz: Array
    amplitude: ComplexArray
    sigma_cosine: Array
    sigma_sine: Array
    flags: tuple[tuple[str, ...], ...]
    redundancy: Array
    redundancy_limit: Array
    condition: Array
    left_out: dict[str, str]
    interval: tuple[float, float]
    notes: tuple[str, ...] = ()
    check: CheckErrors | None = None
    in_time: TimeDomainResult | None = None
    rotor: int | None = field(default=None, metadata={"omit_if_none": True})
    conditions: RunConditions | None = field(default=None, metadata={"omit_if_none": True})
    unnoticed: UnnoticedErrors | None = field(default=None, metadata={"omit_if_none": True})
    mean_method: str | None = field(default=None, metadata={"omit_if_none": True})
    wrong_channels: str | None = field(default=None, metadata={"omit_if_none": True})
    undeclared_mass: UndeclaredMass | None = field(default=None, metadata={"omit_if_none": True})

    @property
    def flag_counts(self) -> dict[str, int]:
        """Number of rows with each flag, in the order of `flags.FLAGS`."""
        counts = Counter(word for row in self.flags for words in row for word in words.split(SEPARATOR) if word)
        return {flag: counts[flag] for flag in FLAGS if counts[flag]}

    def with_flag(self, flag: str, *notes: str, where: ArrayLike = True) -> RunLoads:
        """Return the loads flagged `where` a mask that broadcasts to (n+1, m) says, with notes that say why."""
        marked = np.broadcast_to(where, self.amplitude.shape)
        flags = tuple(
            tuple(join_flags((words, flag)) if is_marked else words for words, is_marked in zip(*row, strict=True))
            for row in zip(self.flags, marked, strict=True)
        )
        return replace(self, flags=flags, notes=(*self.notes, *notes))

    @property
    def mean_loads_by(self) -> str:
        """What computed harmonic 0, in words; empty where that is not known."""
        if not self.mean_method:
            return f"trim \u201c{self.trim}\u201d" if self.trim else ""
        return f"{self.mean_method} \u201c{self.trim}\u201d" if self.mean_method == MATRIX else self.mean_method

    @property
    def unnoticed_note(self) -> str:
        """Which loads an error of one sensor changes most, unnoticed, in words; empty where none matters."""
        return "" if self.unnoticed is None else self.unnoticed.describe(*self._sized_loads)

    @property
    def unnoticed_changes(self) -> tuple[NotableChange, ...]:
        """Which loads an error of one sensor changes most, unnoticed; empty where none matters."""
        return () if self.unnoticed is None else self.unnoticed.notable_changes(*self._sized_loads)

    @property
    def undeclared_mass_note(self) -> str:
        """Which loads an undeclared mass changes most, in words; empty where none matters or masses are not known."""
        components, _, sigma = self._sized_loads
        return "" if self.undeclared_mass is None else self.undeclared_mass.describe(components, sigma)

    @property
    def _sized_loads(self) -> tuple[tuple[str, ...], Array, Array]:
        """Components, and size and sigma of their harmonic loads (h, m)."""
        return self.components, np.abs(self.amplitude[1:]), np.maximum(self.sigma_cosine, self.sigma_sine)[1:]

    def summary_lines(self) -> Iterator[str]:
        """Run, harmonics, error of a check run, flags."""
        last = len(self.frequency_hz) - 1
        yield f"Hub loads of {self.kind} run {self.run} by {self.response}"
        of_rotor = "" if self.rotor is None else f" (rotor {self.rotor})"
        yield f"  {' '.join(self.components)}, harmonics 0 to {last} of {self.frequency_hz[1]:.4g} Hz{of_rotor}"
        if self.check is not None:
            errors = ", ".join(f"{name} {percent_text(error)} %" for name, error in self.check.load_error.items())
            yield f"  error over harmonics 1 to 8: {errors}"
        if self.left_out:
            yield f"  channels left out: {', '.join(self.left_out)}"
        yield f"  {_flag_counts([self])}"

    def to_frame(self) -> pd.DataFrame:
        """One row for each component and harmonic, with the columns of a load table."""
        import pandas as pd

        return pd.DataFrame(load_rows(self), columns=list(LOAD_TABLE_COLUMNS))


@dataclass(frozen=True, repr=False)
class HubLoads(ResultView):
    """Hub loads of all runs of one reduction, and the geometry of its calibration.

    `method` is one of `choices.METHODS`; `warnings`: what was said while the loads were reduced.
    """

    method: str
    response: str
    geometry: Geometry
    runs: Mapping[str, RunLoads]
    warnings: tuple[str, ...] | None = field(default=None, metadata={"omit_if_none": True})

    def summary_lines(self) -> Iterator[str]:
        """Rig, response, method, runs, flags."""
        yield f"Hub loads of {self.geometry.rig} by {self.response}, method {self.method}"
        yield f"  {plural(len(self.runs), 'run')}: {', '.join(self.runs)}"
        yield f"  {_flag_counts(self.runs.values())}"
        yield from warning_lines(self.warnings)

    def to_frame(self) -> pd.DataFrame:
        """One row for each run, component and harmonic: the load table."""
        return load_table(self)


def flag_filter(loads: RunLoads, tests: InnovationTests | None) -> RunLoads:
    """Return the loads, all flagged where the innovations contradict the filter that estimated them."""
    return loads.with_flag(FILTER_CONTRADICTED) if tests is not None and tests.contradict_filter else loads


def replace_runs(runs: Mapping[str, RunLoads], replaced: Mapping[str, RunLoads]) -> Mapping[str, RunLoads]:
    """Return the loads of runs, some of them replaced. The others are read from an artefact when they are needed."""
    return ChainMap(replaced, runs) if replaced else runs  # type: ignore[arg-type]  # which is only read


def _flag_counts(runs: Iterable[RunLoads]) -> str:
    """How many rows have each flag, in words."""
    counts = sum((Counter(run.flag_counts) for run in runs), Counter[str]())
    return "flags: " + ", ".join(f"{word} ({count} rows)" for word, count in counts.items()) if counts else "no flags"


def load_table(loads: HubLoads) -> pd.DataFrame:
    """Return the table with one row per run, component and harmonic (LOADS in docs/files.md)."""
    import pandas as pd

    rows = [row for run in loads.runs.values() for row in load_rows(run)]
    return pd.DataFrame(rows, columns=list(LOAD_TABLE_COLUMNS))


def load_rows(run: RunLoads) -> list[tuple[object, ...]]:
    """Return the rows of one run in the table, a value for each of LOAD_TABLE_COLUMNS."""
    from balance_cli.campaign.rig.components import UNIT_OF

    rows: list[tuple[object, ...]] = []
    for m, component in enumerate(run.components):
        for n, frequency in enumerate(run.frequency_hz):
            value = complex(run.amplitude[n, m])
            cosine, sine = value.real, -value.imag
            phase = float(np.degrees(np.arctan2(-sine, cosine)))
            sigmas = (run.sigma_cosine[n, m], run.sigma_sine[n, m])
            identity = (run.run, component, UNIT_OF[component], n, frequency)
            rows.append((*identity, cosine, sine, abs(value), phase, *sigmas, run.flags[n][m]))
    return rows
