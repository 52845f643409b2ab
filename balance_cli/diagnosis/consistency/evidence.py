"""The evidence of a run: the forces that its channels read, and what geometry, channel pairs and other runs predict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigvals

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.channel_gains import channel_gains
from balance_cli.model.system import System
from balance_cli.model.system_response import response, solve
from balance_cli.signals.response_rows import ResponseRows, select_rows

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Bools = NDArray[np.bool_]
Index = NDArray[np.intp]

LOW_FREQUENCY_SHARE = 0.5
"""Of the lowest computed natural frequency: up to there a response exceeds that at rest by a third at most, so that
errors of stiffness and mass hardly change it."""
GEOMETRY_ERROR = 0.1
"""Relative error of a computed response at low frequency that is usual without any mistake (paths beside the cells,
flexible supports), or three times the declared tolerance of stiffness where that is more."""
LEAST_CORRELATION = 0.9
"""Of a channel with what is predicted for another, from which the two may have been exchanged."""
MANY_BANDS, THINNING = 150, 3
"""Bands from which only every third is used: neighbors say the same."""


@dataclass(frozen=True)
class Evidence:
    """One run at its rows k, for c channels: `forces` (k, c) and `loads` (k, 6) as recorded.

    `gains` (k, c) are the volts per unit of force of each channel.
    `computed` (l, c, 6) are the forces per load by the geometry at the rows `low` (k,), at which they are trusted;
    `computed_parts` (l, q, 6) those of the cells that each channel sums, and `part_channels` (q,) the channel of each.
    `reference` (k, c, 6) are those that other runs show, NaN where none does. `pairs` are indices of channels that
    read the same cell. Forces are in N, and torques divided by the size of the rig.
    """

    rows: ResponseRows
    forces: ComplexArray
    loads: ComplexArray
    gains: ComplexArray
    low: Bools
    computed: ComplexArray
    computed_parts: ComplexArray
    part_channels: Index
    reference: ComplexArray
    pairs: tuple[tuple[int, int], ...]
    geometry_error: float

    @property
    def run(self) -> str:
        """Name of the run."""
        return self.rows.run

    @cached_property
    def applied(self) -> tuple[int, ...]:
        """Components that drive rows of the run; in a static run, those that vary."""
        if self.rows.is_static:
            return tuple(int(j) for j in np.flatnonzero(np.any(self.loads != 0, axis=0)))
        return self.rows.by_points or tuple(int(j) for j in np.unique(self.rows.reference))

    @cached_property
    def predicted(self) -> tuple[ComplexArray, ComplexArray]:
        """Forces (l, c) by the geometry and (k, c) by other runs, for the loads as recorded."""
        return predictions(self, self.loads)

    @cached_property
    def predicted_parts(self) -> Array:
        """Sums (l, c) of the absolute forces that the cells of each channel have by the geometry, for the loads.

        They are the forces that a channel reads, unless it sums cells whose forces cancel.
        """
        sizes = np.abs(_predict(self.computed_parts, self.loads[self.low]))
        total = np.zeros((len(sizes), self.forces.shape[1]))
        np.add.at(total.T, self.part_channels, sizes.T)
        return total


def natural_frequencies(system: System) -> Array:
    """Return the undamped natural frequencies [Hz] in rising order, infinite ones left out."""
    M, K = system.pencil.mass.value, system.pencil.stiffness.value
    square = np.asarray(eigvals(K, M), complex)
    real = square[np.isfinite(square) & (square.real > 0)].real
    return np.sort(np.sqrt(real)) / (2 * np.pi)


def rig_size(geometry: Geometry) -> float:
    """Return the length [m] that makes torques comparable with forces: the largest distance of a cell or the hub."""
    points = np.array([geometry.hub, *(cell.position for cell in geometry.cells)], float)
    return float(np.linalg.norm(points, axis=1).max()) or 1.0


def force_scale(geometry: Geometry) -> Array:
    """Return the divisors (c,) of the channels' readings, as forces: 1, of torques the size of the rig.

    Of accelerations it is the reciprocal of the mass.
    """
    mass = sum(body.mass for body in geometry.bodies)
    divisors = np.array([rig_size(geometry) if channel.torque_meter else 1.0 for channel in geometry.channels])
    return np.where([channel.accelerometer is not None for channel in geometry.channels], 1.0 / mass, divisors)


def same_source_pairs(geometry: Geometry) -> tuple[tuple[int, int], ...]:
    """Return the indices of channels that read the same source: each with the first of its source."""
    sources = [channel.source for channel in geometry.channels]
    return tuple((sources.index(name), i) for i, name in enumerate(sources) if name and sources.index(name) < i)


def gather_evidence(rows: Sequence[ResponseRows], geometry: Geometry, system: System) -> list[Evidence]:
    """Return the evidence of each run; runs with the same excited component are references of each other."""
    lowest = float(natural_frequencies(system).min(initial=np.inf))
    rows = _thin_out(rows)
    scale = force_scale(geometry)
    pairs = same_source_pairs(geometry)
    error = max(GEOMETRY_ERROR, 3.0 * geometry.tolerances.stiffness)
    runs = []
    for run in rows:
        low = run.frequency <= LOW_FREQUENCY_SHARE * lowest
        gains = channel_gains(system.equations.paths, run.frequency) * scale
        forces = _divide(run.channels, gains)
        computed = computed_forces(system, run.frequency[low], run.rotor_speed) / scale[:, None]
        parts, part_channels = computed_parts(system, run.frequency[low], run.rotor_speed)
        parts = parts / scale[part_channels, None]
        evidence = Evidence(
            rows=run,
            forces=forces,
            loads=run.loads,
            gains=gains,
            low=low,
            computed=computed,
            computed_parts=parts,
            part_channels=part_channels,
            reference=np.full((*forces.shape, 6), np.nan, complex),
            pairs=pairs,
            geometry_error=error,
        )
        runs.append(evidence)
    return with_references(runs)


def _thin_out(rows: Sequence[ResponseRows]) -> list[ResponseRows]:
    """Return the sweeps with fewer bands where they have many, the same in all, and those that check runs need."""
    needed = np.unique(np.concatenate([[-1], *(run.band for run in rows if run.kind == "check")]))
    thinned = []
    for run in rows:
        keep = (run.band % THINNING == 0) | np.isin(run.band, needed)
        thinned.append(select_rows(run, keep) if len(run.band) > MANY_BANDS and run.kind == "sweep" else run)
    return thinned


def _divide(values: ComplexArray, gains: ComplexArray) -> ComplexArray:
    """Return values over gains; NaN where a gain is zero, as that of a high-pass for a constant load."""
    usable = np.broadcast_to(np.abs(gains) > 0, values.shape)
    return np.asarray(np.divide(values, gains, out=np.full(values.shape, np.nan, complex), where=usable))


def computed_parts(system: System, frequency: Array, spin: float) -> tuple[ComplexArray, Index]:
    """Return the computed forces (l, q, 6) of the cells that the channels sum, times their weights, per unit load.

    Second, the channel (q,) of each. Any other channel has one part: what it reads.
    """
    sums = {item.spring: item.weights for item in system.equations.sums}
    parts = [
        (channel, cell, weight)
        for channel, spring in enumerate(system.springs_of_channels)
        for cell, weight in sums.get(spring, {spring: 1.0}).items()
    ]
    channels, springs, weights = (np.array(column) for column in zip(*parts, strict=True))
    if not len(frequency):
        return np.zeros((0, len(channels), 6), complex), channels
    distinct, place = np.unique(frequency, return_inverse=True)
    forces = solve(system, distinct, spin).forces[:, springs] * weights[:, None]
    return forces[place], channels


def computed_forces(system: System, frequency: Array, spin: float) -> ComplexArray:
    """Return the computed forces and torques (l, c, 6) that the channels read, per unit load."""
    distinct, place = np.unique(frequency, return_inverse=True)
    if not len(distinct):
        return np.zeros((0, len(system.channel_names), 6), complex)
    gains = channel_gains(system.equations.paths, distinct)[:, :, None]
    return _divide(response(system, solve(system, distinct, spin)), gains)[place]


def with_references(runs: Sequence[Evidence]) -> list[Evidence]:
    """Return the evidence with the responses that the sweeps of other runs show, averaged over these runs."""
    sweeps = [run for run in runs if run.rows.kind == "sweep" and len(run.applied) == 1]
    measured = {run.run: _apparent_response(run) for run in sweeps}
    return [replace(run, reference=_reference(run, sweeps, measured)) for run in runs]


def _apparent_response(run: Evidence) -> ComplexArray:
    """Return the forces (k, c) per unit of the excited load in the bands of a sweep, which rise."""
    return _divide(run.forces, run.loads[:, run.applied[0], None])


def _reference(run: Evidence, sweeps: Sequence[Evidence], measured: dict[str, ComplexArray]) -> ComplexArray:
    """Return the mean response (k, c, 6) of the other sweeps at the rows of a run; NaN where no other run has it."""
    total = np.zeros((*run.forces.shape, 6), complex)
    count = np.zeros((len(run.forces), 6))
    if not run.rows.is_static:
        for sweep in sweeps:
            if sweep.run == run.run:
                continue
            (j,) = sweep.applied
            place = np.minimum(np.searchsorted(sweep.rows.band, run.rows.band), len(sweep.rows.band) - 1)
            common = sweep.rows.band[place] == run.rows.band
            total[common, :, j] += measured[sweep.run][place[common]]
            count[common, j] += 1.0
    with np.errstate(invalid="ignore"):
        return np.asarray(total / np.where(count > 0, count, np.nan)[:, None, :])


def correlated_channels(run: Evidence) -> Bools:
    """Return whether (c, c) channel i reads what is predicted for channel j, up to a factor, and the reverse.

    Predictions are those by the geometry, by other runs, and the other channel of a cell.
    """
    partner = np.full(run.forces.shape, np.nan, complex)
    for first, second in run.pairs:
        partner[:, first], partner[:, second] = run.forces[:, second], run.forces[:, first]
    by_geometry, by_runs = run.predicted
    predictions = [
        (run.forces[run.low] * run.gains[run.low], by_geometry * run.gains[run.low]),
        (run.forces * run.gains, by_runs * run.gains),
        (run.forces * run.gains, partner * run.gains),
    ]
    alike = np.zeros((run.forces.shape[1],) * 2, bool)
    for volts, predicted in predictions:
        correlation = _correlation(zero_where_missing(volts.copy()), zero_where_missing(predicted.copy()))
        alike |= (correlation > LEAST_CORRELATION) & (correlation.T > LEAST_CORRELATION)
    return alike


def _correlation(first: ComplexArray, second: ComplexArray) -> Array:
    """Return the absolute correlation (c, c) of the columns of two arrays; zero where one has none."""
    norms = np.outer(np.linalg.norm(first, axis=0), np.linalg.norm(second, axis=0))
    return np.asarray(np.abs(first.conj().T @ second) / np.where(norms > 0, norms, np.inf))


def predictions(run: Evidence, loads: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return the forces (l, c) of a run by the geometry and (k, c) by other runs, for loads (k, 6)."""
    return _predict(run.computed, loads[run.low]), _predict_from_runs(run.reference, loads, run.applied)


def _predict(forces_per_load: ComplexArray, loads: ComplexArray) -> ComplexArray:
    return np.asarray(np.einsum("kcj,kj->kc", forces_per_load, loads))


def _predict_from_runs(reference: ComplexArray, loads: ComplexArray, applied: tuple[int, ...]) -> ComplexArray:
    """Return the forces (k, c) by other runs for the components that drive the run; NaN where one is unknown."""
    columns = list(applied)
    return _predict(reference[:, :, columns], loads[:, columns]) if columns else np.full(reference.shape[:2], np.nan)


def zero_where_missing(values: ComplexArray) -> ComplexArray:
    """Set what is not a number to zero, in place, and return the array."""
    values[np.isnan(values)] = 0.0
    return values
