"""First steps of a candidate whose starting values lead nowhere."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.diagnosis.search import refit
from balance_cli.diagnosis.search.candidates import candidate_at
from balance_cli.diagnosis.search.extended_models import extend_model
from balance_cli.diagnosis.search.refit import fit_partially, fit_until_stable
from balance_cli.diagnosis.search.score_statistics import add_scored_candidate, scores
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.maximum_likelihood import penalized_chi2
from balance_cli.estimation.model_error import add_model_error
from balance_cli.model.balance import balance_model
from tests.diagnosis.test_restarts import search_lines_of, supported_model
from tests.support.rigs import two_degrees_of_freedom


@pytest.fixture
def _no_steps(monkeypatch):
    """A fit that stays where it begins, as one behind a ridge of chi-square does."""
    monkeypatch.setattr(refit, "take_steps", lambda model, theta, *_: theta)
    monkeypatch.setattr(refit, "start_from_equations_of_motion", lambda *arguments: arguments[-1])


@pytest.mark.usefixtures("_no_steps")
def test_a_candidate_whose_starts_lose_begins_at_the_step_of_its_score():
    lines, rigid = search_lines_of(supported_model(softness=0.02)), balance_model(two_degrees_of_freedom())
    state = fit_until_stable(rigid, rigid.parameters.value.copy(), lines, DEFAULT_SETTINGS.fit)
    batches = add_model_error(lines.fitted, state.shares)
    candidate = candidate_at("support-flexibility", ("z", "theta"), state.geometry)
    (score,) = scores(state.model, state.theta, batches, [candidate], DEFAULT_SETTINGS.score)
    start = candidate.starts[score.start]
    soft = {name: 1e4 * value if name.startswith("compliance") else value for name, value in start.items()}
    misleading = replace(score, candidate=replace(candidate, starts=(soft,)), start=0)
    before = penalized_chi2(state.model, state.theta, batches)
    begun = extend_model(state.model, state.theta, add_scored_candidate(state.geometry, misleading))
    assert penalized_chi2(*begun, batches) > before
    partial = fit_partially(state, misleading, lines, DEFAULT_SETTINGS)
    assert penalized_chi2(partial.model, partial.theta, batches) < before
    assert 0.0 < partial.gain < np.inf
