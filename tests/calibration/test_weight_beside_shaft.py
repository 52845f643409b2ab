"""The weight of the metric part does not go through the torque meter of a shaft, and attitudes it cannot explain."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.calibration.attitude_contradiction import undetermined_weight_notes
from balance_cli.calibration.outliers import screen_outliers
from balance_cli.calibration.tare_result import weight_loads
from balance_cli.calibration.tares import screen_outliers_with_tares
from balance_cli.calibration.term_choice import LINEAR_TERMS
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.attitude import gravity_directions
from balance_cli.reduction.mean_attitude import LEVEL, zero_in_attitude
from balance_cli.reduction.wind_off import ZeroRecord
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.point_temperature import point_loads_at_temperature
from balance_cli.steps.point_zeros import PointReadings, ZeroReading
from tests.calibration.test_tares import tilted_stand
from tests.support.rigs import rotor_balance
from tests.support.static_runs import loading, rigid_matrix

WEIGHT, CENTER = 1500.0, np.array([0.05, -0.08, -0.6])
"""Of the metric part: N, m from the hub."""
W = np.r_[WEIGHT, WEIGHT * CENTER]
TILTS = np.array([[0.0, 0.0], [90.0, 0.0], [0.0, 90.0], [-90.0, 0.0], [20.0, -30.0]])
NOISE = 2e-4
QUARTERS = np.array([[0.0, 0.0], [90.0, 0.0], [0.0, 90.0], [-60.0, 0.0], [0.0, -30.0]])


def rig(axis, carried_by):
    geometry = rotor_balance()
    meter = geometry.torque_meter.model_copy(update={"axis": axis, "carried_by": carried_by})
    return geometry.model_copy(update={"torque_meter": meter})


def weight_readings(geometry, attitude):
    """Readings (m, c) of the weight, a wrench on the plate, by equilibrium."""
    return weight_loads(gravity_directions(attitude)) @ W @ rigid_matrix(geometry, on_plate=True).T


@pytest.fixture(scope="module", params=[("z", "ground"), ("x", "plate"), ("x", "ground")], ids=" ".join)
def tilted(request):
    """A rig, and its calibration by weights in five attitudes."""
    geometry = rig(*request.param)
    one = loading()
    attitude, loads = np.repeat(TILTS, len(one), axis=0), np.tile(one, (len(TILTS), 1))
    read = 0.3 + loads @ rigid_matrix(geometry).T + weight_readings(geometry, attitude)
    read = read + NOISE * np.random.default_rng(4).normal(size=read.shape)
    names = tuple(c.name for c in geometry.channels if c.measures_dc)
    run = Run("s1", geometry.rig, "static", names, len(loads), MemorySource(read, loads), trim="a", attitude=attitude)
    return geometry, calibrate([run], geometry, LINEAR_TERMS)


def test_the_weight_is_told_beside_the_shaft(tilted):
    """The zeros were those of a weight through the meter: chi2/dof 1500, center of gravity 24 sigma off."""
    tares = tilted[1].all_trims.tares
    assert tares.chi2_per_dof < 1.6
    assert np.all(np.abs(tares.w - W) < 4.0 * np.sqrt(np.diag(tares.w_covariance)))
    assert tares.weight_sigma < 2e-3 * WEIGHT and np.all(
        np.abs(tares.natural_zeros - 0.3) < 4 * tares.natural_zeros_sigma
    )


@pytest.mark.parametrize("zero_attitude", [None, (0.0, 0.0), (0.0, 40.0)])
def test_loads_of_points_in_other_attitudes(tilted, zero_attitude):
    geometry, calibration = tilted
    names = calibration.all_trims.model.channel_names
    attitude = np.array([[0.0, 0.0], [10.0, -25.0], [0.0, -90.0], [180.0, 0.0]])
    applied = np.random.default_rng(3).uniform(-0.5, 0.5, (4, 6)) * [800, 800, 3500, 400, 400, 450]
    read = 0.3 + applied @ rigid_matrix(geometry).T + weight_readings(geometry, attitude)
    group = np.zeros(4, int)
    readings = PointReadings("t", names, read, group, group > 0, gravity=gravity_directions(attitude))
    zero = None
    if zero_attitude is not None:
        mean = 0.3 + weight_readings(geometry, [zero_attitude])[0]
        zero = ZeroReading(names, mean, 3, gravity=gravity_directions([zero_attitude])[0])
    loads = point_loads_at_temperature(readings, calibration, zero)
    assert np.all(np.abs(loads.loads - applied) < 4.0 * loads.sigma)
    assert not any("redundancy" in flag for flag in loads.flags)


def test_a_zero_is_turned_to_the_attitude_of_the_run(tilted):
    """Its weight then changed the readings as hub loads do, so that no redundant channel contradicts them."""
    geometry, calibration = tilted
    names = calibration.all_trims.model.channel_names
    attitude = [12.0, -25.0]
    of_zero, of_run = weight_readings(geometry, [[0.0, 0.0], attitude])
    zero = ZeroRecord("z", names, of_zero, np.ones(len(names)), gravity=LEVEL)
    gravity = gravity_directions([attitude])[0]
    change = of_run - zero_in_attitude(zero, gravity, calibration).mean
    as_loads = weight_loads(np.stack([gravity, LEVEL])) @ W
    expected = rigid_matrix(geometry) @ (as_loads[0] - as_loads[1])
    np.testing.assert_allclose(change, expected, atol=3e-3 * np.max(np.abs(expected)))
    assert zero_in_attitude(zero, None, calibration) is zero


# ---- attitudes that are wrong ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        (QUARTERS * [-1, 1], "the other sign of `pitch`"),
        (QUARTERS * [1, -1], "the other sign of `roll`"),
        (QUARTERS[:, ::-1], "`pitch` and `roll` exchanged"),
        (np.radians(QUARTERS), "angles in rad that are stated as deg"),
        (None, "the weight is negative"),
    ],
)
def test_attitudes_that_the_zeros_contradict_are_named(stated, words):
    """A weight of them was taken off the loads: with the other sign of the pitch 116 N in place of 138."""
    points = tilted_stand(2, False, QUARTERS)
    place = points.load_series % len(QUARTERS)
    wrong = -points.gravity if stated is None else gravity_directions(stated[place])
    contradicted = replace(points, gravity=wrong)
    total, _, tares = screen_outliers_with_tares(contradicted, LINEAR_TERMS)
    (note,) = undetermined_weight_notes(contradicted, screen_outliers(contradicted, LINEAR_TERMS).fit)
    assert tares is None and total is contradicted
    assert "contradict the stated attitudes" in note and words in note
    assert stated is not None or "gravity along (-x, -y, -z)" in note
