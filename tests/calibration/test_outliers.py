"""What is plainly wrong in a calibration is named, and nothing in a sound one."""

from dataclasses import replace

import numpy as np
import pytest

import balance_cli as bal
from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.fit import CalibrationPoints, fit_calibration_model
from balance_cli.calibration.outliers import _include_predicted_rows, screen_outliers
from balance_cli.calibration.robust_scale import robust_row_sigma
from balance_cli.calibration.suspect_series import _find_suspect_series
from balance_cli.calibration.swapped_channels import find_swapped_channels
from balance_cli.calibration.term_choice import LINEAR_TERMS, SEARCHED
from balance_cli.calibration.terms import term_values
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.cli.calibration_text import outlier_text
from balance_cli.simulation import draw_rig, simulate_campaign
from tests.support.calibration_stand import CHANNELS, NOISE, NONLINEAR_TERMS, stand_points, true_model
from tests.support.other_rigs import other_rig, short_campaign


def terms_found(fit):
    return {
        channel: {name for name in fit.model.channel_coefficients(channel) if name not in COMPONENTS}
        for channel in CHANNELS
        if any(name not in COMPONENTS for name in fit.model.channel_coefficients(channel))
    }


def spoiled(change, seed=0):
    """The sound calibration with its readings changed in place."""
    points = stand_points(seed)
    channels = points.channels.copy()
    change(channels, points.load_series)
    return replace(points, channels=channels)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("search", [True, False])
def test_nothing_in_a_sound_calibration(seed, search):
    points = stand_points(seed)
    if not search:
        terms, b = true_model()
        points = replace(points, channels=points.channels - term_values(terms, points.x)[:, 6:] @ b[6:])
    found = screen_outliers(points, SEARCHED if search else LINEAR_TERMS)
    assert found.outliers == () and found.suspect_series == ()


@pytest.mark.parametrize("seed", [24, 34])
def test_a_load_series_that_is_quiet_by_chance_makes_no_row_of_it_an_outlier(seed):
    """The loads of rig E scatter by 0.05 N m of 20: a dozen rows of one load tell this to a quarter, two series better.

    These two of twenty campaigns had outliers 6.9 to 8.2 times the scale of their own series off.
    """
    geometry = other_rig("E")
    rig = draw_rig(geometry, np.random.default_rng([seed, 5]))
    plan = short_campaign("E").select_runs(["static-bare", "static-trim"])
    runs = simulate_campaign(rig, plan, seed=seed).runs
    assert bal.calibrate(runs, geometry).all_trims.outliers == ()


def test_the_scale_of_a_row_is_that_of_its_load():
    """Series 0 and 1 vary the first load, series 2 the second; series 0 is quiet, rows at zero tell nothing."""
    rng = np.random.default_rng(3)
    x = np.zeros((60, 2))
    x[:40, 0] = np.tile([0.0, 0.25, 0.5, 0.75, 1.0], 8)
    x[40:, 1] = np.tile([0.0, 0.25, 0.5, 0.75, 1.0], 4)
    series = np.repeat([0, 1, 2], 20)
    scale = np.where(x[:, 0] > 0, np.where(series == 0, 0.3, 1.0), 0.01)[:, None]
    sigma = robust_row_sigma(rng.normal(size=(60, 1)) * scale, series, np.ones(60, bool), x)
    assert sigma[0] == pytest.approx(0.5, rel=0.3)
    assert sigma[20] >= sigma[0]
    assert sigma[40] < 0.3 * sigma[0]


def test_curved_terms_are_no_fault_of_the_sequences_they_show_in():
    """By the loads alone many sequences are off by more than their weights may be; the terms explain them."""
    points, (terms, b) = stand_points(), true_model()
    points = replace(points, channels=points.channels + 2.0 * term_values(terms, points.x)[:, 6:] @ b[6:])
    straight = fit_calibration_model(points, choice=LINEAR_TERMS)
    assert any(check.channels for check in _find_suspect_series(points, straight).values())
    assert screen_outliers(points).suspect_series == ()


def weights_beside_others(rng, misalignment=0.0, hanger=0.0, steps=5):
    """Six loads up and down after their tare, then each beside another that hangs: points, and their series (m,).

    Shares of the range: each series has its own `misalignment` (of all loads into all others), and a hanger that the
    table does not know.
    """
    up, eye = np.r_[0.0, np.arange(1, steps + 1), np.arange(steps - 1, 0, -1)] / steps, np.eye(6)
    parts = [np.outer(up, eye[j]) for j in range(6)]
    beside = [np.outer(up[1:], eye[j]) + 0.5 * eye[(j + i) % 6] for j in range(6) for i in (2, 3)]
    parts += [np.vstack([np.zeros((1, 6)), rows]) for rows in beside]
    x, series = np.vstack(parts), np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    tilt = misalignment * rng.normal(size=(len(parts), 6, 6))
    pan = hanger * rng.normal(size=(len(parts), 6)) * [np.any(part, axis=0) for part in parts]
    applied = x + np.einsum("mk,mkl->ml", x, tilt[series]) + pan[series] * np.any(x, axis=1)[:, None]
    read = applied @ (np.eye(6) + 0.05 * rng.normal(size=(6, 6)))
    read += 1e-3 * rng.normal(size=(len(parts), 6))[series] + 2e-4 * rng.normal(size=read.shape)
    names, rows = tuple(f"g{c}" for c in range(6)), len(x)
    points = CalibrationPoints(
        names, COMPONENTS, ("s",), read, x, np.zeros(rows, int), np.ones(rows), np.ones(6), series=series
    )
    return points, series


@pytest.mark.parametrize("kind", ["misalignment", "hanger"])
def test_what_comes_with_the_first_weight_makes_no_outliers_of_the_tare_points(kind):
    """The tare alone tells the load that hangs in its series, and the hanger: 0.2 % of the weights are 10 sigma."""
    for seed in range(3):
        points, series = weights_beside_others(np.random.default_rng(seed), **{kind: 2e-3 if kind[0] == "m" else 1e-3})
        assert screen_outliers(points).outliers == ()
    points.channels[np.flatnonzero(series == 8)[0], 3] += 0.03
    (outlier,) = screen_outliers(points).outliers
    assert outlier.row - 1 == np.flatnonzero(series == 8)[0] and "g3 seems to read" in outlier.cause


def test_a_small_signal_is_no_wrong_gain():
    """An interaction of 3 % changes by a tenth where the line of action of the load is off by 0.3 %: no wrong gain."""
    rng = np.random.default_rng(4)
    steps, eye = np.r_[0.0, np.arange(1, 6), np.arange(4, 0, -1)] / 5.0, np.eye(3)
    x = np.vstack([np.outer(sign * steps, eye[j]) for _ in range(2) for j in range(3) for sign in (1.0, -1.0)])
    series = np.repeat(np.arange(12), len(steps))
    read = x @ (eye + 0.03 * (1.0 - eye))
    read[series == 7, 1] *= 1.15
    read += 1e-3 * rng.normal(size=(12, 3))[series] + 5e-5 * rng.normal(size=read.shape)
    names, rows = ("a", "b", "c"), len(x)
    points = CalibrationPoints(
        names, COMPONENTS[:3], ("s",), read, x, np.zeros(rows, int), np.ones(rows), np.ones(3), series=series
    )
    assert screen_outliers(points).suspect_series == ()
    points.channels[series == 7, 0] *= 1.03
    assert {each.channel for each in screen_outliers(points).suspect_series} == {"a"}


@pytest.mark.parametrize(("factor", "named"), [(1.0, set()), (1.015, set()), (1.03, {"My"})])
def test_terms_of_one_channel_that_a_single_series_tells_are_no_fault_of_the_others(factor, named):
    """Each direction is a series: without it nothing tells |Fx| of the first channel, nor then anything of the second.

    The curvature of the second is 5 % of its small response. A wrong gain of 3 % beside it is a fault; one of 1.5 % is
    as likely a |My| of 0.75 %.
    """
    up = np.r_[0.0, np.arange(1, 6), np.arange(4, 0, -1)] / 5.0
    loads = np.vstack([np.outer(sign * up, np.eye(3)[j]) for j in range(3) for sign in (1.0, -1.0)])
    series, rng = np.repeat(np.arange(6), len(up)), np.random.default_rng(8)
    read = loads @ np.array([[1.0, 0.1, 0.3], [-0.2, 1.0, 0.1], [0.1, 0.4, 1.0]])
    read += np.c_[0.003 * np.abs(loads[:, 0]), 0.005 * loads[:, 0] ** 2, np.zeros(len(loads))]
    read[series == 5, 2] *= factor
    read += 1e-2 * rng.normal(size=(6, 3))[series] + 1e-4 * rng.normal(size=read.shape)
    rows, names = len(loads), ("a", "b", "c")
    points = CalibrationPoints(
        names, ("Fx", "Fz", "My"), ("s",), read, loads, np.zeros(rows, int), np.ones(rows), np.ones(3)
    )
    found = screen_outliers(points)
    assert {each.load_series.split("(")[1].rstrip(")") for each in found.suspect_series} == named
    # A gain of 3 % on one side is also |My|: which of them, the readings do not tell, and that is said.
    said = [note for note in found.screening_notes if "would explain it as well" in note]
    assert len(said) == len(named) and all("|My| (1.5 % of the linear response)" in note for note in said)
    assert "|Fx|" in found.fit.model.channel_coefficients("a")


def test_an_outlier_is_named_with_its_row_and_channel():
    points = spoiled(lambda channels, _: channels.__setitem__((321, 3), channels[321, 3] + 15 * NOISE))
    found = screen_outliers(points)
    assert [(one.row, one.channel, one.run) for one in found.outliers] == [(322, "g4", "stand")]
    assert found.outliers[0].error == pytest.approx(15 * NOISE, rel=0.4)
    assert found.suspect_series == ()
    assert terms_found(found.fit) == CURVED_NAMES
    assert np.isnan(found.fit.residuals[321]).all() and np.isfinite(found.fit.residuals[320]).all()


CURVED_NAMES = {channel: set(terms) for channel, terms in NONLINEAR_TERMS.items()}


def test_a_wrong_gain_in_one_sequence():
    def change(channels, sequence):
        rows = sequence == 2
        first = channels[rows, 1][0]
        channels[rows, 1] = first + 1.2 * (channels[rows, 1] - first)

    found = screen_outliers(spoiled(change))
    assert [(one.channel, one.resembled_channel) for one in found.suspect_series] == [("g2", "")]
    (one,) = found.suspect_series
    assert one.load_series == "stand rows 41 to 60 (Fz)"
    assert one.gain == pytest.approx(1.2, abs=5 * one.gain_sigma + 0.01)
    assert terms_found(found.fit) == CURVED_NAMES


def test_two_channels_swapped_in_one_load_series():
    def change(channels, sequence):
        rows = sequence == 4
        channels[np.ix_(rows, [2, 5])] = channels[np.ix_(rows, [5, 2])]

    found = screen_outliers(spoiled(change))
    assert {(one.channel, one.resembled_channel) for one in found.suspect_series} == {("g3", "g6"), ("g6", "g3")}
    assert {one.load_series for one in found.suspect_series} == {"stand rows 81 to 100 (My)"}
    assert terms_found(found.fit) == CURVED_NAMES


@pytest.mark.parametrize(("series", "channels"), [(0, [1, 6]), (3, [0, 4]), (5, [2, 7]), (40, [2, 5])])
def test_two_channels_swapped_in_one_load_series_decide_no_reading_of_the_others(series, channels):
    """The two directions of its load then seem to have a zero each."""
    points = stand_points()
    rows = points.load_series == series
    swapped = points.channels.copy()
    swapped[np.ix_(rows, channels)] = swapped[np.ix_(rows, channels[::-1])]
    np.testing.assert_array_equal(replace(points, channels=swapped).load_series, points.load_series)


def test_a_row_that_the_final_fit_predicts_is_included_again():
    points = spoiled(lambda channels, _: channels.__setitem__((321, 3), channels[321, 3] + 15 * NOISE))
    excluded = np.isin(np.arange(len(points.weight)), [100, 321])
    included = points.exclude_rows(excluded)
    fit = fit_calibration_model(included)
    excluded, fit = _include_predicted_rows(points, included, fit, excluded, SEARCHED)
    np.testing.assert_array_equal(np.flatnonzero(excluded), [321])
    assert np.isfinite(fit.residuals[100]).all() and np.isnan(fit.residuals[321]).all()


def test_two_channels_swapped_in_all_runs():
    points = stand_points()
    expected = fit_calibration_model(points, choice=LINEAR_TERMS).model.coefficients[:6].T
    assert find_swapped_channels(points, expected) == ()
    swapped = replace(points, channels=points.channels[:, [0, 4, 2, 3, 1, 5, 6, 7]])
    assert find_swapped_channels(swapped, expected) == ("g2 and g5",)


def test_what_took_no_part_has_no_residuals_in_the_whole_calibration():
    points = spoiled(lambda channels, _: channels.__setitem__((50, 0), channels[50, 0] - 0.1))
    whole = calibrate_all_trims(points)
    assert [one.row for one in whole.outliers] == [51]
    assert np.isnan(whole.residuals[50]).all() and np.isfinite(np.delete(whole.residuals, 50, axis=0)).all()


def test_a_wrong_reading_is_named_in_the_unit_of_its_channel():
    points = stand_points()
    channels = points.channels.copy()
    channels[30, 2] += 0.05
    spoiled = replace(points, channels=channels, reading_units=("V/V",) * channels.shape[1])
    (outlier,) = screen_outliers(spoiled).outliers
    assert outlier.unit == "V/V" and outlier.row == 31
    assert outlier.cause.endswith(f"not {1e3 * channels[30, 2]:.5g} mV/V")
    assert " uV" not in outlier_text(outlier) and "50" in outlier_text(outlier) and "mV/V" in outlier_text(outlier)
    (as_volts,) = screen_outliers(replace(spoiled, reading_units=())).outliers
    assert as_volts.unit is None and as_volts.cause.endswith(f"not {channels[30, 2]:.5g} V")


@pytest.mark.parametrize("curvature", [0.01, 0.05])
def test_a_linear_model_of_a_balance_that_curves_excludes_no_sound_series(curvature):
    """Each direction of a load has another gain than a straight line predicts: in 6 of 6 one had been excluded."""
    rng = np.random.default_rng(int(1000 * curvature))
    steps = np.r_[0.0, 0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25]
    x = np.vstack([np.outer(side * steps, row) for row in np.eye(6) for side in (1, -1)])
    series = np.repeat(np.arange(12), len(steps))
    linear = rng.standard_normal((6, 8))
    signal = x @ linear
    read = signal + curvature * signal**2 / np.abs(linear).sum(axis=0) * 2.0 + 3e-4 * rng.standard_normal((len(x), 8))
    read += 5e-3 * rng.standard_normal((12, 8))[series]
    names, ones = tuple(f"g{i}" for i in range(8)), np.ones(len(x))
    points = CalibrationPoints(names, COMPONENTS, ("r",), read, x, np.zeros(len(x), np.intp), ones, np.ones(6))
    assert not calibrate_all_trims(points, choice=LINEAR_TERMS).suspect_series
    wrong = read.copy()
    wrong[series == 3, 2] *= 1.3
    (found, *_) = calibrate_all_trims(replace(points, channels=wrong), choice=LINEAR_TERMS).suspect_series
    assert found.channel == "g2"
