"""Modes out of turbulence: the oscillator that is fitted to a periodogram, and harmonics that must not pass for one."""

from __future__ import annotations

import numpy as np

from balance_cli.reduction.operational_modes import LINE_BINS, TAPER_FACTOR, fit_oscillator, tapered_spectra

CENTER, DAMPING = 40.0, 0.01


def periodogram(rng: np.random.Generator, frequency: float, peak: float) -> tuple[np.ndarray, np.ndarray]:
    """Bins [Hz] that are independent to the likelihood, and their power: an oscillator above a floor of one."""
    f = np.arange(37.0, 43.0, 0.02)
    u = f / frequency
    gain = (2 * DAMPING) ** 2 / ((1 - u**2) ** 2 + (2 * DAMPING * u) ** 2)
    # The likelihood takes so many bins for one: their mean is that of an exponential distribution.
    return f, (1.0 + peak * gain) * rng.gamma(1.0 / TAPER_FACTOR, TAPER_FACTOR, len(f))


def test_the_frequency_is_that_of_the_oscillator_within_its_sigma() -> None:
    rng = np.random.default_rng(7)
    fits = []
    for _ in range(150):
        fit = fit_oscillator(*periodogram(rng, 40.4, 20.0), CENTER, DAMPING, 2.4)
        assert fit is not None
        fits.append(fit)
    frequency, sigma = np.array(fits).T
    score = (frequency - 40.4) / sigma
    assert abs(np.mean(score)) < 0.4
    assert 0.8 < np.std(score) < 1.25


def test_noise_alone_has_no_mode() -> None:
    rng = np.random.default_rng(8)
    found = [fit_oscillator(*periodogram(rng, 40.0, 0.0), CENTER, DAMPING, 2.4) for _ in range(150)]
    assert sum(fit is not None for fit in found) <= 1


def test_beside_a_harmonic_far_above_the_noise_there_is_noise_alone() -> None:
    """A harmonic of 1 V over noise of 1 uV: side lobes at -92 dB stood five times above the noise."""
    n, rate, harmonic = 24000, 800.0, 51.8137
    rng = np.random.default_rng(9)
    samples = np.cos(2 * np.pi * harmonic * np.arange(n) / rate) + 1e-6 * rng.standard_normal(n)
    frequency, spectra = tapered_spectra(samples[:, None], rate)
    power, distance = np.abs(spectra[:, 0]) ** 2, np.abs(frequency - harmonic) / frequency[1]
    beside = power[(distance > LINE_BINS) & (distance < 60)]
    far = power[(distance > 300) & (distance < 900)]
    assert 0.6 < np.mean(beside) / np.mean(far) < 1.5
