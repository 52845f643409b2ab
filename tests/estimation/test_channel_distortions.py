"""Channels that saturate: what they lack is taken back from a record, within what they can read at all."""

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.estimation.nonlinear_contribution import remove_nonlinear_contribution
from balance_cli.model.balance import balance_model
from balance_cli.simulation import NO_NOISE, simulate_run, true_rig
from balance_cli.simulation.rig import apply_effects
from tests.support.other_rigs import other_rig, short_campaign

RIG = other_rig("A")
CHANNEL = RIG.channel_names.index("l2.strain")


def saturated(compression):
    return DeclaredEffect(name="saturation", where=("l2.strain",), parameters={"compression": compression})


@pytest.fixture(scope="module")
def wind_runs():
    """A wind run of the rig, without noise, and the same with a channel that reads at most 1.29 V."""
    plan = next(run for run in short_campaign("A", revolutions=30).runs if run.kind == "wind")
    rigs = (true_rig(RIG), apply_effects(true_rig(RIG), [saturated(0.6)]))
    return [simulate_run(rig, plan, NO_NOISE)[0] for rig in rigs]


def without_distortion(run, compression):
    geometry = RIG.model_copy(update={"effects": (saturated(compression),)})
    return remove_nonlinear_contribution(run, balance_model(geometry).system(), geometry, RIG.channel_names)


def test_a_record_gets_back_what_its_channel_lost(wind_runs):
    """But for the mean, which the static calibration with the same channel accounts for."""
    linear, lost, found = (
        run.read().channels[200:-200, CHANNEL] for run in (*wind_runs, without_distortion(wind_runs[1], 0.6))
    )
    size = linear.std()
    assert np.std(lost - linear) > 0.2 * size
    assert np.std(found - linear) < 5e-4 * size
    assert found.mean() == pytest.approx(lost.mean(), abs=1e-2 * size)


def test_a_channel_cannot_read_more_than_its_saturation_lets_through(wind_runs):
    with pytest.raises(np.linalg.LinAlgError, match="largest reading"):
        without_distortion(wind_runs[0], 1.0)
