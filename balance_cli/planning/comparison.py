"""Planned against achieved information of runs that were made after a plan."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.planning.channel_noise import measured_noise
from balance_cli.planning.detectability import DetectionLevel, project, smallest_sizes
from balance_cli.planning.extended_model import ExtendedModel
from balance_cli.planning.information import RunInformation, add_information
from balance_cli.signals.run_spectrum import RunSpectrum
from balance_cli.simulation.plans import SweepPlan

Array = NDArray[np.float64]

AS_PLANNED = 0.7
"""Ratio of information below which a run fell short: weights estimated from few lines scatter by a fifth and more."""
LEAST_SHARE = 1e-2
"""Share of the planned information on a parameter from which a run counts as one that tells of it.

What a run tells of the others is by the rig's small asymmetries, and is as uncertain as these are."""
CLEAR_CHANGE = 0.1
"""Relative change of level, noise or steady time that is named as a cause."""


@dataclass(frozen=True)
class RunComparison:
    """One run: `information_ratio`, achieved over planned, geometric mean over the parameters that the run informs.

    `level_ratio`, `noise_ratio` (of the channels, geometric mean) and `time_ratio` (steady seconds) are achieved over
    planned, NaN where the record does not tell; `causes` says what made a run fall short, and channels that were lost.
    """

    run: str
    information_ratio: float
    level_ratio: float
    noise_ratio: float
    time_ratio: float
    causes: tuple[str, ...]


@dataclass(frozen=True)
class SizeComparison:
    """The smallest size of an effect that is found at its hardest place: planned and achieved."""

    label: str
    parameter: str
    unit: str
    planned: float
    achieved: float


@dataclass(frozen=True)
class PlanComparison:
    """All runs of a plan that were made, those that were `not_made`, and others that were not `planned`."""

    runs: tuple[RunComparison, ...]
    not_made: tuple[str, ...]
    not_planned: tuple[str, ...]
    sizes: tuple[SizeComparison, ...]


@dataclass(frozen=True)
class ExecutedRun:
    """A planned sweep, its record's lines and those of its rehearsal, and the information of both."""

    plan: SweepPlan
    lines: RunSpectrum
    rehearsed: RunSpectrum
    achieved: RunInformation
    planned: RunInformation


def compare_run(run: ExecutedRun, campaign: Array) -> RunComparison:
    """Compare one run with its plan; `campaign` (p,): the diagonal of the information that all runs were to give."""
    level = _level(run.lines) / _level(run.rehearsed)
    time = _steady_seconds(run.lines) / _steady_seconds(run.rehearsed)
    ratio = _noise_ratio(run)
    information = information_ratio(run.achieved.information, run.planned.information, campaign)
    short = _causes(level, ratio, time) if information < AS_PLANNED else ()
    causes = (*short, *_differences(run))
    return RunComparison(run.plan.run, information, level, ratio, time, causes)


def information_ratio(achieved: Array, planned: Array, campaign: Array) -> float:
    """Geometric mean of the ratio of the diagonals (p,), over the parameters of which the run tells its share."""
    measured, meant = np.diag(achieved), np.diag(planned)
    known = (measured > 0) & (meant > LEAST_SHARE * campaign)
    return float(np.exp(np.mean(np.log(measured[known] / meant[known])))) if known.any() else 0.0


def _level(lines: RunSpectrum) -> float:
    """Rms of all loads together, in the lines above frequency zero."""
    return float(np.sqrt(0.5 * np.sum(np.abs(lines.loads[lines.frequency > 0]) ** 2)))


def _steady_seconds(lines: RunSpectrum) -> float:
    return float("nan") if lines.window is None else float(np.mean(lines.window.stop - lines.window.start))


def _noise_ratio(run: ExecutedRun) -> float:
    """Noise of the channels over that of the rehearsal, both as their records show it."""
    parts = [measured_noise([lines], run.plan.sample_rate) for lines in (run.lines, run.rehearsed)]
    if parts[0] is None or parts[1] is None:
        return float("nan")
    measured, meant = parts[0][0], parts[1][0]
    ratios = [measured[name] / meant[name] for name in measured if meant.get(name, 0.0) > 0 and measured[name] > 0]
    return float(np.exp(np.mean(np.log(ratios)))) if ratios else float("nan")


def _causes(level: float, noise: float, time: float) -> Iterator[str]:
    if level < 1.0 - CLEAR_CHANGE:
        yield f"level {level:.2g} of the planned one"
    if noise > 1.0 + CLEAR_CHANGE:
        yield f"noise {noise:.2g} times the planned one"
    if time < 1.0 - CLEAR_CHANGE:
        yield f"steady for {time:.2g} of the planned time"


def _differences(run: ExecutedRun) -> Iterator[str]:
    """What is not as planned however much the run tells: parameters of a lost channel are not in its ratio."""
    lost = [name for name in run.rehearsed.channel_names if name not in run.lines.channel_names]
    if lost:
        yield f"without {', '.join(lost)}"
    if run.lines.components != run.rehearsed.components:
        yield f"excited {', '.join(run.lines.components)}"


def compare_sizes(
    before: RunInformation, runs: Sequence[ExecutedRun], model: ExtendedModel, detection: DetectionLevel
) -> tuple[SizeComparison, ...]:
    """The smallest size of each effect where it was planned to be hardest to find, planned and achieved."""
    planned, achieved = (
        smallest_sizes(project(add_information([before, *parts], model), model), model, detection)
        for parts in ([run.planned for run in runs], [run.achieved for run in runs])
    )
    rows = []
    for name in dict.fromkeys(item.effect for item in planned):
        places = [k for k, item in enumerate(planned) if item.effect == name and np.isfinite(item.size)]
        if places:
            k = max(places, key=lambda k: planned[k].size / model.scales[planned[k].index])
            item = planned[k]
            rows.append(SizeComparison(item.label, item.parameter, item.unit, item.value, achieved[k].value))
    return tuple(rows)
