"""H1, H2, Hv and coherence by averaging, against closed forms for a gain without memory in white noise."""

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.io.errors import UserError
from balance_cli.signals.response.averaged_spectra import averaged_response, spectral_matrix

RATE = 200.0
GAIN = np.array([[2.0, -1.0], [0.5, 3.0], [1.0, 1.0]])


def record(seed=0, noise=0.0, load_noise=0.0, seconds=40.0, inputs=1, gain=GAIN):
    rng = np.random.default_rng(seed)
    loads = np.zeros((int(seconds * RATE), 6))
    loads[:, :inputs] = rng.normal(size=(len(loads), inputs))
    channels = loads[:, :inputs] @ gain[:, :inputs].T + noise * rng.normal(size=(len(loads), 3))
    loads[:, :inputs] += load_noise * rng.normal(size=(len(loads), inputs))
    names = ("Fx", "Fy")[:inputs]
    return Run("run", "rig", "sweep", ("a", "b", "c"), len(loads), MemorySource(channels, loads), sample_rate=RATE,
               excited=names, excitation="random", level=(1.0,) * inputs)  # fmt: skip


@pytest.mark.parametrize("estimator", ["h1", "h2", "hv"])
def test_exact_without_noise(estimator):
    response = averaged_response(record(), ("c", "a", "b"), estimator)
    assert response.response[:, :, 0] == pytest.approx(
        np.broadcast_to(GAIN[[2, 0, 1], 0], (len(response.frequency), 3))
    )
    assert response.coherence == pytest.approx(np.ones_like(response.coherence))
    assert response.frequency[0] == pytest.approx(0.25)


def test_two_components_are_told_apart():
    response = averaged_response(record(inputs=2, noise=0.01), ("a", "b", "c"))
    assert response.response.mean(axis=0) == pytest.approx(GAIN.astype(complex), abs=5e-3)
    assert response.multiple_coherence.min() > 0.99
    # One of two equal inputs explains g_1^2 / (g_1^2 + g_2^2) of the output.
    assert response.coherence[:, 0, 0].mean() == pytest.approx(0.8, abs=0.05)
    with pytest.raises(UserError, match="h2 cannot"):
        averaged_response(record(inputs=2), ("a", "b", "c"), "h2")


def test_biases_are_those_of_the_textbook():
    """With noise of relative power r on the load alone H1 is low by 1 / (1 + r) and H2 is right; Hv is between."""
    gains = {}
    for estimator in ("h1", "h2", "hv"):
        records = [record(seed, load_noise=0.5) for seed in range(6)]
        responses = [averaged_response(each, ("a", "b", "c"), estimator).response for each in records]
        gains[estimator] = np.abs(np.mean(responses, axis=(0, 1))[:, 0]) / np.abs(GAIN[:, 0])
    assert gains["h1"] == pytest.approx(np.full(3, 1 / 1.25), rel=0.02)
    assert gains["h2"] == pytest.approx(np.ones(3), rel=0.02)
    assert np.all((gains["h1"] < gains["hv"]) & (gains["hv"] < gains["h2"]))


def test_coherence_is_signal_over_signal_and_noise():
    response = averaged_response(record(noise=1.0, seconds=400.0), ("a", "b", "c"))
    signal = GAIN[:, 0] ** 2
    assert response.multiple_coherence.mean(axis=0) == pytest.approx(signal / (signal + 1.0), abs=0.02)


@pytest.mark.parametrize("inputs", [1, 2])
def test_covariance_is_that_of_repetitions(inputs):
    """Bendat and Piersol: variance S_nn / (S_uu n) with n independent averages."""
    errors, stated = [], []
    for seed in range(60):
        response = averaged_response(record(seed, noise=0.5, seconds=20.0, inputs=inputs), ("a", "b", "c"))
        errors.append(response.response - GAIN[:, :inputs])
        channels = np.diagonal(response.channel_covariance, axis1=1, axis2=2).real
        loads = np.diagonal(response.load_covariance, axis1=1, axis2=2).real
        stated.append(channels[:, :, None] * loads[:, None, :])
    # Beyond its mean the stated variance scatters with S_uu; a few averages make its mean larger than 1 / mean(S_uu).
    assert np.mean(np.abs(errors) ** 2) == pytest.approx(np.mean(stated), rel=0.12)


def test_overlapping_hann_windows_are_worth_nearly_as_many_averages():
    """The variance of a spectrum of white noise, from 400 records of 9 overlapping segments."""
    rng = np.random.default_rng(0)
    spectra = [spectral_matrix(rng.normal(size=(1000, 1)), RATE, 200, 1) for _ in range(400)]
    power = np.array([each.products[10:90, 0, 0].real for each in spectra])
    assert spectra[0].averages == pytest.approx(np.mean(power) ** 2 / np.mean(np.var(power, axis=0)), rel=0.06)


def test_sine_keeps_its_amplitude():
    t = np.arange(2000) / RATE
    spectra = spectral_matrix(3.0 * np.cos(2 * np.pi * 20.0 * t)[:, None], RATE, 400, 1)
    assert spectra.products[np.argmin(np.abs(spectra.frequency - 20.0)), 0, 0].real == pytest.approx(9.0, rel=1e-6)


def test_record_too_short():
    with pytest.raises(UserError, match="too short"):
        averaged_response(record(seconds=0.02), ("a",))
