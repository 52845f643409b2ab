"""Two channels that read one cell must agree at the harmonics of a record, whatever the loads are.

Wind-on, no load is known, and the residual test of a short record weighs gusts as noise. But the response of one
channel of a cell is that of the other times a factor, for every load alike: readings that miss it show a gain, a sign,
a delay or a filter that came after the sweeps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.percent import percent_text
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.signals.anti_alias import anti_alias_response

ComplexArray = NDArray[np.complex128]

LARGEST_DIFFERENCE = 0.05
"""Difference of two channels of a cell, over the larger reading, that is worth a flag: as much as a change of a mean
load. Sensitivities are known to less, and identification takes up what is the same in all runs."""
SIGMAS = 6.0
"""Standard deviations of the difference, so that noise alone does not make one in a million harmonics."""
FEWEST_HARMONICS = 2
"""Harmonics that must show it: one may lie beside a tone."""
PATTERN_FACTOR = 5.0
"""Of what the responses of two channels miss of being one times a factor, in measured responses by their noise: this
many times as much is added to what is usual."""


@dataclass(frozen=True)
class PairContradiction:
    """Two channels of a cell that differ by `difference` over the reading, at `harmonics` of those that they show."""

    first: str
    second: str
    difference: float
    harmonics: tuple[int, ...]

    @property
    def description(self) -> str:
        """The contradiction in words."""
        at = ", ".join(f"{n}/rev" for n in self.harmonics[:4]) + (" and more" if len(self.harmonics) > 4 else "")
        return (
            f"{self.first} and {self.second} read one cell and differ by {percent_text(self.difference)} % of what the "
            f"response says at {at}: gain, sign, delay or filter of one changed after the sweeps"
        )


def contradicted_pairs(
    record: RotorRecord, geometry: Geometry, source: ResponseSource, response: ComplexArray
) -> tuple[PairContradiction, ...]:
    """Return the pairs of channels of one cell that contradict each other beyond noise and what is usual.

    `response` is the `harmonic_response` of the record.
    None where the response is known to miss its own data, which it may do in one of the channels.
    """
    if source.response_error is not None or source.is_contradicted or len(record.spectra.frequency_hz) < 2:
        return ()
    live = record.health.live
    frequency = record.spectra.frequency_hz[1:]
    combination = source.channel_combination(frequency[:1], live)
    if not combination.rows_are_channels:
        return ()
    sources = {channel.name: channel.source for channel in geometry.channels}
    by_source: dict[str, list[int]] = {}
    for index, name in enumerate(live):
        by_source.setdefault(sources[name] or name, []).append(index)
    pairs = [(members[0], other) for members in by_source.values() for other in members[1:]]
    if not pairs:
        return ()
    return tuple(_contradictions(record, geometry, response[:, combination.rows], pairs))


def _contradictions(
    record: RotorRecord, geometry: Geometry, T: ComplexArray, pairs: list[tuple[int, int]]
) -> Iterator[PairContradiction]:
    """Yield the pairs whose readings miss the factor between their responses T (n, c, 6)."""
    live, spectra = record.health.live, record.spectra
    H = anti_alias_response(geometry.acquisition, spectra.frequency_hz[1:])
    columns = spectra.columns(live)
    readings = spectra.amplitude[1:, columns] / H[:, None]
    noise = spectra.covariance[1:][:, columns][:, :, columns] / np.abs(H[:, None, None]) ** 2
    for i, j in pairs:
        power = np.sum(np.abs(T[:, i]) ** 2, axis=1)
        factor = np.sum(T[:, j] * T[:, i].conj(), axis=1) / np.where(power > 0, power, np.inf)
        other = np.sum(np.abs(T[:, j]) ** 2, axis=1)
        missed = np.sum(np.abs(T[:, j] - factor[:, None] * T[:, i]) ** 2, axis=1)
        usual = LARGEST_DIFFERENCE + PATTERN_FACTOR * np.sqrt(missed / np.where(other > 0, other, np.inf))
        difference = readings[:, j] - factor * readings[:, i]
        variance = (
            noise[:, j, j].real
            + np.abs(factor) ** 2 * noise[:, i, i].real
            - 2.0 * (noise[:, j, i] * factor.conj()).real
        )
        size = np.maximum(np.abs(readings[:, j]), np.abs(factor * readings[:, i]))
        relative = np.abs(difference) / np.maximum(size, np.finfo(float).tiny)
        significant = np.abs(difference) > SIGMAS * np.sqrt(np.maximum(variance, 0.0))
        shown = np.flatnonzero(significant & (relative > usual))
        if len(shown) >= FEWEST_HARMONICS:
            harmonics = tuple(int(k) + 1 for k in shown)
            yield PairContradiction(live[i], live[j], float(np.median(relative[shown])), harmonics)
