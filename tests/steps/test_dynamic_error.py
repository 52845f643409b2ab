"""Loads by the static matrix: sigma covers what the dynamics change in them."""

import numpy as np
import pytest

from balance_cli.reduction.response_sources import static_source
from balance_cli.simulation import CampaignPlan, draw_rig, simulate_campaign
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.reduce import reduce_run
from tests.support.other_rigs import other_rig, short_campaign


@pytest.mark.parametrize("letter", ["A", "C"])
def test_intervals_of_loads_by_the_static_matrix_contain_the_truth(letter):
    geometry = other_rig(letter)
    plan = short_campaign(letter, revolutions=120)
    kept = CampaignPlan(runs=tuple(run for run in plan.runs if run.kind in ("static", "check")))
    campaign = simulate_campaign(draw_rig(geometry, np.random.default_rng(4)), kept, seed=4)
    calibration = calibrate([run for run in campaign.runs if run.kind == "static"], geometry)
    for run, truth in zip(campaign.runs[2:], campaign.truths[2:], strict=True):
        loads = reduce_run(run, geometry, calibration, static_source(calibration))
        error = (loads.amplitude - (truth.cosine - 1j * truth.sine)[: len(loads.amplitude)])[1:]
        inside = np.abs(error.real) < 1.96 * loads.sigma_cosine[1:]
        inside &= np.abs(error.imag) < 1.96 * loads.sigma_sine[1:]
        assert np.mean(inside) > 0.9
        assert np.median(np.abs(error) / loads.sigma_cosine[1:]) > 0.2
        assert all("model contradicted" in flags for row in loads.flags[1:] for flags in row)
