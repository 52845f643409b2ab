"""A simulated balance in the time domain: the known truth against which all other parts are tested.

It shares no code with the frequency-domain model of the balance.
"""

from balance_cli.simulation.campaign import Campaign, iterate_simulated_runs, simulate_campaign, simulate_run
from balance_cli.simulation.noise import NO_NOISE, Noise
from balance_cli.simulation.plans import CampaignPlan, RotorPlan, StaticPlan, SweepPlan, ZeroPlan
from balance_cli.simulation.preset_plans import campaign_plan, short_plan, standard_plan
from balance_cli.simulation.rig import TrueRig, draw_rig, true_rig
from balance_cli.simulation.truth import RunTruth

__all__ = [
    "NO_NOISE",
    "Campaign",
    "CampaignPlan",
    "Noise",
    "RotorPlan",
    "RunTruth",
    "StaticPlan",
    "SweepPlan",
    "TrueRig",
    "ZeroPlan",
    "campaign_plan",
    "draw_rig",
    "iterate_simulated_runs",
    "short_plan",
    "simulate_campaign",
    "simulate_run",
    "standard_plan",
    "true_rig",
]
