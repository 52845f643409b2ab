"""Channels of a check run against the sweeps, on a balance without redundant channels."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.diagnosis.consistency.campaign import campaign_findings
from balance_cli.simulation import draw_rig, simulate_campaign, true_rig
from tests.support.other_rigs import other_rig, short_campaign

ROOT = Path(__file__).parents[2]
RUNS = ("sweep-Fz", "sweep-My", "check-2")
ROTOR_SPEED = 25.0
"""[Hz]. With the harmonics between the modes the sweeps predict a check run within a few percent."""


@pytest.fixture(scope="module")
def campaign():
    geometry = load_geometry(ROOT / "configs" / "hexapod.yaml")
    plan = short_campaign("A", sweeps=300.0, revolutions=60)  # of a rig of this size
    sweeps_and_check = [run for run in plan.runs if run.run in RUNS]
    sweeps_and_check[-1] = sweeps_and_check[-1].model_copy(update={"rotor_speed": ROTOR_SPEED})
    plan = plan.model_copy(update={"runs": tuple(sweeps_and_check)})
    return geometry, simulate_campaign(true_rig(geometry), plan, seed=1).runs


def findings(campaign, change):
    geometry, runs = campaign
    changed = []
    for run in runs:
        block = run.read()
        channels = block.channels.copy()
        if run.kind == "check":
            change(channels)
        changed.append(replace(run, source=MemorySource(channels, block.loads)))
    return [(item.is_fault, item.sentence) for item in campaign_findings(geometry, changed)]


@pytest.mark.parametrize("pair", [(0, 3), (0, 5), (1, 4), (3, 4)])
def test_exchanged_channels_are_named(campaign, pair):
    """Two of six differ. With an error of 30 % for any check run three of these pairs had no finding."""

    def exchange(channels):
        channels[:, list(pair)] = channels[:, list(pair[::-1])]

    first, second = (campaign[0].channel_names[i] for i in pair)
    assert findings(campaign, exchange) == [(True, f"{first} and {second} are exchanged in check-2")]


@pytest.mark.parametrize(("factor", "words"), [(-1.0, "is reversed"), (-1.5, "is reversed, and reads 1."), (1e3, "mV")])
def test_a_reversed_channel_is_named(campaign, factor, words):
    def scale(channels):
        channels[:, 0] *= factor

    ((is_fault, sentence),) = findings(campaign, scale)
    assert is_fault and words in sentence


def test_a_sound_run_has_no_finding(campaign):
    assert findings(campaign, lambda channels: None) == []


@pytest.fixture(scope="module")
def resonant_campaign():
    """A line of the check run lies at a mode with a damping ratio of 0.8 %: the sweeps predict 0.55 of it."""
    geometry, seed = other_rig("A"), 1025
    rig = draw_rig(geometry, np.random.default_rng([seed, 5]))
    plan = short_campaign("A")
    plan = plan.model_copy(update={"runs": tuple(run for run in plan.runs if run.run in RUNS)})
    return geometry, simulate_campaign(rig, plan, seed=seed).runs


def test_a_line_at_a_mode_is_no_factor_of_all_channels(resonant_campaign):
    """All channels had read 1.788 times what the loads make, in a run without a mistake."""
    assert findings(resonant_campaign, lambda channels: None) == []


def test_a_factor_is_found_beside_a_line_at_a_mode(resonant_campaign):
    def scale_all(channels):
        channels *= 3.0

    def scale_piezo(channels):
        channels[:, resonant_campaign[0].channel_names.index("l1.piezo")] *= 0.6

    ((_, text),) = findings(resonant_campaign, scale_all)
    assert text.startswith("all channels read")
    ((_, text),) = findings(resonant_campaign, scale_piezo)
    assert text.startswith("l1.strain reads 1.66")  # of two channels in one run either may be wrong
