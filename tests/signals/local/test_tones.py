"""A steady tone in a record that does not repeat: found where it is, kept from models and noise, and in the lines."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.signals.local.models import fit_local_models
from balance_cli.signals.local.nonperiodic_spectrum import nonperiodic_record
from balance_cli.signals.local.response import response_from_models
from balance_cli.signals.local.scaled_spectrum import record_spectrum
from balance_cli.simulation import SweepPlan, simulate_run, true_rig
from tests.support.rigs import rotor_balance
from tests.support.swept_rig import SweptRig

BAND = (5.0, 145.0)
RIG = SweptRig()
# Some sixty times the noise of a line; its frequency is not that of a line.
AMPLITUDE, CHANNEL, PHASE = 2e-3, 2, 0.4


@cache
def rig_models(excitation, seed):
    """The local models of a record without a tone, made once for all tests."""
    return models_of(getattr(RIG, excitation)(seed=seed))


def randomly_driven():
    """Models of a record without a tone, and the frequency of one."""
    return rig_models("random", 1), 50.017


def stepped():
    plan = SweepPlan(run="sweep-Fx", excited=("Fx",), level=(40.0,), excitation="stepped", period=2.0, periods=5)
    return models_of(simulate_run(true_rig(rotor_balance()), plan, seed=2)[0]), 49.97


def tone_of(run, frequency):
    """The tone at every sample (n,)."""
    return AMPLITUDE * np.cos(2 * np.pi * frequency * np.arange(run.samples) / run.sample_rate + PHASE)


def with_tone(run, frequency, times=1.0):
    block = run.read()
    channels = block.channels.copy()
    channels[:, CHANNEL] += times * tone_of(run, frequency)
    return replace(run, source=MemorySource(channels, block.loads))


def spectrum_of(signal):
    return np.fft.rfft(signal, axis=0) * (2.0 / len(signal))


def models_of(run):
    return fit_local_models(record_spectrum(run, run.channel_names, BAND))


def numbers(models):
    """Which lines (K,) of the whole record the models cover."""
    run = models.spectrum.run
    return np.rint(models.spectrum.frequency * run.samples / run.sample_rate).astype(int)


def sigma(models):
    """Standard deviation (K, c) [V] of a line's noise, that of the loads seen through the response among it."""
    variance = np.diagonal(models.noise.equation_error_covariance(models.response), axis1=1, axis2=2).real
    return np.sqrt(variance) * models.spectrum.channel_scale


@pytest.fixture(scope="module", params=[randomly_driven, stepped])
def record(request):
    """A record, the frequency of a tone, and the local models without and with it."""
    without, frequency = request.param()
    run = without.spectrum.run
    return run, frequency, without, models_of(with_tone(run, frequency))


def dirichlet(run, frequency, bin_index):
    """Amplitudes of the tone at these lines: sum_n exp(j 2 pi (f h - k/N) n) and its mirror, as geometric series."""
    N, turns = run.samples, frequency / run.sample_rate
    parts = []
    for sign in (1.0, -1.0):
        angle = 2 * np.pi * (sign * turns - bin_index / N)
        parts.append(np.exp(sign * 1j * PHASE) * np.expm1(1j * N * angle) / np.expm1(1j * angle) / N)
    return AMPLITUDE * sum(parts)


def test_a_tone_is_found_at_its_amplitude_in_its_channel_alone(record):
    run, frequency, without, models = record
    found = (models.tones - without.tones) * models.spectrum.channel_scale
    expected = dirichlet(run, frequency, numbers(models))
    np.testing.assert_allclose(expected, spectrum_of(tone_of(run, frequency))[numbers(models)], atol=1e-9 * AMPLITUDE)
    error, noise = np.abs(found), sigma(without)
    assert np.max(np.abs(expected) / noise[:, CHANNEL]) > 30.0
    error[:, CHANNEL] = np.abs(found[:, CHANNEL] - expected)
    assert np.max(error / noise) < 4.0


def test_response_and_noise_are_those_without_the_tone(record):
    """Within half a sigma beside the tone, where the pole that it was taken for puts the response seven sigma off."""
    _, frequency, without, models = record
    near = np.abs(models.spectrum.frequency[models.spectrum.excited] - frequency) < 1.0
    change = change_of_response(without, models)
    assert change[near].max() < 0.5
    assert np.percentile(change, 95) < 0.5
    # Where the rotor turns no tone is separated.
    turning_models = turning(models)
    assert np.any(models.tones) and not np.any(turning_models.tones)
    assert change_of_response(turning(without), turning_models)[near].max() > 5.0
    scale = models.spectrum.channel_scale / without.spectrum.channel_scale
    size = np.sqrt(np.diagonal(without.noise.channels, axis1=1, axis2=2).real)
    change = models.noise.channels * scale[:, None] * scale - without.noise.channels
    relative = change / (size[:, :, None] * size[:, None, :])
    relative = np.abs(relative[models.spectrum.excited])
    # The largest by less than the statistical error of the covariance: a window elsewhere may take other orders.
    assert relative.max() < without.noise.dof**-0.5 and np.sqrt(np.mean(relative**2)) < 0.01


def change_of_response(one, other):
    """From one to the other, rms over the channels (k,), in standard deviations."""
    before, after = response_from_models(one, "lrm"), response_from_models(other, "lrm")
    channels = np.diagonal(before.channel_covariance, axis1=1, axis2=2).real
    loads = np.diagonal(before.load_covariance, axis1=1, axis2=2).real
    square = np.abs(after.response - before.response) ** 2 / (channels[:, :, None] * loads[:, None, :])
    return np.sqrt(square.mean(axis=(1, 2)))


def turning(models):
    """The models of the same record with the rotor turning, where no tone is separated."""
    return models_of(replace(models.spectrum.run, rotor_speed=17.5))


def test_lines_for_identification_still_hold_the_tone(record):
    """They are sums over the lines of the whole record, by weights that do not take a tone out."""
    run, frequency, _, _ = record
    with_tone_record = with_tone(run, frequency)
    lines = nonperiodic_record(with_tone_record, run.channel_names, BAND)
    expected = combine(lines, run.read().channels)
    expected[:, CHANNEL] += combine(lines, tone_of(run, frequency))
    np.testing.assert_allclose(lines.spectrum.channels, expected, atol=1e-9 * np.abs(expected).max())
    lines_without_tone = nonperiodic_record(replace(with_tone_record, rotor_speed=17.5), run.channel_names, BAND)
    assert tone_chi2(lines, tone_of(run, frequency)) > 300.0
    assert tone_chi2(lines_without_tone, tone_of(run, frequency)) < 10.0


def combine(lines, signal):
    """What the sums make of a signal (n, ...)."""
    neighbors = lines.first[:, None] + np.arange(lines.weight.shape[1])
    spectrum = spectrum_of(signal)[lines.bin_index]
    return np.einsum("kw,kw...->k...", lines.weight, spectrum[neighbors])


def tone_chi2(lines, tone):
    """The chi-square of a tone in the channel's lines."""
    variance = lines.spectrum.covariance[:, CHANNEL, CHANNEL].real
    return float(np.sum(np.abs(combine(lines, tone)) ** 2 / variance))


@pytest.mark.parametrize("excitation", ["random", "sine_sweep"])
def test_without_a_tone_there_is_none_above_the_noise(excitation):
    for seed in (1, 2):
        models = rig_models(excitation, seed)
        assert np.max(np.abs(models.tones) * models.spectrum.channel_scale / sigma(models)) < 4.0


def test_without_a_pole_on_the_axis_there_is_none_at_all():
    assert not np.any(rig_models("sine_sweep", 1).tones)


def test_a_strong_tone_leaves_nothing_beyond_its_window():
    """Of a tone of 600 times the noise, half way between two lines, six times the noise is left 1.5 Hz away."""
    without, frequency = randomly_driven()
    models = models_of(with_tone(without.spectrum.run, frequency, 10.0))
    found = models.tones[:, CHANNEL] * models.spectrum.channel_scale[CHANNEL]
    error = np.abs(found - 10.0 * dirichlet(models.spectrum.run, frequency, numbers(models)))
    assert np.max(error / sigma(without)[:, CHANNEL]) < 3.0
    assert np.max(change_of_response(without, models)) < 1.0


@pytest.mark.parametrize("excitation", ["random", "sine_sweep"])
def test_a_mode_that_hardly_decays_is_no_tone(excitation):
    """In 10 s a mode of 20 Hz and 0.02 % has its pole 0.04 lines from the axis: it stays in the model."""
    run = getattr(SweptRig(zeta=2e-4), excitation)(seed=2, seconds=10.0)
    models = models_of(run)
    assert np.max(np.abs(models.tones) * models.spectrum.channel_scale / sigma(models)) < 4.0
