"""Scores of the model that is reported: effects may have been dropped or replaced since the last round."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.diagnosis.search import score_statistics
from balance_cli.diagnosis.search.candidates import candidate_at, candidates
from balance_cli.diagnosis.search.extended_models import extend_model, free_names
from balance_cli.diagnosis.search.score_statistics import scores
from balance_cli.diagnosis.selection import confirm as confirm_module
from balance_cli.diagnosis.selection.confirm import ConfirmedFit, score_again
from balance_cli.diagnosis.selection.effect_selection import refit_without_effect
from balance_cli.diagnosis.selection.fit import fit_all_lines
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model import effects
from balance_cli.model.balance import balance_model
from balance_cli.model.placed_effects import add_effects, declared_effects
from tests.estimation.test_likelihood import noisy_lines
from tests.support.rigs import rotor_balance

DELAY = 2e-3
LIKE_A_DELAY = ("time-delay", "low-pass")
TRIED = ("time-delay", "channel-gain", "low-pass", "parallel-stiffness", "support-flexibility")
SETTINGS = replace(
    DEFAULT_SETTINGS, excluded=tuple(effect.name for effect in effects.EFFECTS if effect.name not in TRIED)
)


@pytest.fixture(scope="module")
def late_channel():
    """The fit of a rig with a late channel, and its lines."""
    rig = rotor_balance()
    late = add_effects(rig, [f"time-delay@{rig.channel_names[0]}"])
    truth = late.model_copy(update={"effects": (late.effects[0].model_copy(update={"parameters": {"delay": DELAY}}),)})
    batches = stack_runs([noisy_lines(truth, np.random.default_rng(4))], [], rig.channel_names)
    return fit_all_lines(extend_model(balance_model(rig).at(), truth), batches, SETTINGS.fit), batches


def test_the_smallest_p_value_is_that_of_the_model_without_a_dropped_effect(late_channel):
    """With the delay nothing is missing; the confirmation of that model says nothing about one without it."""
    fit, batches = late_channel
    (effect,) = declared_effects(fit.model.geometry)
    with_delay = score_again(ConfirmedFit(fit), fit, batches, SETTINGS)
    assert with_delay.smallest_p_value > SETTINGS.selection.significance_level
    reduced = refit_without_effect(fit, effect, batches, SETTINGS.fit)
    without = score_again(with_delay, reduced, batches, SETTINGS)
    assert without.smallest_p_value < SETTINGS.selection.significance_level
    first, second = sorted(without.scores, key=lambda score: -score.gain)[:2]
    # At its null a low-pass has the derivative of a delay: which of them is first, rounding decides.
    assert {first.candidate.label, second.candidate.label} == {effect.label, effect.label.replace(*LIKE_A_DELAY)}
    assert second.gain == pytest.approx(first.gain, rel=1e-9)
    refused = replace(with_delay, refused=frozenset(score.candidate.label for score in without.scores))
    assert score_again(refused, reduced, batches, SETTINGS).smallest_p_value == 1.0


def test_a_model_that_was_scored_is_not_scored_again(late_channel, monkeypatch):
    fit, batches = late_channel
    labels = frozenset(effect.label for effect in declared_effects(fit.model.geometry))
    confirmation = ConfirmedFit(fit, smallest_p_value=0.3, scored=labels)
    monkeypatch.setattr(confirm_module, "score_in_two_stages", None)
    assert score_again(confirmation, fit, batches, SETTINGS) is confirmation


def test_a_leading_candidate_keeps_the_number_of_its_start(late_channel):
    """On all lines it is scored at the best start of the subset alone, and is fitted from there."""
    fit, batches = late_channel
    few = replace(SETTINGS, score=replace(SETTINGS.score, screening_lines=10))
    pool = confirm_module.candidates(fit.model.geometry, excluded=SETTINGS.excluded)
    several = [item for item in pool if len(item.starts) > 1]
    assert several
    scored = score_statistics.score_in_two_stages(fit, batches, several, few)
    scores = {score.candidate.label: score for score in scored}
    for item in several:
        score = scores[item.label]
        assert score.candidate.starts == item.starts
        (alone,) = score_statistics.scores(fit, batches, [replace(item, starts=(item.starts[score.start],))], few.score)
        assert score.gain == pytest.approx(alone.gain, rel=1e-6, abs=1e-9)


def test_starts_that_are_scored_together_score_as_each_alone(late_channel):
    fit, batches = late_channel
    candidate = candidate_at("structural-damping", ("all",), fit.model.geometry)
    assert len(candidate.starts) > 1
    (together,) = score_statistics.scores(fit, batches, [candidate], SETTINGS.score)
    alone = [
        score_statistics.scores(fit, batches, [replace(candidate, starts=(start,))], SETTINGS.score)[0]
        for start in candidate.starts
    ]
    best = max(alone, key=lambda score: score.gain)
    assert together.start == alone.index(best)
    assert together.gain == pytest.approx(best.gain, rel=1e-9)
    assert together.fitted_step == pytest.approx(best.fitted_step, rel=1e-6, abs=1e-12)
    assert len({round(score.gain, 6) for score in alone}) > 1


def test_scores_in_small_groups_are_those_of_all_candidates_at_once(late_channel, monkeypatch):
    """Derivatives of groups take less memory; the fitted parameters are projected out of each group alike."""
    fit, batches = late_channel
    pool = candidates(fit.model.geometry, excluded=SETTINGS.excluded)
    at_once = scores(fit, batches, pool, SETTINGS.score)
    counts = []

    def count(batch, *rest):
        result = project(batch, *rest)
        counts.append(len(result))
        return result

    project = score_statistics.project_out_fitted
    monkeypatch.setattr(score_statistics, "project_out_fitted", count)
    monkeypatch.setattr(score_statistics, "MAX_DERIVATIVE_BYTES", 0)
    in_groups = scores(fit, batches, pool, SETTINGS.score)
    starts = sum(score_statistics._is_new_null(item, k) for item in pool for k in range(len(item.starts)))
    assert sum(counts) == starts
    assert max(counts) <= len(free_names(fit.model)) < starts
    for group, whole in zip(in_groups, at_once, strict=True):
        assert (group.candidate.label, group.start) == (whole.candidate.label, whole.start)
        assert (group.gain, group.noise_dof) == pytest.approx((whole.gain, whole.noise_dof), rel=1e-6, abs=1e-6)
        np.testing.assert_allclose(group.step, whole.step, rtol=1e-5, atol=1e-12 * np.abs(whole.step).max())
