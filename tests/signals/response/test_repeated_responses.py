"""Responses to one component from several sweeps are compared: one of them is used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.reduction.measured_response import transfer_source
from balance_cli.signals.response.choices import CONTRADICTING_RESPONSES
from balance_cli.signals.response.repeated_responses import contradicting_responses
from balance_cli.signals.response.transfer import Transfer
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from balance_cli.steps.sweep_tf import estimate_responses
from tests.support.rigs import two_degrees_of_freedom

RIG = two_degrees_of_freedom()


@pytest.fixture(scope="module")
def runs() -> tuple[Run, ...]:
    """Each load swept at two levels."""
    sweeps = (
        SweepPlan(run=f"{name}-{level}", excited=(name,), level=(level,), period=4.0, periods=4, band=(5.0, 90.0))
        for name in ("Fz", "My")
        for level in (100.0, 40.0)
    )
    return tuple(simulate_campaign(true_rig(RIG), CampaignPlan(runs=tuple(sweeps)), seed=2).runs)


def altered(runs: tuple[Run, ...], channels: NDArray[np.float64], loads: NDArray[np.float64]) -> Transfer:
    """Responses of the runs with channels and loads of the first one times these factors (c,) and (6,)."""
    block = runs[0].read()
    first = replace(runs[0], source=MemorySource(block.channels * channels, block.loads * loads))
    return estimate_responses([first, *runs[1:]], RIG)


def test_sweeps_that_agree_say_nothing(runs: tuple[Run, ...]) -> None:
    assert list(contradicting_responses(altered(runs, np.ones(2), np.ones(6)))) == []


def test_a_gain_of_one_sweep_is_named(runs: tuple[Run, ...]) -> None:
    (text,) = contradicting_responses(altered(runs, np.ones(2), np.full(6, 1.03)))
    assert text.startswith(CONTRADICTING_RESPONSES)
    assert "to Fz in Fz-40.0 differs from that in Fz-100.0, which is used, by 3 %, as by a factor of 1.03" in text


def test_a_delay_of_one_sweep_is_named(runs: tuple[Run, ...]) -> None:
    block = runs[0].read()
    source = MemorySource(block.channels, np.roll(block.loads, 2, axis=0))
    transfer = estimate_responses([replace(runs[0], source=source), *runs[1:]], RIG)
    (text,) = contradicting_responses(transfer)
    assert f"as by a delay of {2e3 / runs[0].sample_rate:.3g} ms" in text


def test_a_channel_that_was_lost_in_one_sweep_is_no_factor(runs: tuple[Run, ...]) -> None:
    (text,) = contradicting_responses(altered(runs, np.array([1.0, 0.01]), np.ones(6)))
    assert "or a channel differs between them" in text


def test_loads_by_contradicting_responses_are_flagged(runs: tuple[Run, ...]) -> None:
    assert transfer_source(altered(runs, np.ones(2), np.full(6, 1.03)), "local").is_contradicted
    assert not transfer_source(altered(runs, np.ones(2), np.ones(6)), "local").is_contradicted
