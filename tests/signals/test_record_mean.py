"""Means of records that do not repeat, against the exact response of an oscillator with a late channel."""

from types import SimpleNamespace

import numpy as np
import pytest

from balance_cli.signals.record_mean import delay_free_mean
from balance_cli.signals.sampled_waveform import hann_mean

RATE, SAMPLES, DWELL = 200.0, 4900, 136
LOWEST = 1.1
GAINS = np.array([2.0, -0.5])
"""Volts per newton at rest of two channels, the second of which has a low-pass."""


def responses(frequency, resonance=9.0):
    """T (k, 2) of an oscillator with 2 % of damping, exp(+j omega t)."""
    s = 2j * np.pi * frequency
    w = 2 * np.pi * resonance
    oscillator = w**2 / (s**2 + 0.04 * w * s + w**2)
    return GAINS * oscillator[:, None] / np.stack([np.ones_like(s), 1 + s / (2 * np.pi * 70.0)], axis=1)


def stepped_load():
    """One frequency after the other, each left in the middle of a cycle; zero before and after the record."""
    time = np.arange(SAMPLES)
    step, inside = time // DWELL, time % DWELL / DWELL
    edge = np.clip(np.minimum(inside, 1 - inside) / 0.1, 0, 1)
    frequency = LOWEST * 1.1**step
    return 400.0 * np.sin(2 * np.pi * frequency * inside * DWELL / RATE) * np.sin(np.pi / 2 * edge) ** 2


def record(load, **settings):
    """Samples (n, 3) of the channels and the load of a record from rest."""
    count = 8 * len(load)
    spectrum = np.fft.rfft(load, count)
    channels = np.fft.irfft(spectrum[:, None] * responses(np.fft.rfftfreq(count, 1 / RATE), **settings), count, axis=0)
    return np.column_stack([channels[: len(load)], load])


def lines(**settings):
    """Lines of the response, from the lowest frequency on."""
    frequency = np.linspace(LOWEST, 40.0, 400)
    loads = np.exp(1j * frequency)[:, None]
    channels = responses(frequency, **settings) * loads
    return SimpleNamespace(frequency=frequency, loads=loads, channels=channels, channel_names=("a", "b"))


def test_the_mean_of_late_channels_is_that_of_the_load():
    samples = record(stepped_load())
    at_rest = GAINS * hann_mean(samples[:, 2])
    delayed = np.abs(hann_mean(samples)[:2] - at_rest)
    mean, error = delay_free_mean(samples, RATE, lines())
    assert np.all(delayed > 1e-4 * np.abs(at_rest))
    assert np.all(np.abs(mean[:2] - at_rest) < error)
    assert error == pytest.approx(0.1 * delayed, rel=0.2)
    assert mean[2] == hann_mean(samples)[2]


def test_near_a_resonance_the_delay_is_an_error_of_the_mean():
    near = {"resonance": 1.3}
    samples = record(stepped_load(), **near)
    mean, error = delay_free_mean(samples, RATE, lines(**near))
    assert np.array_equal(mean, hann_mean(samples))
    assert np.all(error > 0.0)


def test_too_few_lines_tell_no_delay():
    samples, few = record(stepped_load()), lines()
    few.frequency, few.loads, few.channels = few.frequency[:1], few.loads[:1], few.channels[:1]
    mean, error = delay_free_mean(samples, RATE, few)
    assert np.array_equal(mean, hann_mean(samples)) and not error.any()
