"""Rows in the midst of a load series, or half of all series, that the others contradict."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.large_residual import describe_large_residuals, large_residuals
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.cli.calibration_text import math_model_warnings

ROWS = 80


def _points(mistake, stated=(), seed=0, curvature=2e-3, noise=2e-5):
    """Loads by chance in one run, whose first and last row are unloaded, as one series or as stated; with a mistake."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.0, 1.0, (ROWS, 6))
    x[0] = x[-1] = 0.0
    linear = np.eye(6) + 0.05 * rng.normal(size=(6, 6))
    products = np.stack([x[:, i] * x[:, j] for i in range(6) for j in range(i, 6)], axis=1)
    read = 0.1 + x @ linear + products @ (curvature * rng.normal(size=(21, 6))) + noise * rng.normal(size=(ROWS, 6))
    mistake(x, read)
    points = CalibrationPoints(
        tuple(f"g{c + 1}" for c in range(6)),
        COMPONENTS,
        ("stand",),
        read,
        x,
        np.zeros(ROWS, int),
        np.ones(ROWS),
        np.max(np.abs(x), axis=0),
        stated_series=tuple(stated),
    )
    return points, linear


def _other_sign(rows):
    def change(x, read):
        x[rows, 0] *= -1.0

    return change


def _exchanged(rows):
    def change(x, read):
        read[rows, :2] = read[rows, 1::-1]

    return change


@pytest.mark.parametrize(
    ("mistake", "cause"),
    [
        (_other_sign, "its Fx seems to be of the other sign"),
        (_exchanged, "its channels g1 and g2 seem to be exchanged"),
    ],
)
@pytest.mark.parametrize("rows", [slice(30, 42), slice(60, 79)])
def test_rows_without_series_that_the_others_contradict_are_excluded(mistake, cause, rows):
    """No series states them, so that none could be left out: loads had been 26 % off without a warning."""
    points, linear = _points(mistake(rows))
    whole = calibrate_all_trims(points)
    assert whole.suspect_series[0].cause.startswith(cause)
    excluded = np.flatnonzero(~whole.used)
    assert excluded.min() >= rows.start and excluded.max() < rows.stop and len(excluded) >= rows.stop - rows.start - 3
    np.testing.assert_allclose(whole.model.coefficients[:6] / whole.model.calibrated_range[:, None], linear, atol=1e-2)


@pytest.mark.parametrize(("curvature", "seed"), [(2e-3, 1), (5e-2, 2)])
def test_sound_rows_are_kept(curvature, seed):
    whole = calibrate_all_trims(_points(lambda x, read: None, seed=seed, curvature=curvature)[0])
    assert whole.suspect_series == () and whole.used.all() and large_residuals(whole) == ()


def test_a_zero_that_moved_in_a_series_is_no_wrong_block():
    def move(x, read):
        read[60:] += 0.2

    whole = calibrate_all_trims(_points(move)[0])
    assert whole.suspect_series == ()


def test_halves_that_contradict_each_other_are_named_and_none_is_excluded():
    """A supply that fell to half: four of eight series have half of the gain, and loads were 18 % off in silence."""

    def halve(x, read):
        read[ROWS // 2 :] *= 0.5

    points, _ = _points(halve, [str(number) for number in np.repeat(np.arange(8), ROWS // 8)])
    whole = calibrate_all_trims(points)
    (note,) = (note for note in whole.screening_notes if "contradict each other" in note)
    assert note.startswith(
        "stand rows 1 to 40 (Fx, Fy, Fz, Mx, My, Mz): its loads seem to be 2 times as large as stated"
    )
    assert whole.used.all() and next(math_model_warnings(whole)) == note
    many = replace(whole, screening_notes=("a row is left out", *whole.screening_notes))
    assert next(math_model_warnings(many)) == note and sum(each == note for each in math_model_warnings(many)) == 1
    large = large_residuals(whole)
    assert {each.component for each in large} == set(COMPONENTS) and large[0].percent > 10.0
    assert describe_large_residuals(large).startswith("the calibration does not describe its own loads: ")


def test_every_other_series_with_another_gain_is_named():
    """No run of rows is wrong, but half of the series is."""
    series = np.repeat(np.arange(8), ROWS // 8)

    def reduce(x, read):
        x[series % 2 == 1, 1] *= 0.8

    whole = calibrate_all_trims(_points(reduce, map(str, series))[0])
    (note,) = (note for note in whole.screening_notes if "contradict each other" in note)
    assert note.startswith("4 of 8 load series, stand rows ") and "g2 changes" in note


def test_noise_that_repeated_rows_show_is_no_contradiction():
    """Readings that scatter by 2 % of the range, as unloaded rows tell, are described as well as they can be."""

    def unload(x, read):
        read[::5] -= x[::5] @ linear
        x[::5] = 0.0

    linear = np.eye(6) + 0.05 * np.random.default_rng(5).normal(size=(6, 6))
    noisy = calibrate_all_trims(_points(unload, seed=5, curvature=0.0, noise=0.02)[0])
    assert large_residuals(noisy) == ()
    scattered = np.random.default_rng(6).normal(size=(ROWS, 6))

    def misload(x, read):
        x += 0.03 * scattered * (x != 0)

    wrong = calibrate_all_trims(_points(misload)[0])
    assert {each.component for each in large_residuals(wrong)} == set(COMPONENTS)


def test_the_same_loads_in_series_that_disagree_are_no_scatter_of_readings():
    """Half of the series of single loads with half the supply: their contradiction had passed for noise."""
    up = np.array([0.0, 0.5, 1.0, 0.5, 0.0])
    x = np.vstack([np.outer(side * up, np.eye(6)[j]) for _ in range(2) for j in range(6) for side in (1.0, -1.0)])
    series, rng = np.repeat(np.arange(24), len(up)), np.random.default_rng(7)
    read = (x @ (np.eye(6) + 0.05 * rng.normal(size=(6, 6)))) * np.where(series < 12, 1.0, 0.7)[:, None]
    points = CalibrationPoints(
        tuple(f"g{c + 1}" for c in range(6)),
        COMPONENTS,
        ("stand",),
        read + 2e-5 * rng.normal(size=x.shape),
        x,
        0 * series,
        np.ones(len(x)),
        np.ones(6),
        stated_series=tuple(map(str, series)),
    )
    assert {each.component for each in large_residuals(calibrate_all_trims(points))} == set(COMPONENTS)
