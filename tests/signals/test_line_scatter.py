"""Variance of responses from coherence, and from the scatter of lines whose true noise is known."""

import numpy as np
import pytest

from balance_cli.signals.response.line_scatter import coherence_variance, scatter_variance

FREQUENCY = np.arange(4, 801) * 0.125
MODES, DAMPING = (20.0, 47.0, 80.0), 0.02


def noisy(channels, sigma, seed):
    """A rig of three modes with noise of `sigma` in each channel."""
    rng = np.random.default_rng(seed)
    s = 2j * np.pi * FREQUENCY[:, None]
    T = np.zeros((len(FREQUENCY), channels), complex)
    for mode in MODES:
        w = 2 * np.pi * mode
        T += rng.normal(size=channels) * w * w / (s * s + 2 * DAMPING * w * s + w * w)
    noise = rng.normal(size=T.shape) + 1j * rng.normal(size=T.shape)
    return T + sigma * noise / np.sqrt(2.0)


@pytest.mark.parametrize("channels", [1, 7])
def test_scatter_gives_the_noise_of_the_lines(channels):
    variance = scatter_variance(FREQUENCY, noisy(channels, 0.01, 3), "none")
    assert 0.8 < np.median(np.sqrt(variance)) / 0.01 < 1.25
    assert np.percentile(np.sqrt(variance), 5) > 0.006


def test_channels_that_do_not_respond_leave_the_scatter_of_the_others():
    values = noisy(9, 0.002, 5)
    values[:, 3:] -= noisy(9, 0.0, 5)[:, 3:]
    ratio = np.sqrt(scatter_variance(FREQUENCY, values, "none")) / 0.002
    assert 0.8 < np.median(ratio[:, :3]) < 1.25
    assert np.percentile(ratio[:, :3], 95) < 2.0


def test_a_window_hides_scatter_and_is_made_up_for():
    values = noisy(5, 0.01, 4)
    plain, hann = (scatter_variance(FREQUENCY, values, window) for window in ("none", "hann"))
    assert np.all(hann > 1.3 * plain)


def test_few_lines_tell_no_scatter():
    assert scatter_variance(FREQUENCY[:8], noisy(5, 0.01, 4)[:8], "none") is None


def test_variance_by_coherence_is_that_of_many_estimates():
    """H1 of averaged random forces and noise, many times over: the scatter of the estimates is the stated one."""
    rng = np.random.default_rng(8)
    averages, trials = 20, 4000
    u, n = (rng.normal(size=(trials, averages)) + 1j * rng.normal(size=(trials, averages)) for _ in range(2))
    y = 2.0 * u + 1.5 * n
    cross, power = np.mean(y * u.conj(), axis=1), np.mean(np.abs(u) ** 2, axis=1)
    H = cross / power
    coherence = np.abs(cross) ** 2 / (power * np.mean(np.abs(y) ** 2, axis=1))
    stated = coherence_variance(H[:, None], coherence[:, None], averages)
    assert np.mean(np.abs(H - 2.0) ** 2) == pytest.approx(np.mean(stated), rel=0.08)
