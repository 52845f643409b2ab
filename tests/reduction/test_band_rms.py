"""Sigma of the rms of a load within a band; the truth is that of noise of known variance."""

import numpy as np
import pytest

from balance_cli.reduction.spectra_result import RunSpectra
from balance_cli.signals.cross_spectra import cross_spectra

RATE, LENGTH, SAMPLES = 500.0, 128, 2048
BAND = (50.0, 200.0)


def spectra_of(samples, response_error=0.0):
    """Spectra of samples (n,) of one load by a response whose relative error is common to all frequencies."""
    spectra = cross_spectra([(0, samples[:, None])], 1 / RATE, LENGTH)
    spectra = spectra.at((spectra.frequency >= BAND[0]) & (spectra.frequency <= BAND[1]))
    density = 2 * spectra.density[:, :, 0].real
    k, averages = len(density), float(np.median(spectra.averages))
    return RunSpectra(
        run="noise",
        kind="wind",
        response="exact",
        components=("Fz",),
        frequency_hz=spectra.frequency,
        density=density,
        sigma=density * np.sqrt(1 / averages + (2 * response_error) ** 2),
        noise=np.zeros((k, 1)),
        redundancy=np.full(k, np.nan),
        redundancy_limit=np.full(k, np.inf),
        flags=("",) * k,
        resolution_hz=2 * RATE / LENGTH,
        averages=averages,
        interval=(0.0, SAMPLES / RATE),
        left_out={},
    )


def band_rms(generator, response_error=0.0):
    """The rms within the band of one record of unit white noise, and its sigma."""
    return spectra_of(generator.standard_normal(SAMPLES), response_error).band_rms["Fz"]


def test_sigma_is_the_scatter_over_records():
    generator = np.random.default_rng(1)
    rms, sigma = np.array([band_rms(generator) for _ in range(400)]).T
    # 400 records know their scatter to 3.5 %.
    assert np.median(sigma) == pytest.approx(np.std(rms), rel=0.12)


def test_an_error_of_the_response_is_not_averaged_over_the_band():
    _, sigma = band_rms(np.random.default_rng(1), 0.1)
    rms, random = band_rms(np.random.default_rng(1))
    assert sigma == pytest.approx(np.hypot(random, 0.1 * rms), rel=1e-6)
