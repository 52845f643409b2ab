"""Rows whose only load is one that the rig does not carry are load points, not unloaded rows."""

from pathlib import Path

from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.simulation import CampaignPlan, short_plan, simulate_campaign, true_rig
from balance_cli.steps.calibrate import calibrate

ONE_DOF = Path(__file__).parents[2] / "configs" / "one-dof.yaml"


def test_a_rig_of_one_degree_of_freedom_is_calibrated_with_loads_in_all_directions():
    """It was refused: of 49 rows the 42 without Fz had counted as one."""
    geometry = load_geometry(ONE_DOF)
    static = next(plan for plan in short_plan().runs if plan.kind == "static")
    runs = simulate_campaign(true_rig(geometry), CampaignPlan(runs=(static,)), seed=0).runs
    trim = calibrate(list(runs), geometry).trims["bare"]
    assert trim.dof == 49 - 7
