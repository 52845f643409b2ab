"""Which of the leading candidates of a search round are refitted."""

import numpy as np

from balance_cli.diagnosis.search import rounds
from balance_cli.diagnosis.search.candidates import candidates
from balance_cli.diagnosis.search.refit import PartialFit
from balance_cli.diagnosis.search.score_statistics import Score
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from tests.support.rigs import two_degrees_of_freedom

SHARE = DEFAULT_SETTINGS.rounds.min_rival_score_share
GAIN = 1000.0


def first_steps(monkeypatch, scores):
    """The effects that take first steps: that with nuisance parameters gains GAIN, whatever its score."""

    def fit(state, score, lines, settings):
        gain = GAIN if score.candidate.effect.name == "parallel-stiffness" else score.gain
        return PartialFit(None, np.zeros(0), gain)

    monkeypatch.setattr(rounds, "fit_partially", fit)
    pool = {item.effect.name: item for item in candidates(two_degrees_of_freedom())}
    nothing = np.zeros(0)
    leading = [Score(pool[name], 0, gain, 1, gain, 100.0, nothing, nothing, nothing) for name, gain in scores.items()]
    fits = rounds._fit_leading(None, leading, None, DEFAULT_SETTINGS)
    return [score.candidate.effect.name for score, _ in fits]


def test_a_score_that_predicts_far_less_than_another_gained_is_not_refitted(monkeypatch):
    scores = {"time-delay": 1.1 * SHARE * GAIN, "load-gain": 0.9 * SHARE * GAIN, "parallel-stiffness": 10.0}
    assert first_steps(monkeypatch, scores) == ["parallel-stiffness", "time-delay"]


def test_without_nuisance_parameters_all_leading_ones_are(monkeypatch):
    scores = {"time-delay": 500.0, "load-gain": 50.0}
    assert first_steps(monkeypatch, scores) == ["time-delay", "load-gain"]
