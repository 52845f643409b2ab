"""`dry-friction`: a contact beside a cell sticks, and slips once its force exceeds a limit.

A spring kappa in series with a slider that transmits at most F (Jenkins' element), d being the cell's elongation:

    f = kappa (d - w),        w constant until |f| would exceed F, then following d: |d - w| <= F / kappa

The cell's channels do not read f. For F below 1e-5 of the cell's range the slip distance keeps its value at that force,
and f is proportional to F: so f has a derivative at F = 0, where kappa has no effect. There kappa stands only for the
slip distance, and a search scores a contact at several slip distances, from one that always slips to one that mostly
sticks.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Cell, Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, each_measured_cell
from balance_cli.model.effects.search_hints import SearchHints, Start
from balance_cli.model.mechanics.dual_numbers import Dual, stack
from balance_cli.model.mechanics.equations import CellForce, Equations

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


def _cell(geometry: Geometry, where: Where) -> Cell:
    return next(cell for cell in geometry.cells if cell.name == where[0])


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    cell = _cell(geometry, where)
    k = cell.effective_stiffness
    force, description = RELEVANT_FORCE_SHARE * cell.full_range, "Stiffness of the contact while it sticks."
    return (
        EffectParameter("force", "N", 0.0, force, "Force at which the contact slips.", lower=0.0, start=force),
        EffectParameter("stick_stiffness", "N/m", k, 0.1 * k, description, lower=1e-3 * k, start=k, nuisance=True),
    )


def _extra_starts(geometry: Geometry, where: Where) -> tuple[Start, ...]:
    k = _cell(geometry, where).effective_stiffness
    return tuple({"stick_stiffness": LEAST_FORCE_SHARE / slip * k} for slip in SLIP_DISTANCES)


def _start_from_score(geometry: Geometry, where: Where, start: Start, estimate: Start) -> Start:
    """The force that the score estimates, with the stiffness that gives the slip distance of the score."""
    cell = _cell(geometry, where)
    k = cell.effective_stiffness
    distance = LEAST_FORCE_SHARE * cell.full_range / start.get("stick_stiffness", k)
    lower, upper = (share * k for share in STIFFNESS_BOUNDS)
    return {"force": estimate["force"], "stick_stiffness": float(np.clip(estimate["force"] / distance, lower, upper))}


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    spring = equations.springs.index(where[0])
    shape = partial(_friction_force, least_force=LEAST_FORCE_SHARE * _cell(geometry, where).full_range)
    contact = stack([values["force"], values["stick_stiffness"]])
    return equations.with_force(CellForce(spring, contact, shape, read=False, held=_held_force, has_kinks=True))


def _friction_force(d: Dual, values: Dual, is_periodic: bool, least_force: float) -> Dual:
    """Force over the slipping force (n,): since it last slipped the contact has been a spring."""
    force, kappa = values[0], values[1]
    limit = force if force.value > least_force else Dual(np.array(least_force), np.zeros(force.parameters))
    stiffness = kappa * limit.reciprocal()
    last, direction = find_last_slip(d.value, float(1.0 / stiffness.value), is_periodic)
    since = Dual(d.value[last], d.derivative[:, last]) * (last >= 0)
    return (d - since) * stiffness + direction


def _held_force(values: Array, span: float) -> float:
    """The largest force that may be left: |d - w| <= F / kappa holds at both ends of the span."""
    return float(max(values[0] - 0.5 * values[1] * span, 0.0))


def find_last_slip(d: Array, distance: float, is_periodic: bool) -> tuple[NDArray[np.intp], Array]:
    """The last slip of the contact at each instant (n,), -1 before the first, and its direction (+-1, or 0).

    The play operator w_t = min(max(w_{t-1}, d_t - distance), d_t + distance) is a chain of clamps. It begins at w = 0;
    periodic elongations are run through twice.
    """
    n = len(d)
    path = np.concatenate([d, d]) if is_periodic else d
    # While d goes in one direction, one side of the clamp binds, and more so at every instant: w follows at once from
    # its value at the turn before.
    turns = _turning_points(path)
    at_turns = _play_at_turns(path[turns], distance)
    w = np.repeat(at_turns, np.diff(turns, append=len(path)))
    w = np.clip(w, path - distance, path + distance)
    moved = np.diff(w, prepend=0.0)
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


def _play_at_turns(path: Array, distance: float) -> Array:
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
    return np.asarray(np.clip(0.0, low, high))


EFFECT = Effect(
    name="dry-friction",
    summary="A contact beside a cell (a seal, a cable, a stop) sticks at small motions and slips at large ones.",
    validity="One contact with the same limit in both directions and at every speed; the rig was unloaded before each "
    "record.",
    reference="Iwan, J. Appl. Mech. 33 (1966) 893; Gaul and Nitsche, Appl. Mech. Rev. 54 (2001) 93.",
    signature="Static curves form loops: loading and unloading differ by twice the force. In sweeps at low level the "
    "stiffness is higher and the damping lower than at high level.",
    separated_by="Sweeps at a very low level, where the contact sticks, or a slow static loop. Structural damping "
    "does not depend on level.",
    place="a cell",
    places=each_measured_cell,
    parameters=_parameters,
    apply=_apply,
    needs_mean=True,
    search=SearchHints(extra_starts=_extra_starts, start_from_score=_start_from_score, inaccuracy=INACCURACY),
)
