"""Fits that are compared: those that may be the best ones are finished, the others are not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from balance_cli.diagnosis.search.candidates import candidate_at
from balance_cli.diagnosis.search.extended_models import extend_model
from balance_cli.diagnosis.search.score_statistics import apply_score_step, scores
from balance_cli.diagnosis.selection.fit import approach_on_some_lines, fit_all_lines, fit_contenders
from balance_cli.diagnosis.selection.mains_frequency import frequency_grid
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.estimation.maximum_likelihood import penalized_chi2
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from balance_cli.model.placed_effects import add_effects
from tests.estimation.test_likelihood import noisy_lines
from tests.support.rigs import rotor_balance

LATE = 2e-4
HURRIED = replace(SETTINGS.fit, contender_steps=1)


def declare(rig, label, **parameters):
    """The rig with an effect of these parameters."""
    extended = add_effects(rig, [label])
    return extended.model_copy(
        update={"effects": (*rig.effects, extended.effects[-1].model_copy(update={"parameters": parameters}))}
    )


@pytest.fixture(scope="module")
def late_channel():
    """A rig, the label of its late channel, and lines of it."""
    rig = rotor_balance()
    label = f"time-delay@{rig.channel_names[0]}"
    truth = declare(rig, label, delay=LATE)
    return rig, label, stack_runs([noisy_lines(truth, np.random.default_rng(4))], [], rig.channel_names)


def started(rig, label):
    """The model of a rig with an effect at its null, and its declared parameters."""
    model = balance_model(rig)
    return extend_model(model.at(), declare(rig, label))


def test_a_fit_that_cannot_reach_the_best_one_is_not_finished(late_channel):
    rig, label, batches = late_channel
    other = label.replace(rig.channel_names[0], rig.channel_names[1])
    starts = [started(rig, other), started(rig, label)]
    hopeless, best = fit_contenders(starts, batches, np.inf, SETTINGS.indistinguishable_chi2, HURRIED)
    finished = [fit_all_lines(start, batches, SETTINGS.fit) for start in starts]
    assert best.minimum.converged
    assert best.chi2 == pytest.approx(finished[1].chi2, abs=SETTINGS.fit.comparison_tolerance)
    assert hopeless.minimum.iterations == 1
    assert hopeless.chi2 > finished[0].chi2 > best.chi2 + 1e3


def test_near_fits_are_all_finished(late_channel):
    """At small delays a low-pass describes the same."""
    rig, label, batches = late_channel
    starts = [started(rig, label), started(rig, label.replace("time-delay", "low-pass"))]
    fits = fit_contenders(starts, batches, np.inf, np.inf, HURRIED)
    assert all(fit.minimum.converged for fit in fits)


def test_none_is_finished_above_the_limit(late_channel):
    rig, label, batches = late_channel
    fits = fit_contenders([started(rig, label)], batches, 0.0, 6.0, HURRIED)
    assert fits[0].minimum.iterations == 1


def test_a_fit_begins_on_some_lines_and_ends_where_that_of_all_does(late_channel):
    rig, label, batches = late_channel
    start, count = started(rig, label), sum(len(batch.lines.index) for batch in batches)
    near = approach_on_some_lines(start, batches, replace(SETTINGS.fit, coarse_lines=count // 3))
    whole, rest = (fit_all_lines(one, batches, SETTINGS.fit) for one in (start, near))
    assert penalized_chi2(near, batches) - whole.chi2 < 0.05 * (penalized_chi2(start, batches) - whole.chi2)
    assert rest.minimum.iterations <= whole.minimum.iterations
    assert rest.chi2 == pytest.approx(whole.chi2, abs=SETTINGS.fit.comparison_tolerance)
    assert approach_on_some_lines(start, batches, replace(SETTINGS.fit, coarse_lines=count)) is start


def test_a_step_of_a_score_leaves_no_parameter_beyond_its_bound(late_channel):
    """The fitted parameters follow the candidate: a loss factor of zero would become negative."""
    rig, label, batches = late_channel
    damped = declare(rig, "structural-damping@all", loss_factor=0.0, causality=0.0)
    start = extend_model(balance_model(rig).at(), damped)
    name = "structural-damping@all.loss_factor"
    candidate = candidate_at("time-delay", (label.split("@")[1],), start.geometry)
    (score,) = scores(start, batches, [candidate], SETTINGS.score)
    free = [
        item for item, is_free in zip(start.model.parameters.names, start.model.parameters.free, strict=True) if is_free
    ]
    assert score.fitted_step[free.index(name)] < 0.0
    stepped = apply_score_step(start, batches, score, SETTINGS.score)
    assert stepped.theta[stepped.model.parameters.index(f"{label}.delay")] > 0.5 * LATE
    assert stepped.theta[stepped.model.parameters.index(name)] == 0.0


@pytest.mark.parametrize(("fitted", "centers"), [(50.15, [50.15]), (48.86, [48.86, 50.0]), (61.0, [61.0, 60.0])])
def test_a_tone_that_left_its_start_is_searched_there_too(fitted, centers):
    """In short random records, whose noise contains the tone, a fit from 50 Hz had ended at 48.86 Hz."""
    rig = rotor_balance()
    effect = candidate_at("mains-pickup", (rig.channel_names[0],), rig).placed_effect
    fit = SimpleNamespace(geometry=rig)
    frequency = frequency_grid(fitted, effect, fit, SETTINGS.mains)
    assert frequency.min() == pytest.approx(min(centers) - SETTINGS.mains.search_range)
    assert frequency.max() == pytest.approx(max(centers) + SETTINGS.mains.search_range)
    assert all(np.min(np.abs(frequency - center)) < SETTINGS.mains.spacing for center in centers)
    assert len(frequency) == len(centers) * 201
