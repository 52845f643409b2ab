"""What the loop tried, put down."""

from __future__ import annotations

from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.score_statistics import Score


def make_trial(
    number: int, score: Score, count: int, gain: float, accepted: bool, why: str, folds: float = float("nan")
) -> Trial:
    """One of `count` candidates in round `number`, with what its refit gained, there and on other lines."""
    return Trial(
        round=number,
        label=score.candidate.label,
        score=score.gain,
        parameters=score.parameters,
        p_value=min(1.0, count * score.p_value),
        gain=gain,
        decision="accepted" if accepted else "rejected",
        why=why,
        folds=folds,
    )
