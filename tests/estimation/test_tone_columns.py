"""Lines of a steady tone, against a Fourier transform of its samples, and none where no line shows it."""

import numpy as np
import pytest

from balance_cli.estimation.tone_columns import tone_columns
from balance_cli.signals.waveform_types import BinSampling
from balance_cli.signals.waveforms import nonperiodic_spectrum_with_waveform
from balance_cli.simulation import Noise, SweepPlan, simulate_run, true_rig
from tests.support.rigs import rotor_balance

RATE, COUNT = 200.0, 4170
BINS = np.arange(26, 708)


class Unfiltered:
    """A waveform whose lines are the bins, without a filter."""

    def filter_gain(self, frequency):
        return 1.0

    def combine_bins(self, values):
        return values


def columns(f):
    frequency = BINS * RATE / COUNT
    count = np.full(len(BINS), COUNT)
    sampling = BinSampling(frequency, np.zeros(len(BINS)), 1 / RATE, count, np.ones(len(BINS)), frequency)
    return tone_columns(Unfiltered(), sampling, f)


@pytest.mark.parametrize("f", [1.26, 17.03, 33.9])
def test_a_tone_among_the_bins_has_the_lines_of_its_samples(f):
    time = np.arange(COUNT) / RATE
    tone = np.stack([np.cos(2 * np.pi * f * time), -np.sin(2 * np.pi * f * time)], axis=1)
    np.testing.assert_allclose(columns(f)[0], np.fft.fft(tone, axis=0)[BINS] * 2 / COUNT, atol=1e-9)


@pytest.mark.parametrize("f", [50.4, 49.5, 0.9])
def test_a_tone_beyond_all_bins_has_none(f):
    """A smooth error at the end of the band had passed for its leakage: two channels with 0.4 V of mains, explained."""
    assert not any(part.any() for part in columns(f))


def test_a_tone_has_no_part_beyond_the_bins_that_the_lines_of_a_stepped_record_use():
    """Three channels of a sound rig had up to 22 mV there, explained; hum among them shows behind the last line."""
    geometry = rotor_balance()
    plan = SweepPlan(run="sweep-Fx", excited=("Fx",), level=(60.0,), excitation="stepped", period=2.0, periods=5)
    run, _ = simulate_run(true_rig(geometry), plan, Noise(), 5)
    spectrum = nonperiodic_spectrum_with_waveform(run, geometry.channel_names, geometry)
    spectrum = spectrum.select(spectrum.frequency < 0.8 * spectrum.frequency.max())
    sampling = spectrum.waveform.bin_sampling(spectrum.frequency, spectrum.window)
    last, used, last_bin = spectrum.frequency.max(), sampling.used.max(), sampling.frequency.max()
    assert last + 0.5 < used < last_bin - 0.5
    beyond, among = (tone_columns(spectrum.waveform, sampling, 0.5 * (used + f)) for f in (last_bin, last))
    assert not any(part.any() for part in beyond)
    assert all(part.any() for part in among)
