"""Load series without an unloaded row: named where their zero is off what the unloaded balance reads beside them."""

import numpy as np
import pytest

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.fit import CalibrationPoints

STEPS = np.array([0.1, 0.2, 0.27, 0.3, 0.4, 0.41, 0.7, 1.0])
LOADS = 15.0 * np.r_[-STEPS[::-1], 0.0, STEPS]
"""One sweep of a beam cell [N] from full load down through zero, one unloaded row in the middle."""
SLOPE, NOISE = 27550.0, 60.0


def calibrated(offset, seed=0):
    """The sweep with an `offset` [N] in the readings of the rows above zero."""
    rng = np.random.default_rng(seed)
    read = -143700.0 + SLOPE * (LOADS + offset * (LOADS > 0)) + NOISE * rng.normal(size=len(LOADS))
    return calibrate_all_trims(
        CalibrationPoints(
            *(("cell",), ("Fz",), ("beam",), read[:, None], LOADS[:, None]),
            *(np.zeros(len(LOADS), int), np.ones(len(LOADS)), np.array([15.0])),
        )
    )


@pytest.mark.parametrize("offset", [0.27, -0.05])
def test_a_constant_load_that_the_table_lacks_is_named_with_its_size(offset):
    whole = calibrated(offset)
    assert whole.model.channel_coefficients("cell")["Fz"] == pytest.approx(15.0 * SLOPE, rel=1e-3)
    (note,) = whole.screening_notes
    assert note.startswith("beam rows 10 to 17 (Fz): no unloaded row tells the zero")
    stated = float(note.split(" put it ")[1].split(" %")[0])
    assert stated == pytest.approx(100.0 * abs(offset) / 15.0, abs=0.05)
    assert "off the unloaded row 9" in note


def test_sound_sweeps_have_no_note():
    assert [calibrated(0.0, seed).screening_notes for seed in range(30)] == [()] * 30
