"""Units of loads that the responses of a calibration put in doubt."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from balance_cli.calibration.load_units import doubtful_units
from balance_cli.calibration.result import TrimCalibration
from balance_cli.campaign.rig.components import COMPONENTS

UNITS = ("N", "N", "N", "N m", "N m", "N m")
LARGEST = np.array([400.0, 400.0, 800.0, 150.0, 150.0, 120.0])


def trim(noise=1e-4, unit_of_mz=1.0) -> TrimCalibration:
    """Five strain channels that read the other loads with `noise` [V], and a torque meter without it.

    A signal is 5 V at the largest load. Mz is stated in `unit_of_mz` N m.
    """
    C0 = np.zeros((6, 6))
    C0[:5, :5] = np.diag(5.0 / LARGEST[:5])
    C0[5, 5] = 5.0 / LARGEST[5] * unit_of_mz
    sigma = np.r_[np.full(5, noise), 1e-4]
    largest = LARGEST / np.r_[np.ones(5), unit_of_mz]
    content = SimpleNamespace(
        components=COMPONENTS, C0=C0, noise_covariance=np.diag(sigma**2), calibrated_range=largest, rated_load=None
    )
    return cast(TrimCalibration, content)


def test_friction_in_the_pulleys_of_the_other_loads_is_no_wrong_unit() -> None:
    assert list(doubtful_units(trim(noise=0.1), UNITS)) == []


@pytest.mark.parametrize("noise", [1e-4, 1e-3])
@pytest.mark.parametrize("unit_of_mz", [1000.0, 1e-3])
def test_moments_in_another_unit_are_doubtful(noise: float, unit_of_mz: float) -> None:
    noise = noise if unit_of_mz > 1.0 else 1e-4
    (note,) = doubtful_units(trim(noise, unit_of_mz), UNITS)
    assert "is the unit of Mz right?" in note
