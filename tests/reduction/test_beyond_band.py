"""Harmonics beyond the sweeps of a model are flagged; those that the model knows from rest are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.reduction.check_contradiction import flag_beyond_sweeps
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.response_sources import beyond_sweeps
from balance_cli.steps.reduce import reduce_run


@pytest.fixture(scope="module")
def check(campaign):
    return campaign.runs_of_kind("check")[0]


@pytest.fixture
def swept(identified):
    """The identified model as if its sweeps had reached up to 50 Hz."""
    return replace(identified, excited_band=(5.0, 50.0))


def test_identification_knows_the_band_of_its_sweeps(identified):
    low, high = identified.excited_band
    assert 0.0 < low < 10.0 and 100.0 < high < 400.0
    assert identified.swept_band == (0.0, high)  # the lowest mode lies far above the lowest line


def test_harmonics_beyond_the_sweeps_are_extrapolated(campaign, calibration, swept, check):
    loads = reduce_run(check, campaign.geometry, calibration, model_source(swept))
    beyond = loads.frequency_hz > 1.03 * 50.0
    assert 0 < beyond.sum() < len(beyond)
    for row, is_beyond in zip(loads.flags, beyond, strict=True):
        assert all(("extrapolated" in words) == is_beyond for words in row)
    (note,) = (text for text in loads.notes if "outside the sweeps" in text)
    assert f"harmonics {', '.join(str(n) for n in np.flatnonzero(beyond))} lie" in note and "0 to 50 Hz" in note


def test_nothing_is_said_of_a_model_without_a_band(campaign, calibration, identified, check):
    source = model_source(replace(identified, excited_band=None))
    loads = reduce_run(check, campaign.geometry, calibration, source)
    assert flag_beyond_sweeps(loads, source) is loads


def test_a_band_that_begins_beside_the_modes_has_a_lower_end(identified):
    lowest = float(identified.modes.frequency.min())
    source = model_source(replace(identified, excited_band=(0.9 * lowest, 400.0)))
    frequency = np.array([0.0, 0.5 * lowest, 0.89 * lowest, lowest, 410.0, 420.0])
    assert beyond_sweeps(source, frequency).tolist() == [False, True, False, False, False, True]
