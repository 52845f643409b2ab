"""Lines of a steady tone, against a Fourier transform of its samples, and none where no line shows it."""

import numpy as np
import pytest

from balance_cli.estimation.tone_columns import tone_columns
from balance_cli.signals.waveform_types import BinSampling

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
    sampling = BinSampling(frequency, np.zeros(len(BINS)), 1 / RATE, np.full(len(BINS), COUNT), np.ones(len(BINS)))
    return tone_columns(Unfiltered(), sampling, f)


@pytest.mark.parametrize("f", [1.26, 17.03, 33.9])
def test_a_tone_among_the_bins_has_the_lines_of_its_samples(f):
    time = np.arange(COUNT) / RATE
    tone = np.stack([np.cos(2 * np.pi * f * time), -np.sin(2 * np.pi * f * time)], axis=1)
    np.testing.assert_allclose(columns(f)[0], np.fft.fft(tone, axis=0)[BINS] * 2 / COUNT, atol=1e-9)


@pytest.mark.parametrize("f", [50.4, 49.5])
def test_a_tone_beyond_all_bins_has_none(f):
    """A smooth error at the end of the band had passed for its leakage: two channels with 0.4 V of mains, explained."""
    assert not any(part.any() for part in columns(f))
