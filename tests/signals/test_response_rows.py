"""Rows of static runs for comparisons: loads without the weight of the rig in each attitude."""

import numpy as np

from balance_cli.calibration.tare_result import weight_loads
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.attitude import gravity_directions
from balance_cli.diagnosis.consistency.campaign import campaign_findings
from balance_cli.signals.response_rows import response_rows
from tests.support.static_runs import C0, RIG, loading, rigid_matrix

NAMES = tuple(channel.name for channel in RIG.channels if channel.measures_dc)
ATTITUDES = np.array([[0.0, 0.0], [90.0, 0.0], [-90.0, 0.0], [0.0, 90.0]])


def tilted_run(sign=1.0):
    """A static run in four attitudes, whose weight changes the channels more than the loads do; `sign` of z1.strain."""
    attitude = np.repeat(ATTITUDES, len(loading()), axis=0)
    loads = np.tile(0.1 * loading(), (len(ATTITUDES), 1))
    weight = weight_loads(gravity_directions(attitude)) @ (1500.0 * np.array([1.0, 0.02, -0.01, -0.7]))
    channels = 0.2 + loads @ C0.T + weight @ rigid_matrix(RIG, on_plate=True).T
    channels = channels + 1e-5 * np.random.default_rng(1).normal(size=channels.shape)
    channels[:, NAMES.index("z1.strain")] *= sign
    source = MemorySource(channels, loads)
    return Run("s1", RIG.rig, "static", NAMES, len(loads), source, trim="a", attitude=attitude)


def test_load_points_count_from_the_mean_of_their_attitude():
    rows = response_rows(tilted_run(), NAMES)
    np.testing.assert_allclose(rows.channels, rows.loads @ C0.T, atol=1e-4)


def test_a_reversed_channel_is_named_in_spite_of_the_weight():
    """It was not: the weight in four attitudes was taken for readings of the loads, and hid it in the sweeps, too."""
    assert not campaign_findings(RIG, [tilted_run()])
    (finding,) = campaign_findings(RIG, [tilted_run(-1.0)])
    assert "z1.strain" in finding.text and "reversed" in finding.text
