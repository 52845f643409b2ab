"""What is plainly wrong in a calibration is named, and nothing in a sound one."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.fit import fit_calibration_model
from balance_cli.calibration.outliers import _include_predicted_rows, screen_outliers
from balance_cli.calibration.suspect_series import _find_suspect_series, find_swapped_channels
from balance_cli.calibration.term_choice import LINEAR_TERMS, SEARCHED
from balance_cli.calibration.terms import term_values
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.cli.calibration_text import outlier_text
from tests.support.calibration_stand import CHANNELS, NOISE, NONLINEAR_TERMS, stand_points, true_model


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


def test_curved_terms_are_no_fault_of_the_sequences_they_show_in():
    """By the loads alone many sequences are off; the terms explain them."""
    points = stand_points()
    straight = fit_calibration_model(points, choice=LINEAR_TERMS)
    assert any(_find_suspect_series(points, straight).values())
    assert screen_outliers(points).suspect_series == ()


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
