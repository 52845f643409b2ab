"""A record in which no line repeats says where it differs, not that its period is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.io.errors import UserError
from balance_cli.signals.periodic import periodic_record
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from tests.support.rigs import one_degree_of_freedom

PERIODS, PERIOD = 5, 2.0


@pytest.fixture(scope="module")
def run() -> Run:
    plan = SweepPlan(run="sweep", excited=("Fz",), level=(50.0,), period=PERIOD, periods=PERIODS, band=(5.0, 80.0))
    return simulate_campaign(true_rig(one_degree_of_freedom()), CampaignPlan(runs=(plan,)), seed=1).runs[0]


def with_loads(run: Run, factor: NDArray[np.float64], spike: float = 0.0) -> Run:
    """The run with its loads times a factor for each period, and a spike in the fourth."""
    block = run.read()
    samples = len(block.loads) // PERIODS
    loads = block.loads * np.repeat(factor, samples)[:, None]
    loads[3 * samples + samples // 2, 2] += spike
    return replace(run, source=MemorySource(block.channels, loads))


def test_a_spike_is_named_by_its_period(run: Run) -> None:
    with pytest.raises(UserError) as caught:
        periodic_record(with_loads(run, np.ones(PERIODS), 1e6), run.channel_names)
    assert "the loads from 6 to 8 s are unlike those of most of the 5 periods" in caught.value.fault


def test_an_exciter_that_stops_is_named_by_its_time(run: Run) -> None:
    with pytest.raises(UserError) as caught:
        periodic_record(with_loads(run, np.array([1.0, 1.0, 1.0, 1e-3, 1e-3])), run.channel_names)
    assert "the loads from 6 to 8 s, 8 to 10 s are unlike those of most of the 5 periods" in caught.value.fault


def test_an_exciter_that_begins_late_is_a_transient(run: Run) -> None:
    factor = np.array([1e-3, 1.0, 1.0, 1.0, 1.0])
    block = run.read()
    channels = block.channels * np.repeat(factor, len(block.channels) // PERIODS)[:, None]
    late = replace(run, source=MemorySource(channels, with_loads(run, factor).read().loads))
    assert periodic_record(late, run.channel_names).first.min() >= 1


def test_a_wrong_period_is_a_matter_of_all_periods(run: Run) -> None:
    with pytest.raises(UserError) as caught:
        periodic_record(replace(run, period=1.37), run.channel_names)
    assert caught.value.fault == "no line of the loads repeats from period to period"
