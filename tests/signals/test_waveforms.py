"""Waveforms of the channels for nonlinear forces: reduction of their noise."""

import numpy as np
import pytest

from balance_cli.signals import waveforms
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.signals.waveforms import LEAST_FILTER_GAIN, SMOOTHING_LINES, nonperiodic_spectrum_with_waveform
from balance_cli.simulation import Noise, SweepPlan, simulate_run, true_rig
from tests.support.rigs import rotor_balance


def noise(rng, bins, channels):
    """Complex amplitudes of unit power."""
    z = rng.standard_normal((2, bins, channels))
    return (z[0] + 1j * z[1]) / np.sqrt(2.0)


def test_noise_without_signal_is_removed():
    """With the mean power of neighbors; with its own power alone an amplitude keeps E1(1) = 0.219 of the noise."""
    z = noise(np.random.default_rng(1), 20000, 2)
    remaining = [np.mean(np.abs(z * waveforms._wiener_gain(z, np.ones(2), n)) ** 2) for n in (1, SMOOTHING_LINES)]
    assert remaining[0] == pytest.approx(0.219, abs=0.01)
    assert remaining[1] < 0.002


def test_a_signal_above_the_noise_remains():
    """With ten times the power of the noise in a band, nine tenths of each amplitude remain, and none outside."""
    rng = np.random.default_rng(2)
    band = np.zeros((6000, 1))
    band[2000:4000] = 1.0
    z = np.sqrt(9.0) * noise(rng, 6000, 1) * band + noise(rng, 6000, 1)
    share = waveforms._wiener_gain(z, np.ones(1), SMOOTHING_LINES)
    assert np.mean(share[2010:3990]) == pytest.approx(0.9, abs=0.03)
    assert np.mean(share[:1990] > 0) < 0.005


def test_a_channel_without_noise_keeps_everything():
    z = noise(np.random.default_rng(3), 100, 1)
    assert np.all(waveforms._wiener_gain(z, np.zeros(1), SMOOTHING_LINES) == 1.0)


def test_a_stepped_record_comes_nearer_the_one_without_noise():
    """Outside the band of the steps all noise is removed; in total more than 30 % of its power."""
    geometry = rotor_balance()
    rig = true_rig(geometry)
    plan = SweepPlan(run="sweep-Fx", excited=("Fx",), level=(60.0,), excitation="stepped", period=2.0, periods=5)
    noisy, clean = (simulate_run(rig, plan, Noise().scale_by(scale), 5)[0] for scale in (1.0, 1e-6))
    lines = nonperiodic_spectrum_with_waveform(noisy, geometry.channel_names, geometry)
    recorded, expected = (before_filter(run, lines.waveform.frequency, geometry) for run in (noisy, clean))
    error, remaining = (np.sum(np.abs(z - expected) ** 2, axis=0) for z in (recorded, lines.waveform.volts))
    assert np.all(remaining < 0.7 * error)


def before_filter(run, frequency, geometry):
    """Amplitudes (F, c) of a record with the anti-alias filter taken out, where it passes enough."""
    gain = anti_alias_response(geometry.acquisition, frequency)
    amplitudes = np.fft.rfft(run.read().channels, axis=0)[: len(frequency)] * (2.0 / run.samples)
    return amplitudes / np.where(np.abs(gain) >= LEAST_FILTER_GAIN, gain, np.inf)[:, None]
