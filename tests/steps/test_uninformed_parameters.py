"""A free parameter that changes nothing in the data is as unknown as its scale, not exact."""

from __future__ import annotations

import numpy as np

from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from balance_cli.steps.identify import IdentifyOptions, identified_effects, identify
from tests.support.rigs import one_degree_of_freedom


def test_a_spring_across_the_only_motion_has_the_sigma_of_its_scale() -> None:
    """Stiffness along x and y on a rig that moves in z had been 400 +- 0 N/m."""
    plan = SweepPlan(run="sweep", excited=("Fz",), level=(50.0,), period=2.0, periods=4, band=(5.0, 80.0))
    runs = simulate_campaign(true_rig(one_degree_of_freedom()), CampaignPlan(runs=(plan,)), seed=1).runs
    geometry = one_degree_of_freedom(effects=[{"name": "parallel-stiffness"}])
    model = identify(measured_spectra(runs, geometry), geometry, IdentifyOptions())
    (effect,) = identified_effects(model)
    found = {parameter.name: parameter for parameter in effect.parameters}
    for name in ("stiffness_x", "stiffness_y"):
        assert found[name].sigma >= 0.9 * abs(found[name].value) > 0.0
    assert 0.0 < found["stiffness_z"].sigma < np.inf
