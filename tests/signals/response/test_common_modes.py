"""Responses to different components ring at the eigenfrequencies of one rig, or are of two."""

from __future__ import annotations

import pytest

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.reduction.measured_response import transfer_source
from balance_cli.signals.response.choices import CONTRADICTING_RESPONSES
from balance_cli.signals.response.common_modes import contradicting_modes
from balance_cli.signals.response.transfer import Transfer
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from balance_cli.steps.sweep_tf import estimate_responses
from tests.support.rigs import one_degree_of_freedom

BAND = (5.0, 90.0)


def rig(mass: float) -> Geometry:
    """A bar on two cells, off whose middle its center of gravity lies: both loads excite both modes."""
    cell = {"axis": [0, 0, 1], "stiffness": 1e6, "full_range": 1000.0}
    body = {"name": "bar", "mass": mass, "position": [0.1, 0, 0], "inertia": {"xx": 0.5, "yy": 0.8, "zz": 0.9}}
    return one_degree_of_freedom(
        mass=mass,
        bodies=[body],
        cells=[{"name": "a", "position": [0.3, 0, 0], **cell}, {"name": "b", "position": [-0.3, 0, 0], **cell}],
        channels=[{"name": f"{n}.strain", "cell": n, "sensitivity": 0.002} for n in "ab"],
        freedom=["z", "theta"],
    )


def sweep(component: str, mass: float, period: float = 4.0) -> Run:
    """A sweep of one load, of the rig with a bar of this mass."""
    plan = SweepPlan(run=component, excited=(component,), level=(100.0,), period=period, periods=4, band=BAND)
    (run,) = simulate_campaign(true_rig(rig(mass)), CampaignPlan(runs=(plan,)), seed=3).runs
    return run


@pytest.fixture(scope="module")
def force() -> Run:
    return sweep("Fz", 20.0)


def responses(*runs: Run) -> Transfer:
    return estimate_responses(runs, rig(20.0))


def test_responses_of_one_rig_have_their_modes_in_common(force: Run) -> None:
    transfer = responses(force, sweep("My", 20.0))
    assert list(contradicting_modes(transfer)) == []
    assert not transfer_source(transfer, "local").is_contradicted


@pytest.mark.parametrize("mass", [20.05, 21.0])
def test_a_mass_that_was_added_between_two_sweeps_is_named(force: Run, mass: float) -> None:
    transfer = responses(force, sweep("My", mass))
    (text,) = transfer.consistency or ()
    assert text.startswith(f"{CONTRADICTING_RESPONSES}the mode at ")
    assert "in that to Fz (Fz) lies at" in text
    assert "in that to My (My), as if the rig or the mass of the exciter had changed between them" in text
    assert transfer_source(transfer, "local").is_contradicted


def test_modes_are_not_told_apart_between_lines_that_lie_far_apart(force: Run) -> None:
    assert list(contradicting_modes(responses(force, sweep("My", 20.05, period=0.5)))) == []
