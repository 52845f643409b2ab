"""Gains that drift over a schedule and a constant load that all loaded rows lack are named; sound rows have no note."""

import numpy as np
import pytest

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.campaign.rig.components import COMPONENTS

SERIES, ROWS = 8, 12
DRIFTS, LACKS = "from the first to the last row", "lack a constant part"


def _notes(mistake, seed=0, curvature=2e-3, noise=2e-5):
    """The notes on eight stated series of ten loads by chance and two unloaded rows."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.0, 1.0, (SERIES * ROWS, 6))
    x[::ROWS] = x[ROWS - 1 :: ROWS] = 0.0
    series = np.repeat(np.arange(SERIES), ROWS)
    true = mistake(x)
    products = np.stack([true[:, i] * true[:, j] for i in range(6) for j in range(i, 6)], axis=1)
    read = true @ (np.eye(6) + 0.05 * rng.normal(size=(6, 6))) + products @ (curvature * rng.normal(size=(21, 6)))
    if mistake is _drifting:
        read *= 1.0 + 0.03 * np.linspace(0.0, 1.0, len(x))[:, None]
    read += 5e-4 * rng.normal(size=(SERIES, 6))[series] + noise * rng.normal(size=read.shape)
    points = CalibrationPoints(
        tuple(f"g{c + 1}" for c in range(6)),
        COMPONENTS,
        ("stand",),
        read,
        x,
        0 * series,
        np.ones(len(x)),
        np.max(np.abs(x), axis=0),
        stated_series=tuple(str(number + 1) for number in series),
        tare_points=~np.any(x, axis=1),
    )
    return [note for note in calibrate_all_trims(points).screening_notes if DRIFTS in note or LACKS in note]


def _sound(x):
    return x


def _drifting(x):
    return x


def _with_hanger(x):
    return x - 0.02 * np.any(x, axis=1)[:, None] * np.eye(6)[2]


def test_a_supply_that_drifts_is_named_with_its_size():
    """3 % from the first to the last row left residuals of 0.5 %, and loads up to 1 % off, without a word."""
    (note,) = _notes(_drifting)
    drift = float(note.split("about ")[1].split(" %")[0])
    assert drift == pytest.approx(3.0, abs=0.4) and note.startswith("all channels change by about +")


def test_a_hanger_that_only_loaded_rows_have_is_named_with_its_weight():
    """2 % of the range of Fz made its loads 1.4 % wrong, which terms |F| had partly followed."""
    (note,) = _notes(_with_hanger)
    lacking = float(note.split("about Fz ")[1].split(" ")[0])
    assert lacking == pytest.approx(-0.02, rel=0.15)


@pytest.mark.parametrize(("curvature", "noise"), [(2e-3, 2e-5), (0.0, 1e-2), (5e-2, 1e-4)])
def test_sound_rows_have_no_note(curvature, noise):
    assert _notes(_sound, seed=3, curvature=curvature, noise=noise) == []
