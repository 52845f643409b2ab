"""Records of what was tried: of candidates that were scored, and of effects that were judged by refits alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.score_statistics import Score


def last_round(trials: Sequence[Trial]) -> int:
    """Return the number of the last round; 0 where there was none."""
    return max((trial.round for trial in trials), default=0)


def make_trial(
    number: int, score: Score, count: int, gain: float, accepted: bool, reason: str, validation: float = float("nan")
) -> Trial:
    """Return the trial of one of `count` candidates in round `number`.

    `gain` of its refit, and `validation`, its gain on other lines.
    """
    return Trial(
        round=number,
        label=score.candidate.label,
        score=score.gain,
        parameters=score.parameters,
        p_value=min(1.0, count * score.p_value),
        gain=gain,
        decision="accepted" if accepted else "rejected",
        reason=reason,
        cross_validation_gain=validation,
        noise_dof=float(score.noise_dof) if np.isfinite(score.noise_dof) else None,
    )


def refit_trial(
    number: int, label: str, gain: float, decision: str, reason: str, parameters: int = 1, score: float = float("nan")
) -> Trial:
    """Return the trial in round `number` of an effect that was judged by refits, without a test of its own."""
    return Trial(
        round=number,
        label=label,
        score=score,
        parameters=parameters,
        p_value=1.0,
        gain=gain,
        decision=decision,
        reason=reason,
    )
