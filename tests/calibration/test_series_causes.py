"""Whole load series with one mistake: excluded, and the mistake named."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.cli.calibration_text import math_model_warnings
from balance_cli.io.errors import UserError
from tests.support.calibration_stand import CHANNELS, FULL_RANGE, NOISE, stand_points, true_model

FACTORS = {
    "reversed": (-1.0, "its loads seem to be of the other sign"),
    "lbf": (1 / 4.4482216, "its loads seem to be in lbf"),
    "kgf": (1 / 9.80665, "its loads seem to be in kgf"),
    "stated twice": (2.0, "its loads seem to be 0."),
}


def spoil(change, series=20):
    """The stand, with the loads of one of its series changed: rows, loads (r, 6) -> loads."""
    points = stand_points()
    rows = np.flatnonzero(points.load_series == series)
    loads = points.loads.copy()
    loads[rows] = change(loads[rows])
    return rows, replace(points, loads=loads, series=points.load_series)


def causes(points):
    whole = calibrate_all_trims(points)
    return whole, {suspect.cause for suspect in whole.suspect_series}


@pytest.mark.parametrize("name", FACTORS)
def test_loads_in_another_unit_or_of_the_other_sign(name):
    factor, words = FACTORS[name]
    rows, points = spoil(lambda loads: factor * loads)
    whole, (cause,) = causes(points)
    assert cause.startswith(words)
    excluded = ~np.isfinite(whole.residuals).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(excluded), rows)
    assert any(words in warning for warning in math_model_warnings(whole))


def test_two_columns_exchanged():
    def exchange(loads):
        moved = np.argsort(-np.ptp(loads, axis=0))[0]
        other = (moved + 3) % 6
        loads = loads.copy()
        loads[:, [moved, other]] = loads[:, [other, moved]]
        return loads

    _, points = spoil(exchange)
    _, (cause,) = causes(points)
    assert cause.endswith("seem to be exchanged")


def test_rows_in_reverse_order():
    """In a ramp to both sides; a ramp to one side is its own reverse."""
    _, points = spoil(lambda loads: loads[::-1], series=1)
    _, (cause,) = causes(points)
    assert cause == "its loads seem to stand in reverse order"


def test_one_wrong_channel_is_no_mistake_of_the_loads():
    points = stand_points()
    rows = points.load_series == 20
    channels = points.channels.copy()
    c = int(np.argmax(np.ptp(channels[rows], axis=0)))
    channels[rows, c] = channels[rows, c].mean() + 1.3 * (channels[rows, c] - channels[rows, c].mean())
    whole, named = causes(replace(points, channels=channels))
    assert whole.suspect_series and named == {None}


def two_series_a_load(wrong, factor):
    """Each load in one series to either side; the loads of one of the series are `factor` times the true ones."""
    up = np.r_[0.0, np.arange(1, 6), np.arange(4, 0, -1)] / 5.0
    x = np.vstack([np.outer(side * up, np.eye(6)[j]) for j in range(6) for side in (1, -1)])
    series = np.repeat(np.arange(12), len(up))
    read = x @ true_model()[1][:6] + NOISE * np.random.default_rng(0).normal(size=(len(x), 8))
    loads = x * FULL_RANGE * np.where(series == wrong, factor, 1.0)[:, None]
    size = np.abs(loads).max(axis=0)
    return series, CalibrationPoints(
        channel_names=CHANNELS,
        components=COMPONENTS,
        run_names=("stand",),
        channels=read,
        loads=loads,
        run=np.zeros(len(x), int),
        weight=np.ones(len(x)),
        calibrated_range=size,
        stated_series=tuple(map(str, series)),
    )


@pytest.mark.parametrize("wrong", [4, 5])
@pytest.mark.parametrize("factor", [-1.0, 4.4482216])
def test_two_series_that_contradict_each_other_are_settled_by_the_declared_rig_or_refused(wrong, factor):
    series, points = two_series_a_load(wrong, factor)
    with pytest.raises(UserError, match=r"rows 41 to 50 \(Fz\) and .*rows 51 to 60 \(Fz\): contradict .*sign .* of Fz"):
        calibrate_all_trims(points)
    declared = 1.03 * (true_model()[1][:6] / FULL_RANGE[:, None]).T
    whole = calibrate_all_trims(replace(points, declared_response=declared))
    np.testing.assert_array_equal(~np.isfinite(whole.residuals).all(axis=1), series == wrong)
    assert any("declared geometry refutes" in note for note in whole.screening_notes)
    response = whole.model.coefficients[:6] / whole.model.calibrated_range[:, None]
    np.testing.assert_allclose(response.T, declared / 1.03, atol=2e-2 * np.abs(declared).max(axis=0).min())


def test_declared_sensitivities_that_fit_neither_series_settle_nothing():
    _, points = two_series_a_load(5, -1.0)
    with pytest.raises(UserError, match="contradict"):
        random = np.random.default_rng(1).normal(size=(8, 6)) / FULL_RANGE
        calibrate_all_trims(replace(points, declared_response=random))


@pytest.mark.parametrize("wrong", [0, 3])
def test_of_two_series_that_disagree_in_another_load_either_may_be_wrong(wrong):
    """One of them predicts no change of a channel, and so no gain: only the sound one was named, and excluded."""
    rng, steps = np.random.default_rng(8), np.r_[0:6, 4:-6:-1, -4:1] / 5.0
    x, series = np.vstack([np.outer(steps, part) for part in (*np.eye(3), *np.eye(3))]), np.repeat(np.arange(6), 21)
    true = x.copy()
    true[series == wrong, 2] += 0.3 * x[series == wrong, 0]
    read = true @ (np.eye(3) + 0.01 * rng.normal(size=(3, 3))) + 2e-4 * rng.normal(size=x.shape)
    names = tuple(f"g{c}" for c in range(3))
    whole = calibrate_all_trims(
        CalibrationPoints(names, COMPONENTS[:3], ("stand",), read, x, 0 * series, np.ones(len(x)), np.ones(3))
    )
    assert {suspect.load_series for suspect in whole.suspect_series} | set(whole.suspect_series[0].alternatives) == {
        "stand rows 1 to 21 (Fx)",
        "stand rows 64 to 84 (Fx)",
    }
