"""A zero in another attitude: the weight of the metric part is taken off the mean loads where it is known, or named."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.calibration.tare_result import Tares
from balance_cli.campaign.recording.run import MemorySource
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.wind_off import zero_record
from balance_cli.steps.reduce import reduce_run

WEIGHT, CENTER = 1500.0, np.array([0.02, -0.01, -0.6])
"""Of the metric part: N, m from the hub."""


def weight_of(pitch, roll=0.0):
    """Hub loads (6,) of the weight of a rig that was pitched, then rolled."""
    p, r = np.radians([pitch, roll])
    about_y = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
    force = (about_y @ about_x).T @ [0.0, 0.0, -WEIGHT]
    return np.concatenate([force, np.cross(CENTER, force)])


@pytest.fixture(scope="module")
def tilted(campaign, calibration):
    """A wind run whose weight has turned since its zero, by 8 deg of pitch and 3 of roll, and that zero."""
    wind, trim = campaign.runs_of_kind("wind")[0], calibration.trims["bare"]
    change = dict(zip(trim.channel_names, trim.C0 @ (weight_of(8.0, 3.0) - weight_of(0.0)), strict=True))
    block = wind.read()
    shift = np.array([change.get(name, 0.0) for name in wind.channel_names])
    source = MemorySource(np.asarray(block.channels) + shift, None)
    run = replace(wind, source=source, conditions={"pitch": 8.0, "roll": 3.0})
    unloaded = dict(zip(trim.channel_names, trim.offsets.mean(axis=0), strict=True))
    level = np.array([unloaded.get(name, 0.0) for name in wind.channel_names])
    quiet = level + 1e-4 * np.random.default_rng(2).standard_normal((len(block.channels), len(level)))
    zero = replace(wind, name="zero", kind="zero", source=MemorySource(quiet, None), conditions={"pitch": 0.0})
    return run, wind, zero


def means(run, zero, campaign, calibration, identified):
    record = zero_record(zero, calibration.trims["bare"].channel_names)
    return reduce_run(run, campaign.geometry, calibration, model_source(identified), record)


def test_a_change_of_weight_that_is_not_known_is_named(tilted, campaign, calibration, identified):
    """Fx had 209 N of weight, 500 of its sigma, and no flag."""
    run, wind, zero = tilted
    named = means(run, zero, campaign, calibration, identified)
    assert abs(named.amplitude[0, 0] - means(wind, zero, campaign, calibration, identified).amplitude[0, 0]) > 150.0
    assert all("no weight" in flag for flag in named.flags[0]) and not any("weight" in f for f in named.flags[1])
    assert any("attitude" in note and "zero" in note for note in named.notes)
    for conditions in ({}, {"pitch": 0.05}):
        level = means(replace(run, conditions=conditions), zero, campaign, calibration, identified)
        assert not any("weight" in flag for flag in level.flags[0])


@pytest.mark.parametrize(("of_run", "of_zero"), [({"pitch": 8.0}, {}), ({}, {"roll": -3.0})])
def test_an_attitude_that_only_the_run_or_its_zero_states_is_named(
    tilted, campaign, calibration, identified, of_run, of_zero
):
    _, wind, zero = tilted
    records = replace(wind, conditions=of_run), replace(zero, conditions=of_zero)
    named = means(*records, campaign, calibration, identified)
    assert all("no weight" in flag for flag in named.flags[0])
    assert any("states no attitude" in note for note in named.notes)


def test_a_weight_that_the_calibration_knows_is_taken_off(tilted, campaign, calibration, identified):
    run, wind, zero = tilted
    w, sigma = np.r_[WEIGHT, WEIGHT * CENTER], np.array([1.0, 0.3, 0.3, 0.3])
    tares = Tares(w, np.diag(sigma**2), np.zeros(1), np.zeros(1), 1.0, 6)
    knowing = replace(calibration, all_trims=replace(calibration.all_trims, tares=tares))
    corrected = means(run, zero, campaign, knowing, identified)
    expected = means(wind, zero, campaign, calibration, identified)
    error = (corrected.amplitude[0] - expected.amplitude[0]).real
    # The matrix of the nearest trim is not that of the bare rig, by which the weight was added.
    assert np.all(np.abs(error) < 0.6 * expected.sigma_cosine[0])
    assert np.all(corrected.sigma_cosine[0] >= expected.sigma_cosine[0])
    assert corrected.sigma_cosine[0, 4] > np.hypot(expected.sigma_cosine[0, 4], 0.9 * 0.3 * np.sin(np.radians(8.0)))
    assert not any("weight" in flag for flag in corrected.flags[0])
