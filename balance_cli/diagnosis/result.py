"""A diagnosis: what `diagnose` leaves behind and the report takes up."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.identified_model import ModeTable
from balance_cli.model.fitted_effects import FittedParameter

Array = NDArray[np.float64]

NOTHING_MISSING = "nothing missing"
EXPLAINED = "explained"
PARTLY_EXPLAINED = "partly explained"
UNEXPLAINED = "unexplained"

VERDICT_MEANING = {
    NOTHING_MISSING: "no candidate says anything that chance would not",
    EXPLAINED: "with the effects found the model describes the data within their noise",
    PARTLY_EXPLAINED: "the effects found are there, and something else is left",
    UNEXPLAINED: "something is missing that no effect of the library accounts for",
}


@dataclass(frozen=True)
class Evidence:
    """What speaks for an effect: `gain`, chi-square that the closed model loses without its `parameters`.

    Of a weak effect everything is refitted without it; of a strong one it is Wald's chi-square. `p_value` of that gain,
    corrected for the number of candidates; `score`, what the score test promised before it was added; `folds`, the gain
    on lines that the fit had not seen; `round` in which it came in (0: from the channels of one cell). `empirical`: it
    describes and does not explain.
    """

    gain: float
    parameters: int
    p_value: float
    score: float
    folds: float
    round: int
    empirical: bool = False


@dataclass(frozen=True)
class FoundEffect:
    """An effect of the closed model, with what cannot be told from it: labels NAME@PLACE, and what would separate.

    `choice`: the name of a parameter that is a word, and the word.
    """

    name: str
    where: tuple[str, ...]
    parameters: tuple[FittedParameter, ...]
    evidence: Evidence
    indistinguishable_from: tuple[str, ...] = ()
    separated_by: str = ""
    choice: tuple[str, str] | None = None

    @property
    def label(self) -> str:
        """NAME@PLACE,PLACE as on the command line."""
        where = self.where if self.choice is None else (*self.where, self.choice[1])
        return f"{self.name}@{','.join(where)}" if where else self.name


@dataclass(frozen=True)
class Trial:
    """One candidate in one round: what the score test promised, for how many parameters, with which corrected p-value;

    `gain` after the refit (NaN where it was not refitted); the `decision` (`accepted`, `rejected`, `removed`,
    `narrowed`) and why; `folds`, what it gained on lines that its fit had not seen (NaN where that was not asked).
    """

    round: int
    label: str
    score: float
    parameters: int
    p_value: float
    gain: float
    decision: str
    why: str = ""
    folds: float = float("nan")


@dataclass(frozen=True)
class ModelFreeTest:
    """A test that needs no model of the plate: what was compared, chi-square of the difference, and the finding."""

    name: str
    place: str
    chi2: float
    dof: float
    p_value: float
    finding: str


@dataclass(frozen=True)
class UntestableEffect:
    """An effect of which these runs say nothing, and why."""

    name: str
    why: str


@dataclass(frozen=True)
class RunErrors:
    """Errors of a hold-out run: hub loads by component and response, all relative (contract); NaN where not there."""

    load_error: dict[str, float]
    interaction: dict[str, float]
    frf_error: float


@dataclass(frozen=True)
class HoldOut:
    """Errors of a run that no fit has seen, before and after closing; `noise`: what its noise alone would leave."""

    before: RunErrors
    after: RunErrors
    noise: RunErrors


@dataclass(frozen=True)
class ResidualMap:
    """Rms whitened residual before and after (runs, bands, channels); one is what noise leaves.

    `edges` (bands + 1,) [Hz]; NaN where a run has no line in a band.
    """

    runs: tuple[str, ...]
    channels: tuple[str, ...]
    edges: Array
    before: Array
    after: Array


@dataclass(frozen=True)
class Diagnosis:
    """The outcome of the loop.

    `verdict` as in the contract; `effects` strongest first; `trials` in the order of the decisions; chi2/dof and
    response error before and after; eigenmodes before and after, `measured_frequency` [Hz] those read off the measured
    responses without a model; `location`: where a residual is left, in words.
    """

    geometry: Geometry
    verdict: str
    effects: tuple[FoundEffect, ...]
    trials: tuple[Trial, ...]
    tests: tuple[ModelFreeTest, ...]
    not_testable: tuple[UntestableEffect, ...]
    chi2_per_dof_before: float
    chi2_per_dof_after: float
    frf_error_before: float
    frf_error_after: float
    modes_before: ModeTable
    modes_after: ModeTable
    residual: ResidualMap
    candidates: int
    location: str = ""
    hold_out: dict[str, HoldOut] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
