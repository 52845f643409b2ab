"""A diagnosis: what `diagnose` stores and the report shows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS, SearchSettings
from balance_cli.estimation.identified_model import ModeTable
from balance_cli.io.result_view import ResultView, plural
from balance_cli.model.fitted_effects import FittedParameter

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

NOTHING_MISSING = "nothing missing"
EXPLAINED = "explained"
PARTLY_EXPLAINED = "partly explained"
UNEXPLAINED = "unexplained"
CONTRADICTED = "contradicted by hold-out"

VERDICT_MEANING = {
    NOTHING_MISSING: "no candidate is significant",
    EXPLAINED: "with the effects found the model describes the data within their noise",
    PARTLY_EXPLAINED: "the effects found are significant, but do not explain all: a residual remains, one of them only "
    "describes it, or a note says what remains",
    UNEXPLAINED: "something is missing that no effect of the library describes",
    CONTRADICTED: "with the effects found the model describes runs that no fit has seen worse than before",
}


EFFECT_TABLE_COLUMNS = (
    *("effect", "where", "parameter", "value", "sigma", "unit", "gain", "p_value"),
    "indistinguishable_from",
)


@dataclass(frozen=True)
class Evidence:
    """Evidence for an effect.

    `gain`: chi-square that the updated model loses without the effect's `parameters`; of a weak effect by a refit of
    everything, of a strong one Wald's statistic. `p_value` of that gain, corrected for the number of candidates.
    `score`: gain that the score test predicted. `cross_validation_gain`: gain on lines that the fit had not used.
    `round` in which the effect was added (0: from the channels of one cell). `empirical`: it describes the data and
    does not explain them.
    """

    gain: float
    parameters: int
    p_value: float
    score: float
    cross_validation_gain: float = field(metadata={"stored_as": "folds"})
    round: int
    empirical: bool = False


@dataclass(frozen=True)
class FoundEffect:
    """An effect of the updated model.

    `indistinguishable_from`: labels NAME@PLACE of effects that describe the data as well; `separated_by`: the
    measurement that would separate them. `choice`: name and value of a parameter that is a word. `worth`: by load
    component, what forgetting the effect does to the harmonic loads over their sigma; None where it cannot be told.
    `is_doubtful`: true where a residual is left and parts of the records disagree on the effect.
    """

    name: str
    where: tuple[str, ...]
    parameters: tuple[FittedParameter, ...]
    evidence: Evidence
    indistinguishable_from: tuple[str, ...] = ()
    separated_by: str = ""
    choice: tuple[str, str] | None = None
    worth: dict[str, float] | None = field(default=None, metadata={"omit_if_none": True})
    is_doubtful: bool | None = field(default=None, metadata={"omit_if_none": True})

    @property
    def is_of_no_consequence(self) -> bool:
        """Whether it moves no load by a tenth of its sigma."""
        return self.worth is not None and max(self.worth.values(), default=0.0) < DEFAULT_SETTINGS.worth.negligible

    @property
    def label(self) -> str:
        """NAME@PLACE,PLACE as on the command line."""
        where = self.where if self.choice is None else (*self.where, self.choice[1])
        return f"{self.name}@{','.join(where)}" if where else self.name


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One candidate in one round.

    `score`: predicted gain of chi-square, for so many `parameters`, with its corrected `p_value`. `gain` after the
    refit (NaN without a refit). `decision`: `accepted`, `rejected`, `removed` or `narrowed`, and its `reason`.
    `cross_validation_gain`: gain on lines that the fit had not used (NaN where it was not computed). `noise_dof`:
    degrees of freedom of the noise against which it was tested (None: known exactly).
    """

    round: int
    label: str
    score: float
    parameters: int
    p_value: float
    gain: float
    decision: str
    reason: str = field(default="", metadata={"stored_as": "why"})
    cross_validation_gain: float = field(default=float("nan"), metadata={"stored_as": "folds"})
    noise_dof: float | None = field(default=None, metadata={"omit_if_none": True})

    @property
    def effect_name(self) -> str:
        """The name of the effect, without its place."""
        return self.label.partition("@")[0]


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
    """An effect that the runs cannot show, and the reason."""

    name: str
    reason: str = field(metadata={"stored_as": "why"})


@dataclass(frozen=True)
class RunErrors:
    """Relative errors of a hold-out run: hub loads by component, and response; NaN where there is none."""

    load_error: dict[str, float]
    interaction: dict[str, float]
    frf_error: float


@dataclass(frozen=True)
class HoldOut:
    """Errors of a run that no fit has used, before and after updating; `noise`: those that its noise alone causes.

    `other_set_up`: what of the updated model is not in the set-up of this run, in words; None where all of it is.
    `expected`: the errors that noise and the covariance of the updated model's parameters make; None in artefacts of
    versions up to 0.2, and of sweeps.
    """

    before: RunErrors
    after: RunErrors
    noise: RunErrors
    other_set_up: str | None = field(default=None, metadata={"omit_if_none": True})
    expected: RunErrors | None = field(default=None, metadata={"omit_if_none": True})


CHANNEL, RUN = "channel", "run"
RECORD_CHANGE_TEST = "first against last periods"
"""Name of the test for a gain or delay that drifts within records: no constant effect describes that."""
RUN_CHANGE_TEST = "run against run"
"""Name of the test for a gain or delay that differs between runs: no constant effect describes that."""


@dataclass(frozen=True)
class LeftOut:
    """A `channel` or `run` (`kind`) without which the data need no effect, and chi2/dof without it.

    `likely_cause`: the effect in the channel that takes nearly all of its misfit; empty without any.
    """

    kind: str
    name: str
    chi2_per_dof: float
    likely_cause: str = ""

    @property
    def description(self) -> str:
        """One sentence, with what to do."""
        remedy = "check its range, zero and cable" if self.kind == CHANNEL else "record it again"
        cause = f"; {self.likely_cause} describes most of what it reads" if self.likely_cause else ""
        return (
            f"without {self.kind} {self.name} the model before the search describes all other data within their noise "
            f"(chi2/dof {self.chi2_per_dof:.3g}): the updated model is fitted without it; "
            f"leave it out, and {remedy}{cause}"
        )


@dataclass(frozen=True)
class ResidualMap:
    """Rms whitened residual before and after (runs, bands, channels); the noise alone gives one.

    `edges` (bands + 1,) [Hz]; NaN where a run has no line in a band. `excited`: the components of each run, joined by
    `+`, of static runs empty. `correlation_before` and `correlation_after` (channels, lags): size of the correlation of
    the whitened residuals of lines 1, 2 and so on apart, of so many `pairs` (channels, lags) of lines. None in
    artefacts that were written without them.
    """

    runs: tuple[str, ...]
    channels: tuple[str, ...]
    edges: Array
    before: Array
    after: Array
    excited: tuple[str, ...] | None = field(default=None, metadata={"omit_if_none": True})
    correlation_before: Array | None = field(default=None, metadata={"omit_if_none": True})
    correlation_after: Array | None = field(default=None, metadata={"omit_if_none": True})
    pairs: Array | None = field(default=None, metadata={"omit_if_none": True})


@dataclass(frozen=True, repr=False)
class Diagnosis(ResultView):
    """The outcome of a diagnosis.

    `verdict` as in docs/json.md; `effects` strongest first; `trials` in the order of the decisions; chi2/dof and
    response error before and after; eigenmodes before and after; `location`: where a residual remains, in words.
    `settings` with which it was made (None: an artefact that was written without them). `left_out`: what the updated
    model was fitted without. `consistency`: what the cross-checks said of the runs, None where nothing. `dof`: degrees
    of freedom of the updated fit. `is_unfinished`: true where the time limit ended the search.
    """

    geometry: Geometry
    verdict: str
    effects: tuple[FoundEffect, ...]
    trials: tuple[Trial, ...]
    data_tests: tuple[ModelFreeTest, ...] = field(metadata={"stored_as": "tests"})
    untestable_effects: tuple[UntestableEffect, ...] = field(metadata={"stored_as": "not_testable"})
    chi2_per_dof_before: float
    chi2_per_dof_after: float
    frf_error_before: float
    frf_error_after: float
    modes_before: ModeTable
    modes_after: ModeTable
    residual: ResidualMap
    candidate_count: int = field(metadata={"stored_as": "candidates"})
    location: str = ""
    hold_out: dict[str, HoldOut] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    settings: SearchSettings | None = None
    left_out: LeftOut | None = field(default=None, metadata={"omit_if_none": True})
    consistency: tuple[str, ...] | None = field(default=None, metadata={"omit_if_none": True})
    dof: float | None = field(default=None, metadata={"omit_if_none": True})
    is_unfinished: bool | None = field(default=None, metadata={"omit_if_none": True})

    @property
    def meaning(self) -> str:
        """What the verdict means, in words."""
        if self.is_unfinished and self.verdict in (PARTLY_EXPLAINED, UNEXPLAINED):
            return "the time limit ended the search before the data were explained; a longer one may find more"
        if self.verdict == PARTLY_EXPLAINED and self.left_out is not None:
            return f"the model describes all data but those of {self.left_out.kind} {self.left_out.name}, left out"
        if self.verdict == PARTLY_EXPLAINED and not self.effects:
            return "no candidate is significant, but a note says what no effect explains"
        return VERDICT_MEANING[self.verdict]

    def summary_lines(self) -> Iterator[str]:
        """Verdict, chi2/dof before and after, the effects, what is not testable, hold-out runs."""
        yield f"Diagnosis of {self.geometry.rig}: {self.verdict}"
        yield f"  chi2/dof {self.chi2_per_dof_before:.4g} before, {self.chi2_per_dof_after:.4g} after"
        if self.effects:
            shown = ", ".join(effect.label for effect in self.effects[:4])
            more = f" and {len(self.effects) - 4} more" if len(self.effects) > 4 else ""
            yield f"  {plural(len(self.effects), 'effect')}: {shown}{more}"
        if self.left_out is not None:
            yield f"  fitted without {self.left_out.kind} {self.left_out.name}"
        if self.untestable_effects:
            yield f"  {plural(len(self.untestable_effects), 'effect')} not testable with these runs"
        if self.hold_out:
            yield f"  hold-out runs: {', '.join(self.hold_out)}"

    def to_frame(self) -> pd.DataFrame:
        """One row for each parameter of each effect found, strongest effect first."""
        import pandas as pd

        rows = [
            {
                "effect": effect.name,
                "where": ",".join(effect.where),
                "parameter": parameter.name,
                "value": parameter.value,
                "sigma": parameter.sigma,
                "unit": parameter.unit,
                "gain": effect.evidence.gain,
                "p_value": effect.evidence.p_value,
                "indistinguishable_from": "; ".join(effect.indistinguishable_from),
            }
            for effect in self.effects
            for parameter in effect.parameters
        ]
        return pd.DataFrame(rows, columns=list(EFFECT_TABLE_COLUMNS))
