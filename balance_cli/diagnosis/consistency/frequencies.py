"""Whether the resonances of the runs lie where the geometry puts them, and which stiffness puts them elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Cell, Geometry
from balance_cli.diagnosis.consistency.evidence import Evidence, computed_forces, computed_parts, force_scale
from balance_cli.model.balance import balance_model
from balance_cli.model.system import System

Array = NDArray[np.float64]

UNIT_FACTORS = (1e3, 1e-3)
"""Of stiffness: N/mm given as N/m, and N/m as N/mm."""
SMOOTHING = 0.15
"""Relative width over which responses are averaged before they are compared: errors of a tenth in frequency and of any
size in damping are forgotten."""
DIFFERENT = 1.0
"""Rms of the logarithm of the ratio of two smoothed responses: a factor of 2.7 in amplitude at a typical frequency.
Responses of rigs with stiffnesses off by 30 % differ by 0.4."""
EXPLAINED_SHARE = 0.35
"""Of that rms: what may remain with the stiffness that explains it."""
LARGEST_REMAINING = 0.7
"""Of that rms, where a stiffness explains it."""
ODD_RATIO = 200.0
"""Ratio of the stiffness of a cell to the median of all from which its unit is doubted."""
ODD_CELL_SHARE = 0.7
"""Of the sum of squares of these logarithms: what may remain where the stiffness of a doubted cell is corrected."""
LEAST_SIGNAL = 4.0
"""Energy of a bin over that of its noise, from which it is compared: noise then changes it by an eighth at most. Where
a hammer has little power, and at the lowest lines of a record, channels may show nothing but noise."""
FEWEST_ROWS = 20
"""Rows of a sweep that are compared."""
STATIC_FREQUENCY = 1e-3
"""[Hz], below the modes of any balance."""
LEAST_FELT = 1e-9
"""Force of a cell for a unit load over that for the load that it feels most, which rounding exceeds only where the load
moves nothing."""
LEAST_READ = 0.25
"""Force that channels read for a load over the sum of the absolute forces of their cells, from which a response is
compared: of what cancels in a sum, errors of stiffness that are usual leave more than is computed."""
SMALLEST_RATIO = 4.0
"""Of stiffness over mass to what is declared, from which it is named as the cause; less has other causes, too."""
SCALES = np.geomspace(1 / 50.0, 50.0, 57)
"""Ratios of measured to computed natural frequencies that are tried, in steps of 15 %."""


@dataclass(frozen=True)
class FrequencyMismatch:
    """Responses that the geometry does not compute: by which factor of stiffness they would be, and of which cells.

    `factor` is None where no factor explains them; `cells` are empty where it is that of all.
    """

    difference: float
    factor: float | None
    cells: tuple[str, ...]
    runs: tuple[str, ...]


def frequency_mismatch(runs: Sequence[Evidence], geometry: Geometry, system: System) -> FrequencyMismatch | None:
    """Return how the sweeps contradict the computed responses of the geometry's system.

    None where they agree, or determine too little.
    """
    sweeps = [run for run in runs if run.rows.kind == "sweep" and len(run.applied) == 1]
    sweeps = [run for run in sweeps if len(run.rows.frequency) >= FEWEST_ROWS and run.loads[:, run.applied[0]].all()]
    felt = _read_components(system)
    sweeps = [run for run in sweeps if run.applied[0] in felt]
    if not sweeps:
        return None
    names = tuple(run.run for run in sweeps)
    scale = force_scale(geometry)
    declared = _differences(sweeps, system, scale)
    difference = float(declared.max())
    odd = _odd_cells(geometry)
    for cells in odd:
        factor = UNIT_FACTORS[0] if _is_soft(cells, geometry) else UNIT_FACTORS[1]
        changed = _differences(sweeps, _changed_system(geometry, cells, factor), scale)
        if np.sum(changed**2) < ODD_CELL_SHARE * np.sum(declared**2):
            return FrequencyMismatch(difference, factor, cells, names)
    if difference < DIFFERENT:
        return None
    limit = min(EXPLAINED_SHARE * difference, LARGEST_REMAINING)
    for factor in UNIT_FACTORS:
        for cells in _groups(geometry):
            if _differences(sweeps, _changed_system(geometry, cells, factor), scale).max() < limit:
                return FrequencyMismatch(difference, factor, cells, names)
    best, ratio = min((float(np.median(_differences(sweeps, system, scale, 1.0 / ratio))), ratio) for ratio in SCALES)
    explained = best < limit and abs(np.log(ratio**2)) > np.log(SMALLEST_RATIO)
    return FrequencyMismatch(difference, float(ratio**2) if explained else None, (), names)


def _read_components(system: System) -> frozenset[int]:
    """Return the load components that the channels read.

    A rig of few degrees of freedom does not feel all of them; of others the forces cancel in each sum of cells.
    """
    at_rest = np.array([STATIC_FREQUENCY])
    parts, _ = computed_parts(system, at_rest, 0.0)
    felt = np.abs(parts[0])
    read = np.linalg.norm(computed_forces(system, at_rest, 0.0)[0], axis=0)
    is_felt = felt.max(axis=0) > LEAST_FELT * felt.max(initial=0.0)
    return frozenset(np.flatnonzero(is_felt & (read > LEAST_READ * np.linalg.norm(felt, axis=0))).tolist())


def _odd_cells(geometry: Geometry) -> list[tuple[str, ...]]:
    """Return each cell whose stiffness is far from that of all others."""
    stiffness = np.array([cell.effective_stiffness for cell in geometry.cells])
    odd = np.abs(np.log(stiffness / np.median(stiffness))) > np.log(ODD_RATIO)
    return [(cell.name,) for cell, is_odd in zip(geometry.cells, odd, strict=True) if is_odd]


def _is_soft(cells: tuple[str, ...], geometry: Geometry) -> bool:
    median = np.median([cell.effective_stiffness for cell in geometry.cells])
    return any(cell.effective_stiffness < median for cell in geometry.cells if cell.name in cells)


def _groups(geometry: Geometry) -> list[tuple[str, ...]]:
    """Return all cells, and each set of cells with parallel axes."""
    parallel = {
        tuple(other.name for other in geometry.cells if abs(float(cell.direction @ other.direction)) > 0.99)
        for cell in geometry.cells
    }
    return [geometry.cell_names, *sorted(parallel)]


def with_stiffness(geometry: Geometry, cells: tuple[str, ...], factor: float) -> Geometry:
    """Return the geometry with the stiffness of these cells (all where there are none) multiplied by a factor."""
    cells = cells or geometry.cell_names
    changed = tuple(_scaled(cell, factor) if cell.name in cells else cell for cell in geometry.cells)
    return geometry.model_copy(update={"cells": changed})


def _scaled(cell: Cell, factor: float) -> Cell:
    return cell.model_copy(update={"stiffness": cell.effective_stiffness * factor, "series": None})


def _changed_system(geometry: Geometry, cells: tuple[str, ...], factor: float) -> System:
    return balance_model(with_stiffness(geometry, cells, factor)).system()


def _differences(sweeps: Sequence[Evidence], system: System, scale: Array, ratio: float = 1.0) -> Array:
    """Return the rms over a sweep of each component of log measured less log computed at `ratio` times the lines.

    `scale` (c,) are the divisors of the forces.
    """

    def computed(run: Evidence) -> Array:
        forces = computed_forces(system, run.rows.frequency * ratio, 0.0)[:, :, run.applied[0]] / scale
        return np.asarray(np.where(np.isfinite(run.forces), np.abs(forces) ** 2, 0.0).sum(axis=1))

    return np.array([np.sqrt(np.mean(_smoothed(run, computed) ** 2)) for run in _distinct(sweeps)])


def _distinct(sweeps: Sequence[Evidence]) -> list[Evidence]:
    """Return one sweep of each component."""
    return list({run.applied: run for run in sweeps}.values())


def _smoothed(run: Evidence, computed: Callable[[Evidence], Array]) -> Array:
    """Return half the log of the ratio of measured to computed energy in bins of frequency (amplitude, natural log).

    Bins where neither of them exceeds the noise are left out; where that is all, nothing differs.
    """
    load = np.abs(run.loads[:, run.applied[0]]) ** 2
    energy_of_forces = np.abs(run.forces) ** 2
    measured = np.nansum(energy_of_forces, axis=1) / load
    noise = np.nansum(energy_of_forces * run.rows.noise_share, axis=1) / load
    bins = np.round(np.log(run.rows.frequency) / SMOOTHING).astype(int)
    bins -= bins.min()
    counts = np.bincount(bins)
    energies = (measured, computed(run), noise)
    means = [np.bincount(bins, energy)[counts > 0] / counts[counts > 0] for energy in energies]
    tiny = np.finfo(float).tiny
    ratios = 0.5 * np.log(np.maximum(means[0], tiny) / np.maximum(means[1], tiny))
    is_signal = np.maximum(means[0], means[1]) > LEAST_SIGNAL * means[2]
    return np.asarray(ratios[is_signal] if is_signal.any() else np.zeros(1))
