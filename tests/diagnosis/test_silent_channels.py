"""A channel that is disconnected in some runs is named by what it should have read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.diagnosis.consistency.campaign import campaign_findings
from balance_cli.diagnosis.consistency.findings import SILENT_CHANNEL
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from tests.support.rigs import rotor_balance

NOISE = 1e-3
"""Volts."""


@pytest.fixture(scope="module")
def runs() -> tuple[Run, ...]:
    """Fx swept twice, Fy once."""
    sweeps = (
        SweepPlan(run=name, excited=(name[:2],), level=(level,), period=2.0, periods=4)
        for name, level in (("Fx-high", 40.0), ("Fx-low", 16.0), ("Fy", 40.0))
    )
    return tuple(simulate_campaign(true_rig(rotor_balance()), CampaignPlan(runs=tuple(sweeps)), seed=3).runs)


def disconnected(runs: tuple[Run, ...], names: tuple[str, ...], channel: str, left: float = 0.0) -> tuple[Run, ...]:
    """The runs with noise and a share of the signal in a channel of these."""
    i, changed = rotor_balance().channel_names.index(channel), []
    for seed, run in enumerate(runs):
        block = run.read()
        channels = block.channels.copy()
        noise = np.random.default_rng(seed).normal(0.0, NOISE, len(channels))
        channels[:, i] = left * channels[:, i] + noise
        source = MemorySource(channels, block.loads)
        changed.append(replace(run, source=source) if run.name in names else run)
    return tuple(changed)


@pytest.mark.parametrize(
    ("names", "channel", "where"),
    [
        (("Fx-high",), "x.strain", "in Fx-high"),
        (("Fx-low",), "x.piezo", "in Fx-low"),
        (("Fy",), "y1.piezo", "in Fy"),
        (("Fx-high", "Fx-low"), "x.piezo", "in all 2 runs that show it"),
    ],
)
def test_a_disconnected_channel_is_a_fault_of_its_runs(
    runs: tuple[Run, ...], names: tuple[str, ...], channel: str, where: str
) -> None:
    (finding,) = campaign_findings(rotor_balance(), disconnected(runs, names, channel))
    assert finding.kind == SILENT_CHANNEL and finding.is_fault
    assert finding.channels == (channel,) and finding.runs == names
    text = f"{channel} reads nothing of what the loads make: disconnected, or another input?"
    assert finding.sentence == f"{text} {where}"


def test_a_small_gain_is_not_silence(runs: tuple[Run, ...]) -> None:
    (finding,) = campaign_findings(rotor_balance(), disconnected(runs, ("Fx-high",), "x.strain", left=0.05))
    assert finding.kind != SILENT_CHANNEL and finding.channels == ("x.strain",)
    assert finding.factor == pytest.approx(0.05, rel=0.05)


def test_channels_that_a_load_does_not_reach_are_not_silent(runs: tuple[Run, ...]) -> None:
    assert campaign_findings(rotor_balance(), disconnected(runs, ("Fx-high",), "torque")) == ()
