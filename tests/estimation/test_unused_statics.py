"""A static run without a channel that measures at rest is no fault of the campaign."""

from __future__ import annotations

from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.simulation import CampaignPlan, StaticPlan, SweepPlan, simulate_campaign, true_rig
from tests.support.rigs import one_degree_of_freedom


def test_a_static_run_of_a_rig_with_piezo_channels_alone_is_unused() -> None:
    plan = CampaignPlan(
        runs=(
            StaticPlan(run="static", largest={"Fz": 100.0}, steps=2),
            SweepPlan(run="sweep", excited=("Fz",), level=(50.0,), period=2.0, periods=4, band=(5.0, 80.0)),
        )
    )
    runs = simulate_campaign(true_rig(one_degree_of_freedom()), plan, seed=1).runs
    piezo = one_degree_of_freedom(
        channels=[{"name": "z.strain", "cell": "z", "sensitivity": 0.002, "time_constant": 3.0}]
    )
    spectra = measured_spectra(runs, piezo)
    assert spectra.unused == {"static": "no channel measures at rest"} and len(spectra.lines) == 1
