"""Two channels that read one cell must agree at the harmonics of a record, whatever the loads are.

Wind-on, no load is known, and the residual test of a short record weighs gusts as noise. But the response of one
channel of a cell is that of the other times a factor, for every load alike: readings that miss it show a gain, a sign,
a delay or a filter that came after the sweeps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.percent import percent_text
from balance_cli.reduction.response_sources import ResponseSource, ResponseWithoutModel
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.reduction.weighted_least_squares import SolvedLoads
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.signals.rotor.steadiness import FEWEST_WINDOWS, windowed_amplitudes

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FLOOR = float(np.finfo(np.float64).tiny)
LARGEST_DIFFERENCE = 0.05
"""Difference of two channels of a cell, over the larger reading, that is worth a flag: as much as a change of a mean
load. Sensitivities are known to less, and identification takes up what is the same in all runs."""
SIGMAS = 6.0
"""Standard deviations of the difference, so that noise alone does not make one in a million harmonics."""
LEAST_SHARE = 0.3
"""Error of a load by a gain, over its standard deviation, that matters: together they are 5 % larger than that."""
DRIFT_SIGMAS = 5.0
"""Standard deviations of a drift by its scatter from window to window, of which a line leaves eight at least."""
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


@dataclass(frozen=True)
class PairGain:
    """Factor less one that all harmonics of channel `other` have over what channel `first` of its cell says.

    Either of them has it; `drift` is by how much it changes within the record, None where that is within its scatter.
    """

    first: str
    other: str
    gain: float
    drift: float | None

    @property
    def description(self) -> str:
        """The factor in words."""
        either = f"{self.first} and {self.other} read one cell and differ by {percent_text(abs(self.gain))} %"
        if self.drift is None:
            return f"{either} at all harmonics, which is in sigma: did the gain of one change after the sweeps?"
        return f"{either} at all harmonics, which changes by {percent_text(abs(self.drift))} %: does a gain drift?"


def contradicted_pairs(
    record: RotorRecord, geometry: Geometry, source: ResponseSource, response: ComplexArray
) -> tuple[PairContradiction, ...]:
    """Return the pairs of channels of one cell that contradict each other beyond noise and what is usual.

    `response` is the `harmonic_response` of the record.
    None where the response is known to miss its own data, which it may do in one of the channels.
    """
    pairs, T = _pairs_of_channels(record, geometry, source, response)
    return tuple(_contradictions(record, geometry, T, pairs))


def add_pair_gains(
    solution: SolvedLoads, record: RotorRecord, geometry: Geometry, source: ResponseSource, response: ComplexArray
) -> tuple[SolvedLoads, tuple[PairGain, ...]]:
    """Return the loads with what the gains of two channels of a cell differ by, and these pairs.

    All harmonics together show a gain that drifts by 3 % in a short record, where no single one does and no flag says
    it: below LARGEST_DIFFERENCE. It is among what the response is known to miss, as an error of either channel. A
    response without a model has errors of its own at each harmonic, which would be taken for gains: it keeps its loads.
    """
    if isinstance(source, ResponseWithoutModel):
        return solution, ()
    pairs, T = _pairs_of_channels(record, geometry, source, response)
    names, error, gains = record.health.live, solution.model_covariance.copy(), []
    variance = np.diagonal(solution.covariance, axis1=1, axis2=2)
    for pair in _differences(record, geometry, T, pairs):
        weight = pair.predicted / pair.variance
        information = max(float(np.sum((weight.conj() * pair.predicted).real)), FLOOR)
        gain = float(np.sum((weight.conj() * pair.difference).real)) / information
        moved = gain * np.stack([_load_of_channel(solution, row) for row in (pair.first, pair.other)])
        matters = bool(np.any(moved**2 > LEAST_SHARE**2 * variance))
        if matters and SIGMAS * np.sqrt(0.5 / information) < abs(gain) < LARGEST_DIFFERENCE:
            error += np.einsum("phb,phc->hbc", moved, moved)
            drift = _drift(record, geometry, pair, weight)
            gains.append(PairGain(names[pair.first], names[pair.other], gain, drift))
    return replace(solution, model_covariance=error), tuple(gains)


def _load_of_channel(solution: SolvedLoads, row: int) -> Array:
    """Return the share (h, 2m) of the loads that comes from the readings of a channel."""
    equations = solution.equations
    parts = [row, row + equations.readings.shape[1] // 2]
    return np.asarray(np.einsum("hbr,hr->hb", equations.estimator[:, :, parts], equations.readings[:, parts]))


def _drift(record: RotorRecord, geometry: Geometry, pair: _Difference, weight: ComplexArray) -> float | None:
    """Return by how much the factor of a pair changes from the first revolution to the last, by a straight line.

    What was left out as a transient is examined, too: two channels of one cell share it. None where the line is within
    its scatter from window to window.
    """
    names = (record.health.live[pair.first], record.health.live[pair.other])
    windows = windowed_amplitudes(record.run, record.azimuth, names, len(weight), (0, record.spectra.revolutions[1]))
    values = windows.values[:, 1:] / anti_alias_response(geometry.acquisition, record.spectra.frequency_hz[1:])[:, None]
    expected = pair.factor * values[:, :, 0]
    power = np.sum((weight.conj() * expected).real, axis=1)
    gain = np.sum((weight.conj() * (values[:, :, 1] - expected)).real, axis=1) / np.where(power != 0, power, np.inf)
    time = np.linspace(-0.5, 0.5, len(gain))
    if len(gain) < FEWEST_WINDOWS:
        return None
    slope = float(time @ gain / (time @ time))
    scatter = float(np.std(gain - gain.mean() - slope * time)) / np.sqrt(float(time @ time))
    return slope if abs(slope) > DRIFT_SIGMAS * scatter else None


@dataclass(frozen=True)
class _Difference:
    """What channel `first` says of the `other` (n,), by the `factor` (n,) between them, and what that misses.

    `variance` (n,) is that of the difference by noise, `missed` (n,) what their responses miss of one times a factor,
    over the response.
    """

    first: int
    other: int
    factor: ComplexArray
    predicted: ComplexArray
    difference: ComplexArray
    variance: Array
    missed: Array


def _pairs_of_channels(
    record: RotorRecord, geometry: Geometry, source: ResponseSource, response: ComplexArray
) -> tuple[list[tuple[int, int]], ComplexArray]:
    """Return the pairs of live channels that read one cell, and their responses (n, c, 6); no pair to be compared."""
    live, frequency = record.health.live, record.spectra.frequency_hz[1:]
    if source.response_error is not None or source.is_contradicted or not len(frequency):
        return [], response
    combination = source.channel_combination(frequency[:1], live)
    if not combination.rows_are_channels:
        return [], response
    sources = {channel.name: channel.source for channel in geometry.channels}
    by_source: dict[str, list[int]] = {}
    for index, name in enumerate(live):
        by_source.setdefault(sources[name] or name, []).append(index)
    pairs = [(members[0], other) for members in by_source.values() for other in members[1:]]
    return pairs, response[:, combination.rows]


def _differences(
    record: RotorRecord, geometry: Geometry, T: ComplexArray, pairs: list[tuple[int, int]]
) -> Iterator[_Difference]:
    """Yield for each pair what its readings miss of the factor between their responses T (n, c, 6)."""
    spectra = record.spectra
    H = anti_alias_response(geometry.acquisition, spectra.frequency_hz[1:])
    columns = spectra.columns(record.health.live)
    readings = spectra.amplitude[1:, columns] / H[:, None]
    noise = spectra.covariance[1:][:, columns][:, :, columns] / np.abs(H[:, None, None]) ** 2
    for i, j in pairs:
        power = np.sum(np.abs(T[:, i]) ** 2, axis=1)
        factor = np.sum(T[:, j] * T[:, i].conj(), axis=1) / np.where(power > 0, power, np.inf)
        other = np.sum(np.abs(T[:, j]) ** 2, axis=1)
        missed = np.sum(np.abs(T[:, j] - factor[:, None] * T[:, i]) ** 2, axis=1)
        variance = (
            noise[:, j, j].real
            + np.abs(factor) ** 2 * noise[:, i, i].real
            - 2.0 * (noise[:, j, i] * factor.conj()).real
        )
        predicted, share = factor * readings[:, i], np.sqrt(missed / np.where(other > 0, other, np.inf))
        yield _Difference(i, j, factor, predicted, readings[:, j] - predicted, np.maximum(variance, FLOOR), share)


def _contradictions(
    record: RotorRecord, geometry: Geometry, T: ComplexArray, pairs: list[tuple[int, int]]
) -> Iterator[PairContradiction]:
    """Yield the pairs whose readings miss the factor between their responses T (n, c, 6)."""
    live = record.health.live
    for pair in _differences(record, geometry, T, pairs):
        usual = LARGEST_DIFFERENCE + PATTERN_FACTOR * pair.missed
        size = np.maximum(np.abs(pair.predicted + pair.difference), np.abs(pair.predicted))
        relative = np.abs(pair.difference) / np.maximum(size, FLOOR)
        significant = np.abs(pair.difference) > SIGMAS * np.sqrt(pair.variance)
        shown = np.flatnonzero(significant & (relative > usual))
        if len(shown) >= FEWEST_HARMONICS:
            harmonics = tuple(int(k) + 1 for k in shown)
            difference = float(np.median(relative[shown]))
            yield PairContradiction(live[pair.first], live[pair.other], difference, harmonics)
