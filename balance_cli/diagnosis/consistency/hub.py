"""Where the hub is by the moments that forces make: one position, as against exciters with cross-axis loads."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.consistency.evidence import Evidence, zero_where_missing
from balance_cli.diagnosis.consistency.residuals import residual_weights

Array = NDArray[np.float64]

SMALLEST_SHIFT = 0.04
"""Shift of the hub relative to the size of the rig that is named: 3 cm of 0.8 m. Exciters are placed to millimeters."""
REMAINING_SHARE = 0.4
"""Of the residuals of all runs: what may remain with the hub at the place that is found. Of an exciter that
makes a moment with one force, half remains."""
FEWEST_FORCES = 2
"""Components of force that must have been applied: with one, a tilted exciter explains the same."""
LEAST_GAIN = 1.0
"""Of the sum of squares of all residuals: the usual error of one channel in one run. A hub 0.1 m higher changes the
forces of a static run by no more, as the vertical ones are larger; and what remains is the better test."""


def hub_shift(runs: Sequence[Evidence], size: float) -> Array | None:
    """Return how far from its declared place the hub acts (3,) [m]; None where it is in place or cannot be told.

    A force F at r + d has the moment d x F more about r, whatever the stiffness; the residuals are linear in d. `size`
    is that of the rig [m].
    """
    forces = {j for run in runs for j in run.applied if j < 3}
    if len(forces) < FEWEST_FORCES:
        return None
    normal, right, before = np.zeros((3, 3)), np.zeros(3), 0.0
    parts = []
    for run in runs:
        divisor = residual_weights(run).geometry
        declared = zero_where_missing((run.forces[run.low] - run.predicted[0]) / divisor).ravel()
        columns = np.stack([_moved_force(run, unit).ravel() / divisor for unit in np.eye(3)], axis=1)
        normal += (columns.conj().T @ columns).real
        right -= (columns.conj().T @ declared).real
        before += float(np.vdot(declared, declared).real)
        parts.append((declared, columns))
    shift, *_ = np.linalg.lstsq(normal, right, rcond=1e-3)
    after = sum(float(np.sum(np.abs(declared + columns @ shift) ** 2)) for declared, columns in parts)
    if np.linalg.norm(shift) < SMALLEST_SHIFT * size or before - after < LEAST_GAIN:
        return None
    return np.asarray(shift) if after < REMAINING_SHARE * before else None


def _moved_force(run: Evidence, shift: Array) -> NDArray[np.complex128]:
    """Return the change (l, c) of the residuals, times their divisor, for a hub moved by `shift` [m]."""
    loads = run.loads[run.low]
    moments = np.cross(np.broadcast_to(shift, (len(loads), 3)), loads[:, :3])
    change = -np.einsum("kcj,kj->kc", run.computed[:, :, 3:], moments)
    return np.where(np.isfinite(run.forces[run.low]), change, 0.0)
