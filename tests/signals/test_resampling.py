"""Band-limited resampling against the closed form of tones."""

import numpy as np
import pytest

from balance_cli.signals.resampling import PASSBAND, Resampler, kernel_half_length


def resample(signal, rate_in, rate_out, offset, duration=3.0, block=777):
    """The signal (a function of time) resampled, and the times of its samples."""
    samples = signal(np.arange(int(duration * rate_in)) / rate_in)[:, None]
    start = offset + kernel_half_length(rate_in, rate_out)
    count = int((duration - start - kernel_half_length(rate_in, rate_out)) * rate_out) - 2
    resampler = Resampler(lambda a, b: samples[a:b], rate_in, rate_out, start, count)
    blocks = [resampler.read(k, min(k + block, count)) for k in range(0, count, block)]
    return np.concatenate(blocks)[:, 0], start + np.arange(count) / rate_out


RATES = [(51200.0, 1024.0), (1000.0, 1024.0), (1024.0, 1024.0), (48000.0, 44100.0), (1000.0, 999.98765)]


@pytest.mark.parametrize(("rate_in", "rate_out"), RATES)
@pytest.mark.parametrize("share", [0.02, 0.5, 0.97])
def test_tones_in_the_passband_keep_amplitude_and_phase(rate_in, rate_out, share):
    frequency = 0.5 * PASSBAND * share * min(rate_in, rate_out)
    tone = lambda time: np.cos(2 * np.pi * frequency * time + 0.3)  # noqa: E731
    values, time = resample(tone, rate_in, rate_out, 0.0123)
    assert np.abs(values - tone(time)).max() < 2e-5


@pytest.mark.parametrize(("rate_in", "rate_out"), [(51200.0, 1024.0), (48000.0, 44100.0)])
def test_what_would_alias_is_removed(rate_in, rate_out):
    frequency = min(0.51 * rate_out, 0.49 * rate_in)
    values, _ = resample(lambda time: np.cos(2 * np.pi * frequency * time), rate_in, rate_out, 0.0)
    assert np.abs(values).max() < 2e-5


def test_a_constant_stays():
    values, _ = resample(np.ones_like, 51200.0, 1000.0, 0.001)
    assert np.abs(values - 1.0).max() < 1e-12
