"""Products of loads that one load series tells: fitted and named, not excluded as a wrong gain."""

import numpy as np
import pytest

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.untested_products import gain_like_products
from balance_cli.campaign.rig.components import COMPONENTS

NOISE, ROWS = 3e-4, 6


def loads():
    """Each load alone in both directions, then each beside the next that hangs; series open with their tare."""
    steps, eye = np.arange(1, ROWS) / (ROWS - 1.0), np.eye(3)
    parts = [np.outer(np.r_[0.0, sign * steps], eye[j]) for j in range(3) for sign in (1.0, -1.0)]
    beside = [np.outer(steps, eye[j]) + 0.6 * eye[(j + 1) % 3] for j in range(3)]
    return np.vstack([*parts, *(np.vstack([np.zeros(3), part]) for part in beside)])


def calibrated(change, x=None, series=None):
    """A calibration of three loads on four channels, with changed readings of its loads x (m, 3) and series (m,)."""
    rng = np.random.default_rng(4)
    x, series = (loads(), np.repeat(np.arange(9), ROWS)) if x is None else (x, series)
    read = (
        x @ rng.normal(size=(3, 4))
        + 5e-3 * rng.normal(size=(series[-1] + 1, 4))[series]
        + NOISE * rng.normal(size=(len(x), 4))
    )
    read = change(read, x, series)
    names = tuple(f"g{c + 1}" for c in range(4))
    return calibrate_all_trims(
        CalibrationPoints(
            names, COMPONENTS[:3], ("stand",), read, x, np.zeros(len(x), int), np.ones(len(x)), np.ones(3)
        )
    )


@pytest.mark.parametrize("size", [0.02, 0.05])
def test_a_product_that_one_series_shows_is_fitted_and_named(size):
    whole = calibrated(lambda read, x, _: read + size * np.outer(x[:, 1] * x[:, 2], [1.0, 0.0, 0.0, 0.0]))
    assert whole.suspect_series == () and whole.outliers == ()
    assert whole.model.terms[3:] == ("Fy Fz",)
    assert whole.model.channel_coefficients("g1")["Fy Fz"] == pytest.approx(size, abs=3e-3)
    (note,) = whole.screening_notes
    assert note.startswith("products that rest on one load series each: Fy Fz (")
    # A wrong gain of that series looks the same: sigma of both loads together contains the product and none.
    untested = whole.untested_products
    variance = untested.reading_variance([[0.0, 0.8, 0.7]])[0]
    assert np.sqrt(variance[0]) == pytest.approx(0.56 * size / np.sqrt(2.0), rel=0.15)
    assert untested.names([0.0, 0.8, 0.7])[0] == "Fy Fz"


def test_a_gain_beyond_any_product_is_a_fault_and_the_product_is_told_by_excluded_rows_only():
    def doubled(read, x, series):
        first = read[series == 7][0]
        return np.where((series == 7)[:, None], first + (read - first) * [1.5, 1.0, 1.0, 1.0], read)

    whole = calibrated(doubled)
    assert {suspect.channel for suspect in whole.suspect_series} == {"g1"}
    assert whole.model.unsupported_terms["Fy Fz"] == "Fy and Fz were loaded together in excluded rows only"
    assert whole.outliers == ()


def test_products_of_poses_look_like_no_gain():
    """All loads at once, in one series beside others or alone: no gain error changes with the products of its loads."""
    poses = np.random.default_rng(2).uniform(-1.0, 1.0, (40, 3))
    for x in (poses, np.vstack([loads()[: 6 * ROWS], poses])):
        series = np.r_[np.repeat(np.arange(6), ROWS), np.full(40, 6)][-len(x) :]
        model = calibrated(lambda read, x, _: read + 0.05 * x[:, [1]] * x[:, [2]], x, series).model
        assert "Fy Fz" in model.terms and gain_like_products(model, x / model.calibrated_range, series) == []


def test_a_moment_about_another_point_in_the_one_series_of_a_product_is_a_fault():
    """It spoils the predictions of most series, and the product that only it tells explained a part of it."""
    rng, steps = np.random.default_rng(8), np.r_[0:6, 4:-6:-1, -4:1] / 5.0
    pairs = [(0, 4), (1, 3), (2, 3), (2, 4), (0, 2), (1, 2)]
    parts = [*np.eye(6), *(np.eye(6)[i] + np.eye(6)[j] for i, j in pairs)]
    x, series = np.vstack([np.outer(steps, part) for part in parts]), np.repeat(np.arange(12), len(steps))
    read = x @ rng.normal(size=(6, 8)) + 2e-4 * rng.normal(size=(len(x), 8))
    x[series == 10, 4] += 0.3 * x[series == 10, 0]
    whole = calibrate_all_trims(
        CalibrationPoints(
            tuple(f"g{c}" for c in range(8)), COMPONENTS, ("stand",), read, x, 0 * series, np.ones(len(x)), np.ones(6)
        )
    )
    assert {suspect.load_series for suspect in whole.suspect_series} == {"stand rows 211 to 231 (Fx, Fz, My)"}
    cause = whole.suspect_series[0].cause
    assert cause.startswith("-0.3 times its Fx seems to be missing in its My, as of another moment center")
    assert whole.model.unsupported_terms["Fx Fz"] == "Fx and Fz were loaded together in excluded rows only"
