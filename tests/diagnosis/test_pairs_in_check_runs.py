"""Two channels of a cell that differ in check runs alone: the sweeps tell which of them is wrong."""

import numpy as np
import pytest

from balance_cli.diagnosis.consistency.campaign import campaign_findings
from balance_cli.simulation import draw_rig, simulate_campaign
from tests.support.channels import with_channel
from tests.support.other_rigs import other_rig, short_campaign


@pytest.fixture(scope="module")
def campaign():
    geometry, plan = other_rig("A"), short_campaign("A", revolutions=60)
    kept = [run for run in plan.runs if run.kind in ("sweep", "check")]
    rig = draw_rig(geometry, np.random.default_rng(31))
    return geometry, simulate_campaign(rig, plan.model_copy(update={"runs": tuple(kept)}), seed=31).runs


def findings(campaign, name, factor, kinds=("sweep", "check")):
    geometry, runs = campaign
    changed = [with_channel(run, name, lambda x: factor * x) if run.kind == "check" else run for run in runs]
    return [item.sentence for item in campaign_findings(geometry, [run for run in changed if run.kind in kinds])]


@pytest.mark.parametrize("name", ["l1.strain", "l1.piezo"])
def test_the_channel_that_differs_from_the_sweeps_is_named(campaign, name):
    """Of both the strain channel had been named, and then the cell as reversed in addition."""
    assert findings(campaign, name, -1.0) == [f"{name} is reversed in check-1, check-2"]


def test_a_factor_is_that_of_the_channel_that_differs_from_the_sweeps(campaign):
    (sentence,) = findings(campaign, "l1.piezo", 3.0)
    assert sentence.startswith("l1.piezo reads 3 times") and sentence.endswith("in check-1, check-2")


@pytest.mark.parametrize("name", ["l1.strain", "l1.piezo"])
def test_without_sweeps_both_channels_are_named(campaign, name):
    assert findings(campaign, name, -1.0, ("check",)) == [
        "l1.strain is reversed (or l1.piezo) in all 2 runs that show it"
    ]


def test_of_two_channels_that_differ_by_a_factor_both_are_named(campaign):
    (sentence,) = findings(campaign, "l1.piezo", 3.0, ("check",))
    assert sentence.startswith("l1.strain reads 0.333") and "(or l1.piezo 3 times)" in sentence
