"""Lines of a harmonic of a rotor whose speed varies."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from balance_cli.signals.rotor.azimuth import azimuth_from_pulses
from balance_cli.signals.rotor.edge_weight import edge_weight
from balance_cli.signals.rotor.harmonic_spectrum import HarmonicLines, harmonic_lines
from balance_cli.signals.rotor.harmonics import Harmonics


def test_a_mode_without_damping_is_remembered_for_the_length_of_the_record():
    """A model may have a mode that never decays: the memory, and the work, must not follow it to infinity."""
    azimuth = azimuth_from_pulses(np.arange(101) / 10.0)
    spectra = _spectra(10.0, (0, 100), 1)
    endless, long = (harmonic_lines(azimuth, spectra, (1,), decay)[0] for decay in (np.inf, 10.0))
    np.testing.assert_array_equal(endless.frequency, long.frequency)
    assert endless.weight.sum() == pytest.approx(1.0)


def test_at_constant_speed_a_harmonic_on_a_light_mode_is_exact_in_ten_revolutions():
    """The mode rings for longer than the record; a load that faded out would leave several percent of its transient."""
    azimuth = azimuth_from_pulses(0.3 + np.arange(11) / 17.0)
    spectra = _spectra(17.0, (0, 10), 2)
    lines = harmonic_lines(azimuth, spectra, (2,), decay_time=1.5)[0]
    average = lines.weight @ _resonance(lines.frequency / 34.1, 0.01)
    assert abs(average / _resonance(34.0 / 34.1, 0.01) - 1.0) < 1e-9


def test_where_the_speed_changes_the_response_is_that_of_the_equation_of_motion():
    """A mode that a harmonic passes, integrated in time; the past before the pulses is at their first speed."""
    speed, rate, mode, damping_ratio = 17.0, 8000.0, 34.1, 0.01
    time = np.arange(int(12.0 * rate)) / rate - 4.0
    turns = speed * time + 0.05 * np.where(time > 0.0, time, 0.0) ** 3 / 3.0
    pulses = np.interp(np.arange(int(turns[-1]) + 1), turns, time)
    azimuth = azimuth_from_pulses(pulses)
    last = azimuth.turns
    w, mean = 2.0 * np.pi * mode, azimuth.mean_rate
    warped = 2.0 * rate * np.tan(w / (2.0 * rate))  # the bilinear transform lowers frequencies
    bilinear = signal.bilinear([warped**2], [1.0, 2.0 * damping_ratio * warped, warped**2], rate)
    load = np.exp(4j * np.pi * turns)
    driven = signal.lfilter(*bilinear, load)
    psi = azimuth.psi(time)
    used = np.isfinite(psi)
    weight = edge_weight(psi[used] / (2.0 * np.pi), 0, last)
    measured = np.sum(weight * driven[used] * load[used].conj()) / weight.sum()
    spectra = replace(_spectra(mean, (0, last), 2), interval=(azimuth.first, azimuth.last))
    lines = harmonic_lines(azimuth, spectra, (2,), decay_time=6.0 / (damping_ratio * w))[0]
    assert abs(lines.weight @ _resonance(lines.frequency / mode, damping_ratio) / measured - 1.0) < 1e-3


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
