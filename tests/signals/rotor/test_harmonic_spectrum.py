"""Lines of a harmonic of a rotor whose speed varies."""

import numpy as np
import pytest

from balance_cli.signals.rotor.azimuth import azimuth_from_pulses
from balance_cli.signals.rotor.harmonic_spectrum import HarmonicLines, harmonic_lines
from balance_cli.signals.rotor.harmonics import Harmonics


def test_a_mode_without_damping_is_remembered_for_the_length_of_the_record():
    """A model may have a mode that never decays: the memory, and the work, must not follow it to infinity."""
    azimuth = azimuth_from_pulses(np.arange(101) / 10.0)
    spectra = _spectra(10.0, (0, 100), 1)
    endless, long = (harmonic_lines(azimuth, spectra, (1,), decay)[0] for decay in (np.inf, 10.0))
    np.testing.assert_array_equal(endless.frequency, long.frequency)
    assert endless.weight.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("first", [20, 69], ids=["long", "short"])
def test_at_constant_speed_the_response_is_that_at_one_frequency_even_beside_a_light_mode(first):
    """259.2 Hz beside a mode at 254.5 Hz; the slopes of the mode count in the far lines of a short record."""
    speed, frequency, damping_ratio = 43.2, 254.54, 0.008
    azimuth = azimuth_from_pulses(np.arange(120) / speed)
    spectra = _spectra(speed, (first, 119), 6)
    lines = harmonic_lines(azimuth, spectra, (6,), decay_time=0.6)[0]
    average = lines.weight @ _resonance(lines.frequency / frequency, damping_ratio)
    assert abs(average / _resonance(6 * speed / frequency, damping_ratio) - 1.0) < 3e-6


def test_far_lines_beyond_a_measured_response_are_taken_at_its_end():
    """The record of a campaign whose eighth harmonic, 143 Hz, has lines up to 150.3 Hz; sweeps end at 150 Hz."""
    lines = HarmonicLines(np.array([140.0, 143.0, 150.3]), np.array([1e-6, 1.0, 1e-6]) + 0j)
    np.testing.assert_array_equal(lines.moved_into(141.0, 150.0).frequency, [141.0, 143.0, 150.0])
    np.testing.assert_array_equal(lines.moved_into(-np.inf, np.inf).frequency, lines.frequency)
    np.testing.assert_array_equal(lines.moved_into(141.0, 142.0).frequency, [141.0, 143.0, 142.0])


def _resonance(ratio, damping_ratio):
    return 1.0 / (1.0 - ratio**2 + 2j * damping_ratio * ratio)


def _spectra(speed, revolutions, n):
    """What `harmonic_lines` reads of the harmonics 0 to n of a record between two of its revolutions."""
    return Harmonics(
        run="run",
        names=(),
        frequency_hz=speed * np.arange(n + 1),
        amplitude=np.zeros((n + 1, 0), complex),
        covariance=np.zeros((n + 1, 0, 0), complex),
        dof=np.ones(n + 1),
        interval=(revolutions[0] / speed, revolutions[1] / speed),
        revolutions=revolutions,
        samples=1000,
    )
