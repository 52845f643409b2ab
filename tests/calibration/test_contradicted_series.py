"""One load series among several with loads by chance has a mistake: it is excluded and named; sound ones are kept."""

import numpy as np
import pytest

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.campaign.rig.components import COMPONENTS

SERIES, ROWS = 8, 12


def _calibrate(mistake, seed=0, curvature=2e-3, count=SERIES, bad=(3,)):
    """Calibrate with stated series of ten rows of loads by chance and two tares; the `bad` ones have the mistake."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.0, 1.0, (count * ROWS, 6))
    x[::ROWS] = x[ROWS - 1 :: ROWS] = 0.0
    series = np.repeat(np.arange(count), ROWS)
    linear = np.eye(6) + 0.05 * rng.normal(size=(6, 6))
    products = np.stack([x[:, i] * x[:, j] for i in range(6) for j in range(i, 6)], axis=1)
    read = x @ linear + products @ (curvature * rng.normal(size=(21, 6)))
    read += 5e-4 * rng.normal(size=(count, 6))[series] + 2e-5 * rng.normal(size=read.shape)
    mistake(x, read, np.isin(series, bad))
    labels = tuple(str(number + 1) for number in series)
    points = CalibrationPoints(
        tuple(f"g{c + 1}" for c in range(6)),
        COMPONENTS,
        ("stand",),
        read,
        x,
        0 * series,
        np.ones(len(x)),
        np.max(np.abs(x), axis=0),
        stated_series=labels,
        tare_points=~np.any(x, axis=1),
    )
    return calibrate_all_trims(points), linear


def _other_sign(x, read, rows):
    x[rows, 2] *= -1.0


def _pounds(x, read, rows):
    x[rows, 4] /= 4.4482216


def _exchanged(x, read, rows):
    read[np.ix_(rows, [0, 1])] = read[np.ix_(rows, [1, 0])]


@pytest.mark.parametrize(
    ("mistake", "cause"),
    [
        (_other_sign, "its Fz seems to be of the other sign"),
        (_pounds, "its My seems to be in lbf"),
        (_exchanged, "its channels g1 and g2 seem to be exchanged"),
    ],
)
def test_the_series_that_all_others_contradict_is_excluded_and_named(mistake, cause):
    """Loads had been up to 37 % off; five series of 37 were named."""
    whole, linear = _calibrate(mistake)
    assert {each.load_series for each in whole.suspect_series} == {"stand rows 37 to 48 (Fx, Fy, Fz, Mx, My, Mz)"}
    assert whole.suspect_series[0].cause.startswith(cause)
    np.testing.assert_allclose(whole.model.coefficients[:6] / whole.model.calibrated_range[:, None], linear, atol=3e-3)


@pytest.mark.parametrize("curvature", [2e-3, 5e-2])
def test_sound_series_are_kept(curvature):
    whole, _ = _calibrate(lambda x, read, rows: None, seed=1, curvature=curvature)
    assert whole.suspect_series == () and whole.used.all()


def test_one_wrong_row_is_no_wrong_series():
    def slip(x, read, rows):
        x[np.flatnonzero(rows)[4], 2] *= 10.0

    whole, _ = _calibrate(slip, seed=2)
    assert whole.suspect_series == () and [each.row for each in whole.outliers] == [41]


@pytest.mark.parametrize(("count", "bad"), [(5, (1, 3)), (8, (1, 3, 6))])
def test_a_minority_of_wrong_series_is_excluded(count, bad):
    """Two of five, or three of eight: the calibration was refused, as if a load had hardly been applied."""
    whole, linear = _calibrate(_other_sign, count=count, bad=bad)
    assert {each.load_series.split(" ")[2] for each in whole.suspect_series} == {str(ROWS * each + 1) for each in bad}
    np.testing.assert_allclose(whole.model.coefficients[:6] / whole.model.calibrated_range[:, None], linear, atol=5e-3)
