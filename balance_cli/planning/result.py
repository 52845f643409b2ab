"""The result of `plan`: the runs, and what they are expected to tell."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.result_view import ResultView, plural
from balance_cli.planning.candidate_runs import CandidateRun
from balance_cli.planning.confusion import ConfusedPair
from balance_cli.planning.detectability import DetectionLevel
from balance_cli.planning.levels import LevelLimit
from balance_cli.simulation.noise import DeclaredNoise
from balance_cli.simulation.plans import CampaignPlan

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DetectableEffect:
    """The smallest size of an effect that is found, where it is hardest to find among its places and parameters.

    `sizes` are those before the first proposed run and after each of them, in `unit`; infinite (or zero, of a
    cutoff) where the runs do not show it. `label` and `parameter` say where it is hardest after the last run,
    `easiest` the size and place where it is easiest. `load_error` {component: N or N m}: largest error of a
    harmonic load that an effect of the last size makes while it is not found, None where it is not a part of the
    linear response; `share` is the largest of them over the reference load of its component, and `shares` are those
    of all `sizes`. `missing`: places and parameters that no run shows; `shown_by`: the measurement that would.
    """

    effect: str
    label: str
    parameter: str
    unit: str
    sizes: tuple[float, ...]
    easiest: tuple[str, float]
    load_error: dict[str, float] | None
    share: float | None
    shares: tuple[float | None, ...]
    missing: tuple[str, ...]
    shown_by: str = ""


@dataclass(frozen=True)
class LoadSigma:
    """Standard deviation of cosine and sine of the hub loads: `before` and `after` the proposed runs, both (h, m).

    `after_run` (r, h, m): the same after each run. `noise` (h, m) is the part of a record's own noise, which no
    calibration takes away; `by_run` (r,): mean over components and harmonics of the logarithm of the part by the
    parameters, relative to the start, after each run.
    """

    components: tuple[str, ...]
    frequency: Array
    reference: Array
    before: Array
    after: Array
    noise: Array
    after_run: Array
    by_run: Array


@dataclass(frozen=True)
class RankedRun:
    """A run that could be made, by itself: what it adds to the `worth`, and its `minutes` with its set-up.

    `load_ratio`: part of the hub loads' sigma by the parameters with it, over that without, in the geometric mean.
    """

    run: str
    minutes: float
    worth: float
    load_ratio: float | None


@dataclass(frozen=True)
class ParameterForecast:
    """A parameter of the balance: its declared sigma, and that expected before and after the proposed runs."""

    name: str
    unit: str
    value: float
    declared_sigma: float
    before: float
    after: float


@dataclass(frozen=True, repr=False)
class PlannedCampaign(ResultView):
    """A plan: `runs` to be simulated or made, and their forecast.

    `minutes` of hall time; `noise` is that of the plan, and `noise_source` says where it is from; `made` are the
    runs that were made before; `unpredicted` {effect: why} are those of which the theory says nothing.
    `complete`: no time limit came before all runs were tried, ranked and rehearsed again for the forecast.
    """

    rig: str
    campaign: CampaignPlan | None
    chosen: tuple[CandidateRun, ...]
    minutes: float
    made: tuple[str, ...]
    noise: DeclaredNoise
    noise_source: str
    detection: DetectionLevel
    limits: tuple[LevelLimit, ...]
    effects: tuple[DetectableEffect, ...]
    unpredicted: dict[str, str]
    confusion: tuple[ConfusedPair, ...]
    ranking: tuple[RankedRun, ...]
    loads: LoadSigma | None
    parameters: tuple[ParameterForecast, ...]
    complete: bool = True

    def summary_lines(self) -> Iterator[str]:
        """Number of runs, time, and the noise that is assumed."""
        yield f"Plan for {self.rig}: {plural(len(self.chosen), 'run')} in {self.minutes:.1f} minutes"
        yield f"  noise {self.noise_source}"

    def to_frame(self) -> pd.DataFrame:
        """One row for each effect: where it is hardest to find, and its smallest size before and after the runs."""
        import pandas as pd

        rows = [
            {
                "effect": item.effect,
                "place": item.label,
                "parameter": item.parameter,
                "unit": item.unit,
                "before": item.sizes[0],
                "after": item.sizes[-1],
                "load_share": item.share,
            }
            for item in self.effects
        ]
        return pd.DataFrame(rows)
