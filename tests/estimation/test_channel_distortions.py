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
    return without_effect(run, saturated(compression))


def without_effect(run, effect):
    geometry = RIG.model_copy(update={"effects": (effect,)})
    return remove_nonlinear_contribution(run, balance_model(geometry).system(), geometry, RIG.channel_names)


def test_a_record_gets_back_what_its_channel_lost(wind_runs):
    """Its mean is that at rest, at the mean load: the static calibration with the same channel accounts for it."""
    linear, lost, found = (
        run.read().channels[200:-200, CHANNEL] for run in (*wind_runs, without_distortion(wind_runs[1], 0.6))
    )
    size = linear.std()
    assert np.std(lost - linear) > 0.2 * size
    assert np.std(found - linear) < 5e-4 * size
    mean = wind_runs[0].read().channels[:, CHANNEL].mean()
    lost_at_rest = mean - np.tanh(np.sqrt(0.6) * mean) / np.sqrt(0.6)
    assert abs(np.mean(linear - lost) - lost_at_rest) > 0.05 * size
    assert np.mean(linear - found) == pytest.approx(lost_at_rest, abs=3e-3 * size)


def test_a_channel_cannot_read_more_than_its_saturation_lets_through(wind_runs):
    with pytest.raises(np.linalg.LinAlgError, match="largest reading"):
        without_distortion(wind_runs[0], 1.0)


BRIDGES = tuple(name for name in RIG.channel_names if name.endswith(".strain"))
CURVED = DeclaredEffect(
    name="channel-nonlinearity",
    where=("strain",),
    parameters={f"quadratic_{name}": (-1) ** i * 0.02 for i, name in enumerate(BRIDGES)},
)


def test_nonlinear_bridges_read_at_each_mean_load_what_they_read_at_rest():
    """Vibration adds the mean of its square to their readings, and the mean load changes their gain."""
    plan = next(run for run in short_campaign("A", revolutions=30).runs if run.kind == "wind")
    linear, recorded = (
        simulate_run(rig, plan, NO_NOISE)[0] for rig in (true_rig(RIG), apply_effects(true_rig(RIG), [CURVED]))
    )
    found = without_effect(recorded, CURVED)
    for i, name in enumerate(BRIDGES):
        u, v, w = (run.read().channels[:, RIG.channel_names.index(name)] for run in (linear, recorded, found))
        at_rest = (-1) ** i * 0.02 * u.mean() ** 2
        inside, size = slice(200, -200), u.std()
        assert np.std((v - u)[inside]) > 1e-3 * size and abs(np.mean((v - u)[inside]) - at_rest) > 1e-3 * size
        assert np.std((w - u)[inside]) < 2e-5 * size and abs(np.mean((w - u)[inside]) - at_rest) < 2e-5 * size, name


def test_a_bridge_cannot_read_what_its_nonlinearity_does_not_reach(wind_runs):
    curved = DeclaredEffect(name="channel-nonlinearity", where=("l2.strain",), parameters={"quadratic": -1.0})
    with pytest.raises(np.linalg.LinAlgError, match="does not let it read"):
        without_effect(wind_runs[0], curved)
