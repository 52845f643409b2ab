"""An update with effects that describes the data worse than the model before it leaves that model as it was."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.diagnosis.model_update import UpdateResult
from balance_cli.diagnosis.selection.confirm import ConfirmedFit
from balance_cli.diagnosis.selection.fit import Fit, fit_all_lines
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.diagnosis.worse_update import REASON_WORSE, refuse_worse_update
from balance_cli.estimation.likelihood import data_chi2
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model import effects
from balance_cli.model.balance import balance_model
from balance_cli.model.placed_effects import add_effects, declared_effects
from tests.estimation.test_likelihood import noisy_lines
from tests.support.rigs import rotor_balance

SETTINGS = replace(
    DEFAULT_SETTINGS, excluded=tuple(effect.name for effect in effects.EFFECTS if effect.name != "channel-gain")
)


@pytest.fixture(scope="module")
def update():
    """A rig without effects, fitted to its lines, and an update of it with the gain of a channel."""
    rig = rotor_balance()
    batches = stack_runs([noisy_lines(rig, np.random.default_rng(4))], [], rig.channel_names)
    start = fit_all_lines(balance_model(rig).at(), batches, SETTINGS.fit)
    model = balance_model(add_effects(rig, [f"channel-gain@{rig.channel_names[0]}"]))
    fit = fit_all_lines(model.at(), batches, SETTINGS.fit)
    return start, UpdateResult(fit, {}, (), ConfirmedFit(fit), True), batches


def test_an_update_that_describes_the_data_better_stays(update):
    start, better, batches = update
    assert refuse_worse_update(start, batches, better, SETTINGS) is better


def test_one_that_describes_them_worse_is_refused_with_its_effects(update):
    start, better, batches = update
    theta = better.fit.theta.copy()
    (gain,) = declared_effects(better.fit.model.geometry)
    theta[better.fit.model.parameters.index(f"{gain.label}.gain")] += 0.1
    worse = replace(better, fit=Fit.at_minimum(better.fit.model, replace(better.fit.minimum, theta=theta)))
    refused = refuse_worse_update(start, batches, worse, SETTINGS)
    assert declared_effects(refused.fit.model.geometry) == ()
    assert not refused.is_good
    (trial,) = refused.trials
    assert (trial.label, trial.decision, trial.reason) == (gain.label, "removed", REASON_WORSE)
    assert trial.gain < 0
    kept = data_chi2(batches, refused.fit.model.system(refused.fit.theta))
    assert kept <= data_chi2(batches, start.model.system(start.theta)) * (1 + 1e-6)
    assert refused.confirmation.smallest_p_value > SETTINGS.selection.significance_level
