"""Speed modulation: what harmonics of constant loads change in the channels because the rotor speed varies.

The response to exp(j n psi) is not proportional to it where the speed drifts beside a mode. That change is as slow as
modes decay, and a decay that is fitted with the harmonics takes part of it. It follows from the response: taken out of
the record it leaves harmonics of constant amplitude, those of the regression, and the free decays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run, SampleBlock, SampleSource
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Acquisition, Geometry
from balance_cli.reduction.measured_response import highest_frequency, lowest_frequency
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.signals.interpolating_spline import Spline, spline_through
from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.signals.rotor.harmonic_spectrum import CarrierEnvelopes, carrier_envelopes
from balance_cli.signals.rotor.harmonics import Harmonics
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LEAST_LINE = 1e-7
"""Amplitude of a line over the largest of its harmonic, below which its response is not computed: with channels of
1e-6 of their signal in noise, the sum of the lines left out is below that."""


SPEED_MEMORY = 6.0
"""Time constants over which the past rotor speed affects a harmonic: exp(-6) is 0.2 % of what a change makes."""


@dataclass(frozen=True)
class ModulationRemoved:
    """Samples of a run without `modulation`, envelopes (n, signals) over time [s] of carriers at `frequency` (n,) [Hz].

    `columns` are the signals in order: places of channels, and behind them those of the loads. The polynomials of the
    envelopes, 1 MB for each second of nine channels, are formed where samples are read.
    """

    parent: SampleSource
    rate: float
    frequency: Array
    modulation: Spline
    columns: tuple[int, ...]

    def read(self, start: int, stop: int) -> SampleBlock:
        """Return samples start to stop."""
        block = self.parent.read(start, stop)
        time = (start + np.arange(len(block.channels))) / self.rate
        change = self._change(time)
        count = block.channels.shape[1]
        stacked = np.array(block.channels if block.loads is None else np.hstack([block.channels, block.loads]))
        stacked[:, list(self.columns)] -= change
        return SampleBlock(start, stacked[:, :count], None if block.loads is None else stacked[:, count:])

    def _change(self, time: Array) -> Array:
        """Return the modulated carriers (t, signals) at rising times (t,) [s].

        Between two breaks of the envelopes they are products of powers and carriers with coefficients, one matrix
        product for all samples there.
        """
        envelopes = self.modulation.between(time[0], time[-1])
        index, offset = envelopes.locate(time)
        coefficients = envelopes.coefficients
        carrier = np.exp(2j * np.pi * np.outer(time, self.frequency))
        terms = offset[:, None, None] ** np.arange(len(coefficients))[:, None] * carrier[:, None]
        terms = terms.reshape(len(time), -1)
        change = np.empty((len(time), coefficients.shape[-1]))
        edges = [0, *(np.flatnonzero(np.diff(index)) + 1), len(time)]
        for first, last in pairwise(edges):
            of_interval = coefficients[:, index[first]].reshape(terms.shape[1], -1)
            change[first:last] = (terms[first:last] @ of_interval).real
        return change


@dataclass(frozen=True)
class ChannelResponse:
    """The response of the channels, as recorded: `rows` of a source at a speed `spin` [Hz], behind the filter."""

    source: ResponseSource
    rows: tuple[int, ...]
    spin: float
    acquisition: Acquisition

    def at(self, frequency: Array) -> ComplexArray:
        """Return the response (k, c, 6) at frequencies (k,) [Hz].

        Beyond a measured band it is that of the band's end: lines so far from their harmonic are weak.
        """
        measured = np.clip(frequency, lowest_frequency(self.source), highest_frequency(self.source))
        return self.source.at(measured, self.spin)[:, list(self.rows)] * self.filter(frequency)[:, None, None]

    def filter(self, frequency: Array) -> ComplexArray:
        """Return the response (k,) of the anti-alias filter, which is that of the recorded loads."""
        return anti_alias_response(self.acquisition, frequency)


def without_speed_modulation(
    run: Run,
    azimuth: Azimuth,
    spectra: Harmonics,
    geometry: Geometry,
    source: ResponseSource,
    live: tuple[str, ...],
) -> Run | None:
    """Return the run without what the harmonics of `spectra` change with the rotor speed.

    `live` are the usable channels, the first signals of `spectra`; the loads follow. None where the rows of the
    response are not channels.
    """
    picked = source.channel_combination(spectra.frequency_hz[1:2], live)
    if not picked.rows_are_channels:
        return None
    response = ChannelResponse(source, tuple(picked.rows), run.rotor_speed, geometry.acquisition)
    orders = range(1, len(spectra.frequency_hz))
    carriers = carrier_envelopes(azimuth, spectra, orders, SPEED_MEMORY * source.slowest_decay)
    curve = _modulation_curve(carriers, spectra, response)
    known = run.channel_names + COMPONENTS
    columns = tuple(known.index(name) for name in spectra.names)
    source_of_rest = ModulationRemoved(run.source, sample_rate(run), carriers.frequency, curve, columns)
    return replace(run, source=source_of_rest)


def _modulation_curve(carriers: CarrierEnvelopes, spectra: Harmonics, response: ChannelResponse) -> Spline:
    """Return the envelopes (n, signals) of all harmonics, one after the other: together they fill the memory."""
    count, signals = spectra.amplitude[1:].shape
    controls, knots, degree = np.empty((len(carriers.time), count, signals), complex), np.empty(0), 3
    for k in range(count):
        values = _modulation(carriers, k, spectra.amplitude[k + 1], response)
        curve = spline_through(carriers.time, values, degree)
        controls[:, k], knots, degree = curve.controls, curve.knots, curve.degree
    return Spline(knots, controls, degree)


def _modulation(carriers: CarrierEnvelopes, k: int, amplitude: ComplexArray, response: ChannelResponse) -> ComplexArray:
    """Return the envelope (t, signals) of harmonic `k` of the carriers less the mean that the regression yields.

    The loads that explain the `amplitude` (signals,) of the channels best drive it, determined or not.
    """
    from scipy.fft import fft, ifft

    envelope, count = carriers.envelopes[k], len(response.rows)
    lines = fft(envelope)
    strong = np.flatnonzero(np.abs(lines) > LEAST_LINE * np.abs(lines).max())
    frequency = np.abs(carriers.frequency[k] + carriers.grid[strong])
    share = fft(carriers.weight * envelope)[strong].conj() * lines[strong]
    share /= share.sum()
    T, H = response.at(frequency), response.filter(frequency)
    mean = np.einsum("f,fcj->cj", share, T)
    scale = np.linalg.norm(mean, axis=0)
    scale[scale == 0.0] = 1.0
    loads = np.linalg.lstsq(mean / scale, amplitude[:count], rcond=None)[0] / scale
    driven = np.hstack([T @ loads, np.outer(H / (share @ H), amplitude[count:])])
    spectrum = np.zeros((len(lines), len(amplitude)), complex)
    spectrum[strong] = (driven - share @ driven) * lines[strong, None]
    return np.asarray(ifft(spectrum, axis=0))
