"""The amplitude spectrum: a sine gives a line of its amplitude, whatever the length of the record."""

import numpy as np
import pytest

from balance_cli.signals.amplitude_spectrum import amplitude_spectrum


@pytest.mark.parametrize("count", [1024, 5000, 40_000])
def test_a_sine_gives_a_line_of_its_amplitude(count):
    rate, frequency = 1000.0, 125.0
    time = np.arange(count) / rate
    samples = np.stack([3.0 + 0.7 * np.cos(2 * np.pi * frequency * time + 0.4), np.full(count, 5.0)], axis=1)
    x, amplitude = amplitude_spectrum(samples, rate, longest=2000)
    peak = int(np.argmax(amplitude[:, 0]))
    assert x[peak] == pytest.approx(frequency, abs=x[1])
    assert amplitude[peak, 0] == pytest.approx(0.7, rel=1e-3 if count >= 2000 else 0.02)
    assert amplitude[:, 1].max() < 1e-12


def test_missing_samples_count_as_the_mean_and_one_sample_is_refused():
    samples = np.random.default_rng(2).normal(size=(500, 1)) + 7.0
    samples[100] = np.nan
    assert np.isfinite(amplitude_spectrum(samples, 10.0)[1]).all()
    with pytest.raises(ValueError, match="two samples"):
        amplitude_spectrum(samples[:1], 10.0)
