"""A contact that sticks and slips (Jenkins' element): what several effects have in common."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import EffectParameter
from balance_cli.model.effects.places import Where, cell_at
from balance_cli.model.effects.search_hints import Start
from balance_cli.model.mechanics.cell_force import CellForce, CellMotion
from balance_cli.model.mechanics.dual_numbers import Dual, constant, stack
from balance_cli.model.mechanics.equations import Equations

Array = NDArray[np.float64]

LEAST_FORCE_SHARE = 1e-5
"""Force below which the slip distance is constant, relative to the cell's range: far below any measurable force."""
RELEVANT_FORCE_SHARE = 1e-3
"""A force that matters, relative to the cell's range."""
INACCURACY = (0.01, 0.05)
"""Fractions of its force that noise makes uncertain in periodic and in other records: it reverses early or late."""
SLIP_DISTANCES = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2)
"""Slip distances at which a search scores a contact, relative to the cell's elongation at full range: half decades."""
STIFFNESS_BOUNDS = (1e-3, 1e4)
"""Bounds of the stiffness from which a search begins, relative to that of the cell. A contact that always slips is far
stiffer than a soft cell: a ball screw on a spring, four decades."""


def force_parameter(geometry: Geometry, where: Where, name: str, description: str) -> EffectParameter:
    """A force [N] at which a contact slips; its derivative at zero is that of a contact that always slips."""
    force = RELEVANT_FORCE_SHARE * cell_at(geometry, where).full_range
    return EffectParameter(name, "N", 0.0, force, description, lower=0.0, start=force)


def stiffness_parameter(geometry: Geometry, where: Where) -> EffectParameter:
    """The stiffness [N/m] of a contact."""
    k, description = cell_at(geometry, where).effective_stiffness, "Stiffness of the contact while it sticks."
    return EffectParameter("stick_stiffness", "N/m", k, 0.1 * k, description, lower=1e-3 * k, start=k, nuisance=True)


def slip_starts(geometry: Geometry, where: Where) -> tuple[Start, ...]:
    """Stiffnesses at which a search scores a contact, one for each slip distance."""
    k = cell_at(geometry, where).effective_stiffness
    return tuple({"stick_stiffness": LEAST_FORCE_SHARE / slip * k} for slip in SLIP_DISTANCES)


def start_from_force(geometry: Geometry, where: Where, start: Start, force: float) -> Start:
    """The start with the stiffness that gives a contact of this force [N] the slip distance at which it was scored."""
    cell = cell_at(geometry, where)
    k = cell.effective_stiffness
    distance = LEAST_FORCE_SHARE * cell.full_range / start.get("stick_stiffness", k)
    lower, upper = (share * k for share in STIFFNESS_BOUNDS)
    return {**start, "stick_stiffness": float(np.clip(force / distance, lower, upper))}


def start_from_score(geometry: Geometry, where: Where, start: Start, estimate: Start) -> Start:
    """The force that the score of a contact with one force estimates, with the stiffness that belongs to it."""
    return {**start_from_force(geometry, where, start, estimate["force"]), "force": estimate["force"]}


def contact_shape(
    motion: CellMotion, limit: Dual, stiffness: Dual, least: float, asymmetry: Dual | float = 0.0
) -> Dual:
    """Force of a contact over its `limit` (n,): since it last slipped the contact has been a spring.

    Below the force `least` [N] the slip distance is that at this force. With an `asymmetry` a the contact slips at
    1 + a and at -1 + a.
    """
    d = motion.elongation
    if not limit.value > least:
        limit = constant(least, limit.parameters)
    per_meter = stiffness * limit.reciprocal()
    distance, shift = float(1.0 / per_meter.value), float(asymmetry.value if isinstance(asymmetry, Dual) else asymmetry)
    last, direction = find_last_slip(d.value, distance, motion.is_periodic, shift * distance)
    has_slipped = last >= 0
    since = Dual(d.value[last], d.derivative[:, last])
    if not has_slipped.all():
        since = since * has_slipped
    return (d - since) * per_meter + (direction + asymmetry * has_slipped)


def held_force(values: Array, span: float) -> float:
    """The largest force that a contact of force F may keep: |d - w| <= F / kappa holds at both ends of the span."""
    return float(max(values[0] - 0.5 * values[1] * span, 0.0))


def add_contact(
    equations: Equations,
    geometry: Geometry,
    where: Where,
    parameters: Sequence[Dual],
    shape: Callable[..., Dual],
    held: Callable[[Array, float], float] = held_force,
    needs_rate: bool = False,
) -> Equations:
    """Add a contact beside the cell at a place, which its channels do not read; `shape` also takes `least` [N]."""
    force = CellForce(
        equations.springs.index(where[0]),
        stack(parameters),
        partial(shape, least=LEAST_FORCE_SHARE * cell_at(geometry, where).full_range),
        read=False,
        held=held,
        has_kinks=True,
        needs_rate=needs_rate,
    )
    return equations.with_force(force)


def find_last_slip(d: Array, distance: float, is_periodic: bool, start: float = 0.0) -> tuple[NDArray[np.intp], Array]:
    """The last slip of the contact at each instant (n,), -1 before the first, and its direction (+-1, or 0).

    The play operator w_t = min(max(w_{t-1}, d_t - distance), d_t + distance) is a chain of clamps. It begins at w =
    `start`; periodic elongations are run through twice.
    """
    n = len(d)
    path = np.concatenate([d, d]) if is_periodic else d
    # While d goes in one direction, one side of the clamp binds, and more so at every instant: w follows at once from
    # its value at the turn before.
    turns = _turning_points(path)
    at_turns = _play_at_turns(path[turns], distance, start)
    w = np.repeat(at_turns, np.diff(turns, append=len(path)))
    w = np.clip(w, path - distance, path + distance)
    moved = np.diff(w, prepend=start)
    slips = np.flatnonzero(moved)
    # Each slip is the last one until the next; of the last n instants none belongs to those that are superseded before.
    instants = np.diff(np.maximum(slips, len(path) - n), append=len(path))
    before = n - int(instants.sum())
    last = np.concatenate([np.full(before, -1), np.repeat(slips % n, instants)])
    return last, np.concatenate([np.zeros(before), np.repeat(np.sign(moved[slips]), instants)])


def _turning_points(path: Array) -> NDArray[np.intp]:
    """Instants (m,) at which a path (n,) turns or rests, its first and its last one."""
    rises = np.sign(np.diff(path))
    turns = np.ones(len(path), bool)
    turns[1:-1] = rises[1:] * rises[:-1] <= 0.0
    return np.flatnonzero(turns)


def _play_at_turns(path: Array, distance: float, start: float) -> Array:
    """The play operator (m,) at the turns of a path (m,), by a prefix scan: a chain of clamps is a clamp."""
    low, high = path - distance, path + distance
    step = 1
    while step < len(path):
        before_low, before_high = low[:-step], high[:-step]
        after_low, after_high = low[step:], high[step:]
        if np.array_equal(after_low, after_high):
            break  # each of these clamps has a single value, whatever precedes it
        low, high = (
            np.concatenate([low[:step], np.minimum(np.maximum(before_low, after_low), after_high)]),
            np.concatenate([high[:step], np.minimum(np.maximum(before_high, after_low), after_high)]),
        )
        step *= 2
    return np.asarray(np.clip(start, low, high))
