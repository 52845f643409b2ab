"""Measured responses as lines for a fit: columns of independent errors, lines that count once."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.io.errors import UserError
from balance_cli.signals.covariance_pooling import inverse_bias_factor
from balance_cli.signals.local.response import local_response
from balance_cli.signals.response.averaged_spectra import averaged_response
from balance_cli.signals.response.fitted_lines import independent_lines, spectrum_of_response
from balance_cli.signals.run_spectrum import FrequencyResponse

COMPONENTS = ("Fx", "Fy", "Mz")


def complex_normal(rng, *shape):
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2.0)


def response_of(T, channel_covariance, load_covariance, **entries):
    k, c, u = T.shape
    entries = {"noise_dof": np.inf, **entries}
    names = tuple(f"c{i}" for i in range(c))
    return FrequencyResponse("r", names, COMPONENTS[:u], "periodic", 1.0 + np.arange(k), T, channel_covariance,
                             load_covariance, np.ones(T.shape), np.ones((k, c)), **entries)  # fmt: skip


def test_columns_of_runs_that_were_solved_together_become_independent_experiments():
    """T = Y U^-1 with loads of any phases: its columns are correlated, those of the experiments are not."""
    rng = np.random.default_rng(1)
    k, c, u = 4000, 2, 3
    U = complex_normal(rng, u, u)
    U[:, 1] += 2.0 * U[:, 0]
    root = np.array([[1.0, 0.0], [0.6j, 0.8]])
    inverse = np.linalg.inv(U)
    error = root @ complex_normal(rng, k, c, u) @ inverse
    T = np.ones((c, u)) * np.array([1.0, 2.0j, -3.0])
    each = np.broadcast_to
    covariances = each(root @ root.conj().T, (k, c, c)), each(inverse.conj().T @ inverse, (k, u, u)).astype(complex)
    lines = spectrum_of_response(response_of(T + error, *covariances))
    assert lines.channels.shape == (k * u, c) and lines.loads.shape == (k * u, u)
    np.testing.assert_array_equal(lines.frequency[:u], 1.0)
    assert np.all(np.abs(lines.loads) > 0.05)
    noise = (lines.channels - lines.loads @ T.T).reshape(k, u * c)
    expected = np.kron(np.eye(u), root @ root.conj().T)
    np.testing.assert_allclose(noise.T @ noise.conj() / k, expected, atol=0.08)
    np.testing.assert_array_equal(lines.covariance[:, c:], 0.0)
    np.testing.assert_allclose(lines.covariance[5, :c, :c], root @ root.conj().T)


def test_variances_of_independent_channels_have_an_unbiased_inverse():
    T, one = np.ones((5, 2, 1), complex), np.ones((5, 1, 1), complex)
    lines = spectrum_of_response(response_of(T, one * np.eye(2), one, noise_dof=9.0))
    np.testing.assert_allclose(lines.covariance[:, :2, :2], one * np.eye(2) / inverse_bias_factor(9.0, 1))
    assert lines.dof == np.inf
    full = one * (np.eye(2) + 0.5)
    lines = spectrum_of_response(response_of(T, full, one, noise_dof=9.0))
    np.testing.assert_allclose(lines.covariance[:, :2, :2], full)
    assert lines.dof == 9.0


def test_as_many_lines_are_used_as_the_shares_add_up_to():
    T, one = np.ones((35, 1, 1), complex), np.ones((35, 1, 1), complex)
    keep = independent_lines(response_of(T, one, one, line_share=np.full(35, 18.0 / 35.0)))
    assert keep[0] and np.count_nonzero(keep) == 18
    assert np.count_nonzero(independent_lines(response_of(T, one, one, line_share=np.full(35, 0.1)))) == 4
    assert independent_lines(response_of(T, one, one)).all()


def test_responses_that_do_not_say_how_well_their_noise_is_known_are_refused():
    one = np.ones((5, 1, 1), complex)
    with pytest.raises(UserError, match="earlier version"):
        spectrum_of_response(replace(response_of(one, one, one), noise_dof=None))


@pytest.mark.parametrize("estimator, seeds", [("lrm", 1), ("h1", 8)])
def test_the_mean_of_the_lines_has_the_sigma_that_their_noise_says(estimator, seeds):
    """Channels that are gains: were all lines of a local model or of Hann windows independent, sigma would be small."""
    names, gains, scores = tuple(f"c{i}" for i in range(16)), np.linspace(0.1, 0.4, 16), []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        loads = np.zeros((2048, 6))
        loads[:, 2] = 10.0 * rng.normal(size=len(loads))
        volts = loads[:, 2:3] * gains + rng.normal(size=(len(loads), 16))
        run = Run("r", "rig", "sweep", names, len(loads), MemorySource(volts, loads), sample_rate=256.0,
                  excited=("Fz",), excitation="random", level=(10.0,))  # fmt: skip
        response = (local_response if estimator == "lrm" else averaged_response)(run, names, estimator)
        lines = spectrum_of_response(response)
        assert len(lines.frequency) < 0.6 * len(response.frequency)
        noise = np.mean(np.diagonal(lines.covariance, axis1=1, axis2=2).real[:, :16], axis=1)
        weight = np.abs(lines.loads[:, 0]) ** 2 / noise
        gain = weight @ (lines.channels / lines.loads) / weight.sum()
        scores.append((gain - gains) * np.sqrt(weight.sum()))
    assert 0.7 < np.sqrt(np.mean(np.abs(scores) ** 2)) < 1.3
