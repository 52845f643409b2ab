"""Harmonics whose declared anti-alias filter cannot be, or need not be, the one that the record passed."""

from pathlib import Path

import numpy as np
import pytest

import balance_cli as bal
from balance_cli.campaign.rig.geometry import Acquisition, AnalogFilter
from balance_cli.reduction.assumed_filter import flag_assumed_filter
from tests.reduction.test_turned_harmonics import a_run as loads_of
from tests.support.run_content import a_run

ROOT = Path(__file__).parents[2]
RIG = bal.read_geometry(ROOT / "configs/rts-6.yaml")
LOADS = loads_of(np.ones((9, 6), complex))


def flagged(rate, sweep_rates, cutoff=200.0):
    declared = None if cutoff is None else AnalogFilter(type="butterworth", order=6, cutoff=cutoff)
    geometry = RIG.model_copy(update={"acquisition": Acquisition(filter=declared)})
    return flag_assumed_filter(LOADS, a_run("wind", sample_rate=rate), geometry, sweep_rates)


@pytest.mark.parametrize("sweep_rates", [(), (400.0,), (800.0,)])
def test_a_cutoff_beyond_half_the_sample_rate_contradicts_the_harmonics_and_not_the_means(sweep_rates):
    loads = flagged(400.0, sweep_rates)
    assert set(loads.flags[0]) == {""}
    assert {word for row in loads.flags[1:] for word in row} == {"model contradicted"}
    assert "declared filter of 200 Hz lets pass what is aliased" in loads.notes[-1]


def test_another_sample_rate_than_that_of_the_sweeps_is_said():
    loads = flagged(1600.0, (800.0, 1000.0))
    assert loads.flags == LOADS.flags
    assert "recorded at 1600 Hz, the sweeps at 800 and 1000 Hz" in loads.notes[-1]


@pytest.mark.parametrize(
    ("rate", "sweep_rates", "cutoff"),
    [
        (800.0, (800.0,), 200.0),
        (800.01, (400.0, 800.0), 200.0),
        (1600.0, (), 200.0),
        (400.0, (800.0,), None),
    ],
    ids=["same", "clock", "not known", "no filter"],
)
def test_nothing_is_said_where_nothing_is_known_against_the_filter(rate, sweep_rates, cutoff):
    assert flagged(rate, sweep_rates, cutoff) == LOADS
