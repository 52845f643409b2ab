"""Waveforms of the channels for nonlinear forces: reduction of their noise."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.estimation.measured_spectra import measured_spectra
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


@pytest.mark.parametrize("flicker", [0.0, 1.0])
def test_the_mean_of_a_record_is_as_uncertain_as_it_scatters(flicker):
    """Noise of two steady periods, white and 1/f of the same size; the mean is that of the noise alone."""
    geometry, rng = rotor_balance(), np.random.default_rng(5)
    plan = SweepPlan(run="sweep", excited=("Fz",), level=(80.0,), period=0.5, periods=40, band=(4.0, 150.0))
    clean = simulate_run(true_rig(geometry), plan, Noise().scale_by(0.0), seed=1)[0]
    block, n = clean.read(clean.samples - 800), 800
    direct = np.array([channel.measures_dc for channel in geometry.channels])
    ratio = []
    for _ in range(8):
        volts = 1e-4 * (rng.standard_normal(block.channels.shape) + flicker * one_over_f(rng, block.channels.shape))
        loads = block.loads + 1e-3 * rng.standard_normal(block.loads.shape)
        run = replace(clean, samples=n, source=MemorySource(block.channels + volts, loads))
        line = measured_spectra([run], geometry, means=True).lines[0]
        for covariance in (line.covariance, line.window.covariance):
            sigma = np.sqrt(np.diagonal(covariance[-1]).real[: len(direct)] / 8.0)
            ratio.append((volts.mean(axis=0) / sigma)[direct])
    assert np.sqrt(np.mean(np.square(ratio))) < 1.25


def one_over_f(rng, shape):
    """Noise (n, c) with a power that falls with frequency, of unit variance."""
    frequency = np.maximum(np.fft.rfftfreq(shape[0]), 1.0 / shape[0])
    z = noise(rng, len(frequency), shape[1]) / np.sqrt(frequency)[:, None]
    x = np.fft.irfft(z, shape[0], axis=0)
    return x / x.std()


@pytest.mark.parametrize("excitation", ["stepped", "multisine"])
def test_lines_of_some_bins_at_a_time_are_those_of_all(excitation):
    """Of a few lines of a record only the bins that enter them are asked for, and no more than so many at once."""
    geometry, rng = rotor_balance(), np.random.default_rng(4)
    plan = SweepPlan(run="sweep-Fx", excited=("Fx",), level=(60.0,), excitation=excitation, period=1.0, periods=4)
    run = simulate_run(true_rig(geometry), plan, Noise(), 6)[0]
    waveform = measured_spectra([run], geometry, means=True).lines[0].waveform
    lines = len(waveform.combine_bins(np.zeros(len(waveform.bin_frequency()), complex)))
    few = waveform.select(np.arange(lines) < 12)
    values = noise(rng, len(few.bin_frequency()), 6).reshape(-1, 2, 3)
    asked = []

    def at_bins(bins):
        asked.append(bins)
        return values[bins]

    total = np.ones_like(few.combine_bins(values))
    few.add_bins(total, at_bins, 5)
    np.testing.assert_allclose(total, 1.0 + few.combine_bins(values), rtol=1e-12)
    assert max(map(len, asked)) == 5
    assert len(np.unique(np.concatenate(asked))) == sum(map(len, asked)) < 0.5 * len(waveform.bin_frequency())
