"""Loads in other axes than the rig's: turned by right angles, or with signs of their own, as the channels show them.

Calibrations of balances often have x forward, y to starboard and z down (AIAA R-091). Several loads are then reversed
or exchanged at once, and none of them alone explains the readings.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.consistency.evidence import Evidence, zero_where_missing

Array = NDArray[np.float64]

MIN_APPLIED = 2
"""Loads from which several can be wrong at once."""
MIN_SIZE = 0.5
"""Share of a load that must act as another one: rigs that are turned by less than 45 deg are not turned at all."""


def signed_loads(runs: Sequence[Evidence]) -> tuple[int, ...] | None:
    """Which load of the file each of the six is, counted from 1 and negative where it is reversed.

    The loads that the channels show by the geometry are regressed on those recorded, and the largest part of each
    counts. None where all are in place, or several are the same one.
    """
    applied = sorted({j for run in runs for j in run.applied})
    if len(applied) < MIN_APPLIED:
        return None
    effect = np.sqrt(sum(np.sum(np.abs(zero_where_missing(run.computed)) ** 2, axis=(0, 1)) for run in runs))
    part = effect[:, None] * _regress_loads(runs) / np.where(effect > 0.0, effect, 1.0)
    places = [int(np.argmax(np.abs(part[:, j]))) for j in applied]
    if len(set(places)) < len(places) or min(abs(part[i, j]) for i, j in zip(places, applied, strict=True)) < MIN_SIZE:
        return None
    found = {i: (j + 1) * (1 if part[i, j] > 0 else -1) for i, j in zip(places, applied, strict=True)}
    rest = [j + 1 for j in range(6) if j not in applied]
    result = tuple(found[i] if i in found else rest.pop(0) for i in range(6))
    return None if result == (1, 2, 3, 4, 5, 6) else result


def _regress_loads(runs: Sequence[Evidence]) -> Array:
    """Matrix (6, 6) by which the loads recorded become those that explain the forces at low frequency."""
    normal, right = np.zeros((36, 36)), np.zeros(36)
    for run in runs:
        forces, loads = run.forces[run.low], run.loads[run.low]
        computed = np.where(np.isfinite(forces)[:, :, None], run.computed, 0.0)
        columns = np.einsum("kci,kj->kcij", computed, loads).reshape(-1, 36)
        normal += (columns.conj().T @ columns).real
        right += (columns.conj().T @ zero_where_missing(forces).ravel()).real
    scale = np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
    solution = np.linalg.lstsq(normal / scale / scale[:, None], right / scale, rcond=1e-9)[0]
    return np.asarray((solution / scale).reshape(6, 6))
