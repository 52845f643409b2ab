"""Lines of a harmonic of a rotor whose speed varies."""

import numpy as np
import pytest

from balance_cli.signals.rotor.azimuth import azimuth_from_pulses
from balance_cli.signals.rotor.harmonic_spectrum import harmonic_lines
from balance_cli.signals.rotor.harmonics import Harmonics


def test_a_mode_without_damping_is_remembered_for_the_length_of_the_record():
    """A model may have a mode that never decays: the memory, and the work, must not follow it to infinity."""
    azimuth = azimuth_from_pulses(np.arange(101) / 10.0)
    spectra = Harmonics(
        run="run",
        names=(),
        frequency_hz=np.array([0.0, 10.0]),
        amplitude=np.zeros((2, 0), complex),
        covariance=np.zeros((2, 0, 0), complex),
        dof=np.ones(2),
        interval=(0.0, 10.0),
        revolutions=(0, 100),
        samples=1000,
    )
    endless, long = (harmonic_lines(azimuth, spectra, (1,), decay)[0] for decay in (np.inf, 10.0))
    np.testing.assert_array_equal(endless.frequency, long.frequency)
    assert endless.weight.sum() == pytest.approx(1.0)
