"""A mode that no sweep excites keeps its declared frequency and damping, however the records begin."""

from __future__ import annotations

import numpy as np
import pytest

from balance_cli.campaign.recording.run import excerpt_run
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from balance_cli.steps.identify import identify
from tests.support.rigs import one_degree_of_freedom

RIG = one_degree_of_freedom(
    cells=[
        {"name": name, "position": [0, 0, 0], "axis": axis, "stiffness": stiffness, "full_range": 1000.0}
        for name, axis, stiffness in (("x", [1, 0, 0], 4e5), ("y", [0, 1, 0], 8e5))
    ],
    channels=[{"name": f"{name}.strain", "cell": name, "sensitivity": 0.002} for name in "xy"],
    tolerances={"stiffness": 0.05, "mass": 0.0, "damping_ratio": 0.5},
    freedom=["x", "y"],
)
PERIOD = 2.0


@pytest.mark.parametrize("seed", [2, 5, 7])
@pytest.mark.parametrize("first", [0, 1], ids=["from rest", "steady from the first sample"])
def test_a_mode_that_nothing_excites_is_known_as_declared(first: int, seed: int) -> None:
    """Its transient had taken frequency and damping of the noise: 49.05 +- 0.31 Hz, where 45.016 is true (seed 5)."""
    plans = (
        SweepPlan(run=f"Fx-{k}", excited=("Fx",), level=(20.0 + k,), period=PERIOD, periods=4 + first, band=(5.0, 80.0))
        for k in range(6)
    )
    runs, _ = simulate_campaign(true_rig(RIG), CampaignPlan(runs=tuple(plans)), seed=seed)
    runs = [excerpt_run(run, int(first * PERIOD * run.sample_rate), run.samples) for run in runs]
    modes = identify(measured_spectra(runs, RIG), RIG).modes
    np.testing.assert_allclose(modes.frequency[1], np.sqrt(8e5 / 10.0) / (2 * np.pi), rtol=1e-3)
    np.testing.assert_allclose(modes.sigma_frequency[1], 0.025 * modes.frequency[1], rtol=0.02)
    np.testing.assert_allclose([modes.damping_ratio[1], modes.sigma_damping_ratio[1]], [0.02, 0.01], rtol=0.02)
    # The mode that is excited is known well, its transient included.
    assert modes.sigma_frequency[0] < 1e-4
