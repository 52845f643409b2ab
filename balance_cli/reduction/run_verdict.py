"""Whether the loads of a run can be used, in one word and with its reasons, from the flags of its rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from balance_cli.reduction.flags import (
    EXTRAPOLATED,
    FILTER_CONTRADICTED,
    MODEL_CONTRADICTED,
    NO_TEMPERATURE,
    NO_WEIGHT,
    NO_ZERO,
    NOT_MEASURED,
    NOT_STEADY,
    REDUNDANCY,
    UNMODELLED_LINE,
    UNRESOLVED,
    UNTESTED,
)
from balance_cli.reduction.result import RunLoads

USE, WITH_CARE, DO_NOT_USE = "use", "use with care", "do not use"
CONTRADICTIONS = (REDUNDANCY, FILTER_CONTRADICTED, MODEL_CONTRADICTED)
"""Flags that say that something measured contradicts the load."""
CONTRADICTED_SHARE = 0.5
"""Share of contradicted rows from which a run should not be used: it is the response, the filter or a channel that is
wrong then, not a harmonic."""
MEANINGS = {
    NO_ZERO: "the mean loads count from the zero of the calibration",
    NOT_MEASURED: "no channel measures the mean loads",
    UNTESTED: "no redundant sensor tests them",
    REDUNDANCY: "the redundant channels contradict them",
    EXTRAPOLATED: "loads lie outside the calibrated range, or harmonics outside the sweeps",
    NO_WEIGHT: "the rig has another attitude than at its zero, or one is not stated, and its weight is not known",
    NO_TEMPERATURE: "the channels depend on temperature, and that of the run or of its zero is not known",
    NOT_STEADY: "loads step or drift within the record",
    UNMODELLED_LINE: "the channels have a line beside these harmonics, or one above the highest",
    FILTER_CONTRADICTED: "the innovations contradict the filter",
    MODEL_CONTRADICTED: (
        "the response misses its own data, or known loads, by more than a tenth of the load, or channels or loads are "
        "not as in other runs: the notes say which"
    ),
    UNRESOLVED: (
        "the record is too short, or the lines of the measured response are too far apart, to resolve a mode of the "
        "balance"
    ),
}
"""What each flag says of the rows of a run."""


@dataclass(frozen=True)
class RunVerdict:
    """USE, WITH_CARE or DO_NOT_USE, and the reasons in words, those that decide first."""

    word: str
    reasons: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """The verdict and its reasons as one sentence."""
        because = f" because {'; '.join(self.reasons)}" if self.reasons else ": all loads were tested and are good"
        return f"{self.word[0].upper()}{self.word[1:]}{because}."


def run_verdict(run: RunLoads) -> RunVerdict:
    """Return the verdict on the loads of one run."""
    counts, rows = run.flag_counts, sum(len(row) for row in run.flags)
    contradicted = sum(any(word in flags for word in CONTRADICTIONS) for row in run.flags for flags in row)
    word = DO_NOT_USE if contradicted >= CONTRADICTED_SHARE * rows > 0 else WITH_CARE if counts or run.left_out else USE
    order = sorted(counts, key=lambda flag: flag not in CONTRADICTIONS)
    reasons = [f"{_meaning(flag, run)} ({flag}: {counts[flag]} of {rows} rows)" for flag in order]
    if run.left_out:
        reasons.append(f"channels are left out ({', '.join(run.left_out)})")
    return RunVerdict(word, tuple(reasons))


def untested_loads(run: RunLoads) -> tuple[str, ...]:
    """Return the loads of a run that are untested, in words; empty where all are, or none is.

    Named are components that rest on one sensor at all harmonics, and means.
    """
    untested = np.array([[UNTESTED in words for words in row] for row in run.flags])
    if not untested.any():
        return ()
    measured = np.array([[NOT_MEASURED not in words for words in row] for row in run.flags])
    whole = (untested | ~measured).all(axis=0)
    if whole.all():
        return ()
    of_mean = untested[0] & ~untested[1:].any(axis=0)
    means = [run.components[j] for j in np.flatnonzero(of_mean)]
    alone = {
        j: f"{run.components[j]} ({sensor} alone)" for j in np.flatnonzero(whole) if (sensor := _sensor_of(run, j))
    }
    others = any(untested[:, j].any() and not of_mean[j] and j not in alone for j in range(len(of_mean)))
    first = [f"the mean{'s' if len(means) > 1 else ''} of {' and '.join(means)}"] if means else []
    return (*first, *alone.values(), *(["some other loads"] if others else []))


def _sensor_of(run: RunLoads, j: np.intp) -> str:
    """Return the sensor of which errors change a component most at all harmonics; empty where there are several."""
    errors = run.unnoticed
    sensors = set() if errors is None else {errors.sensors[place] for place in errors.sensor[:, j]}
    return sensors.pop() if len(sensors) == 1 else ""


def _meaning(flag: str, run: RunLoads) -> str:
    """Return what a flag says of the rows of a run."""
    loads = untested_loads(run) if flag == UNTESTED else ()
    names = " and ".join(filter(None, [", ".join(loads[:-1]), *loads[-1:]]))
    return f"no redundant sensor tests {names}" if loads else MEANINGS[flag]
