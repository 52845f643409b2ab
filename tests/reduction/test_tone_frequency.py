"""A tone beside the frequency that was given for it turns within the record, and is flagged."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.result import RunLoads
from balance_cli.reduction.tone_frequency import tone_turn
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from balance_cli.steps.identify import identify
from balance_cli.steps.reduce_frequencies import reduce_run_at_frequencies
from tests.support.rigs import two_degrees_of_freedom

RIG = two_degrees_of_freedom()
RATE, SECONDS, TONE = 500.0, 8.0, 11.3


@cache
def source() -> ResponseSource:
    plans = (SweepPlan(run=name, excited=(name,), level=(30.0,), period=4.0, band=(5.0, 90.0)) for name in ("Fz", "My"))
    runs, _ = simulate_campaign(true_rig(RIG), CampaignPlan(runs=tuple(plans)), seed=1)
    return model_source(identify(measured_spectra(runs, RIG), RIG))


def record(frequency: float, gusts: float, seed: int = 1) -> Run:
    """Both channels read a tone far below the modes, and gusts of so many times its size."""
    time, rng = np.arange(int(RATE * SECONDS)) / RATE, np.random.default_rng(seed)
    wander = np.convolve(rng.normal(size=len(time) + 49), np.ones(50) / 50**0.5, "valid")
    force = np.cos(2 * np.pi * frequency * time) + gusts * wander
    channels = 0.1 * force[:, None] * [1.0, 0.8] + 1e-4 * rng.normal(size=(len(time), 2))
    source = MemorySource(channels, None)
    return Run("r", RIG.rig, "wind", RIG.channel_names, len(time), source, has_loads=False, sample_rate=RATE)


def loads_of(run: Run) -> RunLoads:
    return reduce_run_at_frequencies(run, [TONE], RIG, None, source(), None)


@pytest.mark.parametrize("gusts", [0.0, 0.2])
@pytest.mark.parametrize("error", [0.03, 0.06, -0.1])
def test_a_tone_beside_its_frequency_is_flagged(error: float, gusts: float) -> None:
    found = loads_of(record(TONE + error, gusts))
    assert all("not steady" in flag for flag in found.flags[1])
    turn = tone_turn(record(TONE + error, gusts), TONE, (), RIG, source())
    assert turn is not None and turn.error == pytest.approx(error, abs=max(5.0 * turn.sigma / (np.pi * SECONDS), 0.003))
    assert any("turns by" in note and f"{TONE + turn.error:.6g} Hz" in note for note in found.notes)


@pytest.mark.parametrize("error", [0.03, 0.06, -0.1])
def test_a_tone_has_no_azimuth_that_could_slip(error: float) -> None:
    notes = loads_of(record(TONE + error, 0.0)).notes
    assert notes and not any("azimuth" in note or "pulses" in note for note in notes)


def test_a_tone_at_its_frequency_is_not() -> None:
    turns = [tone_turn(record(TONE, 0.2, seed), TONE, (), RIG, source()) for seed in range(40)]
    assert not any(turn.is_significant for turn in turns if turn is not None)
    z = np.array([turn.angle / turn.sigma for turn in turns if turn is not None])
    assert len(z) == 40 and 0.5 < np.sqrt(np.mean(z**2)) < 1.3


def test_a_record_of_few_cycles_tells_nothing() -> None:
    run = record(TONE, 0.0)
    short = replace(run, samples=int(0.9 * RATE), source=MemorySource(run.read(0, int(0.9 * RATE)).channels, None))
    assert tone_turn(short, TONE, (), RIG, source()) is None
