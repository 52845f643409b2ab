"""Levels from a record: variances of loads by Whittle's likelihood, noise of channels, drift of amplitudes."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from balance_cli.reduction.kalman.amplitude_drift import WindowAmplitudes, estimate_relative_drift
from balance_cli.reduction.kalman.filter_tuning import _fit_layers
from balance_cli.reduction.kalman.load_models import BandLimitedNoise, FirstOrderMarkov, LowPassDrift
from balance_cli.reduction.kalman.whittle_likelihood import (
    INDEPENDENT_PER_BIN,
    _WhittleLikelihood,
    estimate_layer_variances,
)
from balance_cli.signals.cross_spectra import CrossSpectra, cross_spectra, noise_variance_above
from tests.support.kalman_models import Array

STEP = 1.0 / 400.0
CORNERS = (0.5, 10.0)
LAYERS = np.array([[4.0, 1.0], [0.5, 2.0]])
"""Variances of two layers (rows) of two loads."""
NOISE = np.array([0.3, 0.1, 0.2])
READ = np.array([[1.0, 0.2], [0.3, -0.8], [-0.5, 0.6]])
LENGTH = 2048


def _record(seed: int, samples: int = 60_000) -> Array:
    """Channels (n, 3) that read two loads at once, and white noise of their own."""
    rng = np.random.default_rng(seed)
    loads = np.zeros((samples, 2))
    for corner, variance in zip(CORNERS, LAYERS, strict=True):
        keep = np.exp(-2 * np.pi * corner * STEP)
        driven = np.sqrt((1 - keep**2) * variance) * rng.standard_normal((samples, 2))
        loads += scipy.signal.lfilter([1.0], [1.0, -keep], driven, axis=0)
    return loads @ READ.T + np.sqrt(NOISE) * rng.standard_normal((samples, 3))


def _spectra(y: Array) -> CrossSpectra:
    """Of lines below a quarter of the sample rate, where a sampled load is as a continuous one."""
    found = cross_spectra([(0, y)], STEP, LENGTH)
    return found.at((found.frequency > 4 / (LENGTH * STEP)) & (found.frequency < 0.05 / STEP))


def _shapes(frequency: Array) -> Array:
    return np.stack([LowPassDrift(np.ones(1), corner, 400.0).spectrum(frequency)[:, 0] for corner in CORNERS])


def _likelihood(spectra: CrossSpectra) -> _WhittleLikelihood:
    size = np.sqrt(STEP * NOISE)
    response = np.broadcast_to(READ / size[:, None], (len(spectra.frequency), 3, 2))
    terms = np.concatenate([response * np.sqrt(s)[:, None, None] for s in _shapes(spectra.frequency)], axis=2)
    return _WhittleLikelihood(
        spectra.density / np.outer(size, size), terms.astype(complex), INDEPENDENT_PER_BIN * spectra.averages
    )


def test_variances_come_back_within_their_standard_errors():
    errors = []
    for seed in range(16):
        spectra = _spectra(_record(seed))
        response = np.broadcast_to(READ.astype(complex), (len(spectra.frequency), 3, 2))
        found = estimate_layer_variances(spectra, response, _shapes(spectra.frequency), STEP, NOISE).values
        information = _likelihood(spectra).at(np.log(LAYERS.ravel()))[2]
        sigma = np.sqrt(np.diag(np.linalg.inv(information)))
        assert sigma.max() < 0.5
        errors.append(np.log(found / LAYERS).ravel() / sigma)
    errors = np.array(errors)
    assert np.abs(errors.mean(axis=0)).max() < 3.5 / np.sqrt(len(errors))
    assert 0.8 < np.sqrt(np.mean(errors**2)) < 1.25


def test_a_layer_that_is_not_there_comes_out_small():
    rng = np.random.default_rng(0)
    quiet = np.sqrt(NOISE) * rng.standard_normal((60_000, 3))
    spectra = _spectra(quiet)
    response = np.broadcast_to(READ.astype(complex), (len(spectra.frequency), 3, 2))
    found = estimate_layer_variances(spectra, response, _shapes(spectra.frequency), STEP, NOISE).values
    assert found.max() < 0.02 * LAYERS.min()
    assert found.min() > 0.0


def test_gradient_is_the_slope_of_the_likelihood():
    likelihood, ln_v = _likelihood(_spectra(_record(1, 20_000))), np.log(LAYERS.ravel() * [1.3, 0.6, 3.0, 1.1])
    slopes = []
    for i in range(len(ln_v)):
        spacing = np.zeros(len(ln_v))
        spacing[i] = 1e-4
        slopes.append((likelihood.at(ln_v + spacing)[0] - likelihood.at(ln_v - spacing)[0]) / 2e-4)
    assert np.allclose(likelihood.at(ln_v)[1], slopes, rtol=1e-6, atol=1e-6)


def test_information_is_the_curvature_where_the_spectra_are_the_models():
    """Expected curvature: that of the likelihood of spectra which are just those that the model states."""
    one, ln_v = _likelihood(_spectra(_record(2, 20_000))), np.log(LAYERS.ravel())
    scaled = one.terms * np.exp(0.5 * ln_v)
    exact = _WhittleLikelihood(scaled @ scaled.conj().swapaxes(1, 2) + np.eye(3), one.terms, one.averages)
    value, gradient, information = exact.at(ln_v)
    assert np.isfinite(value)
    assert np.abs(gradient).max() < 1e-9 * np.abs(information).max()
    for i in range(len(ln_v)):
        spacing = np.zeros(len(ln_v))
        spacing[i] = 1e-4
        curvature = (exact.at(ln_v + spacing)[1] - exact.at(ln_v - spacing)[1]) / 2e-4
        assert np.allclose(curvature, information[i], rtol=1e-4, atol=1e-6 * np.abs(information).max())


def test_white_noise_has_the_density_of_its_variance():
    rng = np.random.default_rng(3)
    found = cross_spectra([(0, rng.standard_normal((200_000, 2)) * [1.0, 3.0])], STEP, 1024)
    density = found.density.mean(axis=0) / STEP
    assert np.allclose(density, np.diag([1.0, 9.0]), rtol=0.02, atol=0.03)


def test_as_many_spectra_are_averaged_as_the_scatter_of_lines_tells():
    """The scatter of one line over many records, and that of the mean over all lines of a record."""
    rng, samples = np.random.default_rng(4), 5120
    found = [cross_spectra([(0, rng.standard_normal((samples, 1)))], STEP, 512) for _ in range(400)]
    power = np.array([one.density[:, 0, 0].real for one in found])
    averages = 1.0 / np.mean(np.var(power, axis=0) / np.mean(power, axis=0) ** 2)
    together = np.mean(power) ** 2 / np.var(power.mean(axis=1))
    assert 0.93 < found[0].averages[0] / averages < 1.07
    assert 0.8 < INDEPENDENT_PER_BIN * found[0].averages.sum() / together < 1.25


@pytest.mark.parametrize("samples", [4000, 100_000])
def test_noise_is_unbiased_beside_a_tone(samples):
    rng = np.random.default_rng(5)
    tone = 2.0 * np.sin(2 * np.pi * 150.0 * STEP * np.arange(samples))[:, None]
    ratios = []
    for _ in range(80 if samples < 10_000 else 6):
        record = tone + np.sqrt(NOISE) * rng.standard_normal((samples, 3))
        ratios.append(noise_variance_above(100.0, [record.T], STEP, 1024) / NOISE)
    assert abs(np.mean(ratios) - 1.0) < 0.02


def test_lines_that_are_not_used_count_for_nothing():
    """A harmonic is kept out in the windows where it stands, and its line is that of the others."""
    rng = np.random.default_rng(6)
    y = 0.01 * rng.standard_normal((40_000, 1))
    y[:20_000] += np.sin(2 * np.pi * 50.0 * STEP * np.arange(20_000))[:, None]

    def used(first: int, frequency: Array):
        return (first >= 20_000) | (np.abs(frequency - 50.0) > 8.0)

    found = cross_spectra([(0, y)], STEP, 512, used)
    near = found.density[np.abs(found.frequency - 50.0) < 5.0, 0, 0].real
    assert np.allclose(near / STEP, 1e-4, rtol=0.7)
    assert found.averages.min() < 0.6 * found.averages.max()


class _Direct:
    """Channels that read the loads at once."""

    def response(self, frequency: Array) -> Array:
        return np.broadcast_to(READ.astype(complex), (len(frequency), 3, 2))


def _fluctuating(loads: Array, rate: float, highest: float, rng: np.random.Generator):
    """The layer that is found for loads (n, 2) from channels with noise of their own, by the lines up to `highest`."""
    noise = np.full(3, 0.05)
    channels = loads @ READ.T + np.sqrt(noise) * rng.standard_normal((len(loads), 3))
    spectra = cross_spectra([(0, channels)], 1.0 / rate, 2048)
    spectra = spectra.at(spectra.frequency < highest)
    return _fit_layers(spectra, _Direct(), [0, 1], noise, 1.0 / rate, ())[-1]


@pytest.mark.parametrize("corner", [15.0, 60.0])
def test_turbulence_that_falls_slowly_is_found_with_its_corner(corner):
    rate, samples, rng = 4000.0, 160_000, np.random.default_rng(7)
    keep = np.exp(-2 * np.pi * corner / rate)
    driven = np.sqrt(1 - keep**2) * rng.standard_normal((samples, 2)) * [2.0, 1.0]
    found = _fluctuating(scipy.signal.lfilter([1.0], [1.0, -keep], driven, axis=0), rate, 0.1 * rate, rng)
    assert isinstance(found, FirstOrderMarkov)
    assert found.corner == pytest.approx(corner, rel=0.2)
    assert found.sigma == pytest.approx([2.0, 1.0], rel=0.1)


@pytest.mark.parametrize("band", [50.0, 110.0])
def test_turbulence_that_ends_at_a_band_is_found_with_that(band):
    rate, rng = 800.0, np.random.default_rng(8)
    low = scipy.signal.butter(6, band, fs=rate, output="sos")
    loads = scipy.signal.sosfilt(low, rng.standard_normal((40_000, 2)), axis=0)
    found = _fluctuating(loads / loads.std(axis=0) * [2.0, 1.0], rate, 0.4 * rate, rng)
    assert isinstance(found, BandLimitedNoise)
    assert found.band == pytest.approx(band, rel=0.15)


def _walk(rate: float, seed: int, noise: float = 0.01, windows: int = 40, start: float = 1.0) -> WindowAmplitudes:
    """Amplitudes of 6 harmonics of 2 loads that walk by `rate` of their size in a second, read with noise."""
    rng = np.random.default_rng(seed)
    first = start * np.exp(2j * np.pi * rng.uniform(size=(6, 2)))
    steps = rate * start * (rng.standard_normal((windows, 6, 2)) + 1j * rng.standard_normal((windows, 6, 2)))
    steps[0] = 0.0
    error = np.sqrt(noise / 2) * (rng.standard_normal(steps.shape) + 1j * rng.standard_normal(steps.shape))
    return WindowAmplitudes(first + np.cumsum(steps, axis=0) + error, np.full((6, 2), noise), 1.0)


@pytest.mark.parametrize("rate", [0.01, 0.03, 0.1])
def test_drift_of_a_random_walk_comes_back(rate):
    """Relative to the size that the amplitudes had: a walk adds to it, so that it is compared in absolute terms."""
    ratios = []
    for seed in range(20):
        found = _walk(rate, seed, noise=1e-4)
        size = np.sqrt(np.mean(np.abs(found.values) ** 2, axis=(0, 1)))
        ratios.append(estimate_relative_drift(found) * size / rate)
    assert abs(np.mean(np.log(ratios))) < 0.1
    assert np.std(np.log(ratios)) < 0.3


def test_drift_below_noise_comes_back_too():
    ratios = [estimate_relative_drift(_walk(0.03, seed, noise=4e-3, windows=200)) for seed in range(12)]
    size = [np.sqrt(np.mean(np.abs(_walk(0.03, s, 4e-3, 200).values) ** 2, axis=(0, 1))) for s in range(12)]
    assert abs(np.mean(np.log(np.array(ratios) * size / 0.03))) < 0.2


def test_amplitudes_that_stand_still_do_not_drift():
    found = [estimate_relative_drift(_walk(0.0, seed, noise=1e-2)) for seed in range(20)]
    assert np.median(found) < 1e-3
    assert np.max(found) < 0.03


def test_more_noise_than_stated_is_no_drift():
    """A load that fluctuates scatters in every window: its changes turn back, those of a walk do not."""
    for seed in range(5):
        scattered = _walk(0.0, seed, noise=0.05)
        stated = WindowAmplitudes(scattered.values, scattered.variance / 30.0, scattered.spacing)
        assert estimate_relative_drift(stated).max() < 0.05


def test_one_window_that_stands_out_changes_little():
    sound = _walk(0.03, 1, noise=1e-4)
    values = sound.values.copy()
    values[20:] += 1000.0 * 0.03
    stepped = WindowAmplitudes(values, sound.variance, sound.spacing)
    size = [np.sqrt(np.mean(np.abs(one.values) ** 2, axis=(0, 1))) for one in (sound, stepped)]
    ratio = estimate_relative_drift(stepped) * size[1] / (estimate_relative_drift(sound) * size[0])
    assert np.all((ratio > 0.7) & (ratio < 1.5))
