"""Mistakes in the channels of a run without redundant sensors, by what turbulence leaves between its harmonics.

As many sensors as loads contradict nothing: any readings are those of some loads. But loads of turbulence have a
spectrum that is smooth across a light mode, and only the right readings turn the resonances of the channels into such
loads. Let l = G C y be the loads at the bins between two harmonics, by the inverse response G, of readings y from which
a mistake was taken by C. With a constant covariance S of the loads the greatest likelihood (Whittle, J. R. Stat. Soc.
B 15, 1953, 125) is -n (ln |S| - 2 ln |det C|) and terms that no mistake changes, with S the mean of l l*. Mistakes are
compared by it. S contains the noise of the channels once more, so that noise alone favors none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.reduction.harmonic_loads import channel_noise
from balance_cli.reduction.known_load_channels import LARGEST_FACTOR, SMALLEST_FACTOR
from balance_cli.reduction.operational_modes import TAPER_FACTOR, between_harmonics, tapered_spectra
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.reduction.suspect_channels import LEAD, MOST_ALTERNATIVES, ChannelMistake, places_by_sensor
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.signals.cross_spectra import blackman_harris

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

BINS_PER_LOAD = 4
"""Bins between two harmonics, per load, from which their covariance is known."""
LEAST_GAIN, LEAST_GAIN_PER_BIN = 25.0, 0.25
"""Gain of log-likelihood, and that per independent bin, from which a mistake is accepted. Of sound records of three
rigs none gained more than 7 with a rotor of 30 % of the mass of the rig on the hub, and 12 without turbulence; with
cells 5 % stiffer or softer than declared, which no fit told, factors of 0.75 to 1.3 gained up to 0.3 per bin. Two
exchanged cells or a reversed one gain 0.7 to 6 per bin, a factor of 2 1.6 to 4."""
FACTORS = np.concatenate([sign * np.geomspace(0.1, 10.0, 81) for sign in (1.0, -1.0)])
"""Factors of a sensor that are tried, 6 % apart: its readings times such a factor would be right."""


@dataclass(frozen=True)
class _Bins:
    """Bins (k,) between two harmonics, `independent` ones: readings (k, r), their noise (r,), the inverse (k, m, r)."""

    inverse: ComplexArray
    readings: ComplexArray
    noise: Array
    independent: float

    def log_determinant(self, readings: ComplexArray, noise: Array) -> float:
        """Return ln |S| of the loads of readings (k, r), with their noise (r,)."""
        loads = (self.inverse @ readings[:, :, None])[:, :, 0]
        return float(np.linalg.slogdet(_mean_product(loads, loads) + self.loads_of_noise(noise))[1])

    def loads_of_noise(self, noise: Array, places: slice | list[int] = slice(None)) -> ComplexArray:
        """Return the covariance (m, m) of the loads that the noise (r,) of some channels makes."""
        rows = self.inverse[:, :, places] * np.sqrt(noise[places])
        return np.asarray(np.einsum("kmr,knr->mn", rows, rows.conj()) / len(rows))

    def log_determinants_with_factors(self, places: list[int]) -> Array:
        """Return ln |S| less 2 ln |det C| (f,) where some channels are multiplied by each of FACTORS."""
        part = (self.inverse[:, :, places] @ self.readings[:, places, None])[:, :, 0]
        rest = (self.inverse @ self.readings[:, :, None])[:, :, 0] - part
        cross, of_noise = _mean_product(rest, part), self.loads_of_noise(self.noise, places)
        constant = _mean_product(rest, rest) + self.loads_of_noise(self.noise) - of_noise
        s = FACTORS[:, None, None]
        S = constant + s * (cross + cross.conj().T) + s**2 * (_mean_product(part, part) + of_noise)
        return np.asarray(np.linalg.slogdet(S)[1] - 2.0 * np.log(np.abs(FACTORS)))


def mistakes_by_turbulence(record: RotorRecord, geometry: Geometry, source: ResponseSource) -> tuple[str, ...]:
    """Return the mistake that makes the loads of turbulence smooth, in words; several that do so alike, or none.

    A mistake is that of a sensor, with all its channels: two exchanged, one reversed or with another factor.
    """
    live = record.health.live
    if record.fixed_frequency or record.run.kind != "wind" or source.is_contradicted:
        return ()
    if not source.channel_combination(record.spectra.frequency_hz[1:2], live).rows_are_channels:
        return ()
    bins = list(_bins_between_harmonics(record, geometry, source))
    total = sum(item.independent for item in bins)
    if not total:
        return ()
    gains = list(_gains(bins, live, geometry))
    best = max(gain for _, gain in gains)
    near = [mistake for mistake, gain in gains if gain > best - LEAD]
    if best < max(LEAST_GAIN, LEAST_GAIN_PER_BIN * total) or len(near) > MOST_ALTERNATIVES:
        return ()
    return () if any(map(_is_tolerable, near)) else tuple(mistake.description for mistake in near)


def _is_tolerable(mistake: ChannelMistake) -> bool:
    """Whether a mistake is a factor as errors of the response explain it, too."""
    factor = 0.0 if mistake.scaled is None else float(mistake.matrix[mistake.scaled, mistake.scaled][0])
    return SMALLEST_FACTOR < factor < LARGEST_FACTOR


def _bins_between_harmonics(record: RotorRecord, geometry: Geometry, source: ResponseSource) -> Iterator[_Bins]:
    """Yield the bins between each harmonic and the next, without the anti-alias filter, where they are many enough."""
    spectrum, live = record.spectrum_over_time, record.health.live
    frequency, spectra = tapered_spectra((spectrum.rows * spectrum.scale[:, None]).T, spectrum.sample_rate)
    start = spectrum.first / spectrum.sample_rate
    interval = start, start + spectrum.rows.shape[1] / spectrum.sample_rate
    usable = between_harmonics(frequency, (record.azimuth, *record.other_rotors), interval)
    order = [spectrum.names.index(name) for name in live]
    noise = channel_noise(record, geometry) * np.sum(blackman_harris(spectrum.rows.shape[1]) ** 2)
    columns = [COMPONENTS.index(name) for name in record.components]
    harmonics = record.spectra.frequency_hz[1:]
    for low, high in pairwise(harmonics):
        at = np.flatnonzero(usable & (frequency > low) & (frequency < high))
        if len(at) < BINS_PER_LOAD * len(columns):
            continue
        H = anti_alias_response(geometry.acquisition, frequency[at])[:, None]
        picked = source.channel_combination(frequency[at[:1]], live)
        T = source.at(frequency[at], record.spin)[:, picked.rows][:, :, columns] / np.sqrt(noise)[:, None]
        inverse = np.linalg.pinv(T) / np.sqrt(noise)
        yield _Bins(inverse, spectra[at][:, order] / H, noise, len(at) / TAPER_FACTOR)


def _gains(bins: list[_Bins], live: tuple[str, ...], geometry: Geometry) -> Iterator[tuple[ChannelMistake, float]]:
    """Yield each mistake of sensors with the log-likelihood that it gains; of the factors of a sensor the likeliest."""
    weight = np.array([item.independent for item in bins])
    as_recorded = np.array([item.log_determinant(item.readings, item.noise) for item in bins])
    places = places_by_sensor(live, geometry)
    names = {name: live[at[0]] if len(at) == 1 else f"the channels of {name}" for name, at in places.items()}
    for a, b in combinations(places, 2):
        if len(places[a]) != len(places[b]):
            continue
        order = np.arange(len(live))
        order[[*places[a], *places[b]]] = [*places[b], *places[a]]
        swapped = np.array([item.log_determinant(item.readings[:, order], item.noise[order]) for item in bins])
        words = f"{names[a]} and {names[b].replace('the channels', 'those')}"
        yield ChannelMistake(np.eye(len(live))[order], words, 0.0), float(weight @ (as_recorded - swapped))
    for name, at in places.items():
        scaled = np.array([item.log_determinants_with_factors(at) for item in bins])
        gain, mask = weight @ (as_recorded[:, None] - scaled), np.isin(np.arange(len(live)), at)
        best = int(np.argmax(gain))
        factor = float(f"{1.0 / FACTORS[best]:.2g}")  # no closer than they lie
        matrix = np.diag(np.where(mask, factor, 1.0))
        yield ChannelMistake(matrix, names[name], 0.0, mask), float(gain[best])


def _mean_product(first: ComplexArray, second: ComplexArray) -> ComplexArray:
    """Return the mean (m, m) over k of first second* of vectors (k, m)."""
    return np.asarray(first.T @ second.conj() / len(first))
