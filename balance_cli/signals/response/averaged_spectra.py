"""Frequency responses from averaged spectra: H1, H2 and Hv, with ordinary and multiple coherence.

Hann windows, overlapping by half (Welch, IEEE Trans. Audio Electroacoust. 15, 1967). Estimators and variances as in
Bendat and Piersol, Random Data, 4th ed. (2010), chapters 7 and 9; Hv as in Rocklin, Crowley and Vold, IMAC 1985.
These estimators suffer from leakage. Near lightly damped modes they are the poorest choice; they are available for
comparison.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.signals.local.response import coherences
from balance_cli.signals.local.scaled_spectrum import LEAST_INDEPENDENCE, has_power, load_independence
from balance_cli.signals.periodic import samples_per_period
from balance_cli.signals.run_samples import load_columns, measured_components, read_samples, run_error, sample_rate
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SEGMENT_DURATION = 4.0
"""Seconds: a resolution of 0.25 Hz, the half-power width of a mode of 25 Hz with a damping ratio of 0.5 %."""
FEWEST_AVERAGES = 8
"""Segments for which a shorter segment is accepted; the coherence of fewer is biased by more than 1/8."""
SHORTEST_SEGMENT = 16
"""Samples; a spectrum of seven lines is the least that has a shape."""
HANN_LINE_SHARE = 18.0 / 35.0
"""Independent share of neighboring lines: one over the sum of the squared correlations of the lines of Hann windows,
which is (sum w^2)^2 / (n sum w^4). The error of an averaged cross-spectrum is a product of two spectra."""
OVERLAP_CORRELATION = (1.0 / 6.0) ** 2
"""Correlation of the powers of neighboring segments: that of Hann windows that overlap by half (Welch)."""


@dataclass(frozen=True)
class SpectralMatrix:
    """Averaged products (K, n, n) of [channels, loads], `E[z z*]`, at frequency (K,) [Hz].

    The first `channels` of the n signals are channels. `averages` is the equivalent number of independent segments.
    """

    frequency: Array
    products: ComplexArray
    channels: int
    averages: float

    @property
    def output_spectra(self) -> ComplexArray:
        """S_yy (K, c, c)."""
        return self.products[:, : self.channels, : self.channels]

    @property
    def cross_spectra(self) -> ComplexArray:
        """S_yu (K, c, u)."""
        return self.products[:, : self.channels, self.channels :]

    @property
    def input_spectra(self) -> ComplexArray:
        """S_uu (K, u, u)."""
        return self.products[:, self.channels :, self.channels :]


def averaged_response(
    run: Run, channel_names: Sequence[str], estimator: str = "h1", band: tuple[float, float] = (0.0, np.inf)
) -> FrequencyResponse:
    """Estimate the frequency response by `h1` (noise on the channels), `h2` (on the loads) or `hv` (on both).

    Lines are those within `band` [Hz]. The covariance is that of H1: the power of the channels that is not coherent
    with the loads, over the power of the loads and the number of averages. Raises UserError where the record is too
    short, where loads are proportional to each other, and for `h2` with several components.
    """
    channels, loads = read_samples(run, channel_names)
    components = measured_components(run, loads)
    z = np.hstack([channels, loads[:, load_columns(components)]])
    spectra = spectral_matrix(z, sample_rate(run), _segment_length(run), len(channel_names))
    if spectra.averages <= len(components) + 1:
        raise run_error(run, "the record is too short to average over", "Record more")
    power = np.diagonal(spectra.input_spectra, axis1=1, axis2=2).real
    inside = (spectra.frequency >= band[0]) & (spectra.frequency <= band[1]) & has_power(np.sqrt(power))
    spectra = SpectralMatrix(spectra.frequency[inside], spectra.products[inside], spectra.channels, spectra.averages)
    if not np.any(inside) or np.median(load_independence(spectra.input_spectra)) < LEAST_INDEPENDENCE:
        raise run_error(
            run, "the loads excited at once are proportional to each other", "Excite with different phases", "loads"
        )
    return _response_from_spectra(run, tuple(channel_names), components, spectra, estimator)


def spectral_matrix(z: Array, rate: float, segment: int, channels: int) -> SpectralMatrix:
    """Average the spectral products of signals z (n, signals).

    The Hann windows of `segment` samples overlap by half. The first `channels` signals are channels; `rate` is in Hz.
    """
    step = segment // 2
    starts = range(0, len(z) - segment + 1, step)
    window = np.hanning(segment + 1)[:-1, None]
    products = np.zeros((segment // 2 - 1, z.shape[1], z.shape[1]), complex)
    for start in starts:
        piece = z[start : start + segment]
        Z = np.fft.rfft((piece - piece.mean(axis=0)) * window, axis=0)[1 : segment // 2]
        products += Z[:, :, None] * Z[:, None, :].conj()
    K = len(starts)
    scale = (2.0 / np.sum(window)) ** 2 / max(K, 1)
    averages = K / (1.0 + 2.0 * OVERLAP_CORRELATION * (K - 1) / K) if K else 0.0
    frequency = np.arange(1, segment // 2) * rate / segment
    return SpectralMatrix(frequency, np.asarray(products * scale, complex), channels, averages)


def _segment_length(run: Run) -> int:
    """Samples of a segment: the period, else SEGMENT_DURATION, or less where that gives too few averages."""
    rate = sample_rate(run)
    if run.period is not None and run.samples >= 2 * run.period * rate:
        return samples_per_period(run)
    segment = int(min(SEGMENT_DURATION * rate, 2 * run.samples / (FEWEST_AVERAGES + 1))) // 2 * 2
    if segment < SHORTEST_SEGMENT:
        raise run_error(run, "the record is too short to average over", "Record more")
    return segment


def _response_from_spectra(
    run: Run, channel_names: tuple[str, ...], components: tuple[str, ...], spectra: SpectralMatrix, estimator: str
) -> FrequencyResponse:
    if estimator == "h2" and len(components) > 1:
        raise run_error(run, f"h2 cannot separate {len(components)} components", "Choose h1 or hv", "--estimator")
    H1 = _h1(spectra)
    response = {"h1": lambda: H1, "h2": lambda: _h2(spectra), "hv": lambda: _hv(spectra)}[estimator]()
    K, u = spectra.averages, len(components)
    noise = spectra.output_spectra - H1 @ spectra.cross_spectra.conj().swapaxes(1, 2)
    ordinary, multiple = coherences(H1, noise, spectra.input_spectra)
    return FrequencyResponse(
        run=run.name,
        channel_names=channel_names,
        components=components,
        estimator=estimator,
        frequency=spectra.frequency,
        response=response,
        channel_covariance=noise * (K / (K - u)),
        load_covariance=np.asarray(np.linalg.inv(spectra.input_spectra) / K, complex),
        coherence=ordinary,
        multiple_coherence=multiple,
        rotor_speed=run.rotor_speed,
        level=run.level,
        noise_dof=K - u,
        line_share=np.full(len(spectra.frequency), HANN_LINE_SHARE),
    )


def _h1(spectra: SpectralMatrix) -> ComplexArray:
    """S_yu S_uu^-1, unbiased with noise on the channels alone."""
    return np.asarray(
        np.linalg.solve(spectra.input_spectra, spectra.cross_spectra.conj().swapaxes(1, 2)).conj().swapaxes(1, 2)
    )


def _h2(spectra: SpectralMatrix) -> ComplexArray:
    """S_yy / S_uy for each channel, unbiased with noise on the load alone."""
    power = np.diagonal(spectra.output_spectra, axis1=1, axis2=2)[:, :, None]
    cross_spectra = spectra.cross_spectra.conj()
    return np.asarray(power / np.where(np.abs(cross_spectra) > 0, cross_spectra, np.inf))


def _hv(spectra: SpectralMatrix) -> ComplexArray:
    """Total least squares for each channel, signals scaled to equal power: noise on channels and loads alike."""
    K, c, u = spectra.cross_spectra.shape
    result = np.empty((K, c, u), complex)
    for i in range(c):
        signals = [i, *range(c, c + u)]
        S = spectra.products[:, signals][:, :, signals]
        size = np.sqrt(np.maximum(np.diagonal(S, axis1=1, axis2=2).real, 1e-300))
        least = np.linalg.eigh(S / (size[:, :, None] * size[:, None, :]))[1][:, :, 0]
        # v* [y; u] has the least power of all combinations, so that y = -(v_u* / v_y*) u.
        result[:, i] = -(least[:, 1:] / least[:, :1]).conj() * size[:, :1] / size[:, 1:]
    return result
