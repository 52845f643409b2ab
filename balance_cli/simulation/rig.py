"""The true rig of a simulation: as declared, modified, or sampled from the tolerances."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from balance_cli.campaign.rig.channel_groups import channel_groups, expand_group
from balance_cli.campaign.rig.geometry import DeclaredEffect, Geometry
from balance_cli.io.errors import UserError
from balance_cli.simulation.extensions.base import Extension
from balance_cli.simulation.extensions.library import EXTENSIONS, extension, parameter_names

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrueRig:
    """A rig with known properties; everything else (names, places, axes, filters) is that of `geometry`.

    The metric side as a whole: `mass` [kg], `cg` (3,) [m] in rig axes, `inertia` (3, 3) [kg m2], the tensor about the
    center of gravity (products enter with a minus sign). `stiffness` (cells,) [N/m]; `damping_ratios` (freedoms,) in
    order of rising eigenfrequency of the plate; `sensitivities` (channels,) [V/N] or [V/(N m)]; of the
    torque meters `torque_stiffness` [N m/rad], `torque_inertia` [kg m2] and `torque_damping_ratio`, each (t,), with one
    unused value without a meter.
    `extensions` are the effects beyond the rigid plate, in the order in which they act.
    """

    geometry: Geometry
    mass: float
    cg: Array
    inertia: Array
    stiffness: Array
    damping_ratios: Array
    sensitivities: Array
    torque_stiffness: Array
    torque_inertia: Array
    torque_damping_ratio: Array
    extensions: tuple[Extension, ...] = ()

    def with_extensions(self, *extensions: Extension) -> TrueRig:
        """The rig with further effects."""
        return replace(self, extensions=(*self.extensions, *extensions))


def metric_side(geometry: Geometry) -> tuple[float, Array, Array]:
    """Mass [kg], center of gravity (3,) [m] and inertia tensor (3, 3) [kg m2] about it, of all bodies together.

    The parallel-axis theorem: `I = sum I_b + m_b (r'r 1 - r r')`, r from the common center of gravity.
    """
    masses = np.array([body.mass for body in geometry.bodies])
    positions = np.array([body.position for body in geometry.bodies], float)
    mass = float(masses.sum())
    cg = masses @ positions / mass
    arms = positions - cg
    inertia = sum((body.inertia.tensor() for body in geometry.bodies), np.zeros((3, 3)))
    inertia = (
        inertia + np.einsum("b,bi,bi->", masses, arms, arms) * np.eye(3) - np.einsum("b,bi,bj->ij", masses, arms, arms)
    )
    return mass, cg, inertia


def _fill(value: ArrayLike | None, default: Array, what: str) -> Array:
    if value is None:
        return default
    array = np.array(value, float)
    if array.ndim and array.shape != default.shape:
        raise UserError(f"{what} has shape {array.shape}, not {default.shape}", remedy="Give one value for each")
    return np.broadcast_to(array, default.shape).copy()


def true_rig(
    geometry: Geometry,
    *,
    mass: float | None = None,
    cg: ArrayLike | None = None,
    inertia: ArrayLike | None = None,
    stiffness: ArrayLike | None = None,
    damping_ratios: ArrayLike | None = None,
    sensitivities: ArrayLike | None = None,
    torque_stiffness: ArrayLike | None = None,
    torque_inertia: ArrayLike | None = None,
    torque_damping_ratio: ArrayLike | None = None,
    extensions: tuple[Extension, ...] = (),
) -> TrueRig:
    """The rig as declared, except where a value is given (units and shapes as in `TrueRig`; a scalar fills an array).

    The geometry's declared effects are not applied here (see `apply_effects`). Raises UserError for a wrong shape.
    """
    declared_mass, declared_cg, declared_inertia = metric_side(geometry)
    zeta = geometry.modal_damping_ratio
    k, j = np.array([(meter.stiffness, meter.inertia) for meter in geometry.shaft_meters] or [(1.0, 1.0)]).T
    return TrueRig(
        geometry,
        mass=declared_mass if mass is None else float(mass),
        cg=_fill(cg, declared_cg, "cg"),
        inertia=declared_inertia if inertia is None else _fill(inertia, declared_inertia, "inertia"),
        stiffness=_fill(stiffness, np.array([cell.effective_stiffness for cell in geometry.cells]), "stiffness"),
        damping_ratios=_fill(damping_ratios, np.full(len(geometry.freedom), zeta), "damping_ratios"),
        sensitivities=_fill(sensitivities, np.array([c.sensitivity for c in geometry.channels]), "sensitivities"),
        torque_stiffness=_fill(torque_stiffness, k, "torque_stiffness"),
        torque_inertia=_fill(torque_inertia, j, "torque_inertia"),
        torque_damping_ratio=_fill(torque_damping_ratio, np.full(len(k), zeta), "torque_damping_ratio"),
        extensions=extensions,
    )


def is_physical_inertia(inertia: Array) -> bool:
    """Whether a tensor (3, 3) can belong to a body: no principal moment above the sum of the two others."""
    principal = np.linalg.eigvalsh(inertia)
    return bool(principal[0] > 0 and principal[2] <= (principal[0] + principal[1]) * (1 + 1e-12))


def _is_physical(rig: TrueRig) -> bool:
    positive = (rig.mass, *rig.torque_stiffness, *rig.torque_inertia)
    damped = np.append(rig.damping_ratios, rig.torque_damping_ratio)
    return (
        min(positive) > 0
        and bool(np.all(rig.stiffness > 0))
        and bool(np.all(damped >= 0))
        and (rig.geometry.modal_damping_ratio == 0 or bool(np.all(damped > 0)))
        and bool(np.all(rig.sensitivities * [c.sensitivity for c in rig.geometry.channels] > 0))
        and is_physical_inertia(rig.inertia)
    )


def _draw_inertia(inertia: Array, tolerance: float, rng: np.random.Generator) -> Array:
    moments = np.sqrt(np.diag(inertia))
    noise = np.triu(rng.standard_normal((3, 3)))
    noise = noise + np.triu(noise, 1).T
    sample: Array = inertia + tolerance * np.outer(moments, moments) * noise
    return sample


def _draw_once(rig: TrueRig, rng: np.random.Generator) -> TrueRig:
    tol = rig.geometry.tolerances

    def vary(value: Array | float, tolerance: float) -> Array:
        return np.asarray(value) * (1 + tolerance * rng.standard_normal(np.shape(value)))

    return replace(
        rig,
        mass=float(vary(rig.mass, tol.mass)),
        cg=rig.cg + tol.centre_of_gravity * rng.standard_normal(3),
        inertia=_draw_inertia(rig.inertia, tol.inertia, rng),
        stiffness=vary(rig.stiffness, tol.stiffness),
        damping_ratios=vary(rig.damping_ratios, tol.damping_ratio),
        sensitivities=vary(rig.sensitivities, tol.sensitivity),
        torque_stiffness=vary(rig.torque_stiffness, tol.stiffness),
        torque_inertia=vary(rig.torque_inertia, tol.inertia),
        torque_damping_ratio=vary(rig.torque_damping_ratio, tol.damping_ratio),
    )


def draw_rig(geometry: Geometry, rng: np.random.Generator, attempts: int = 1000) -> TrueRig:
    """A rig sampled from the declared values with their independent Gaussian `tolerances`.

    Mass, center of gravity and inertia vary as those of the metric side as a whole; products of inertia get
    `tolerance * sqrt(Iii Ijj)`. A sample that is not physical (a stiffness or damping that is not positive, an
    impossible inertia) is drawn again. Raises UserError where the tolerances leave hardly any physical rig.
    """
    declared = true_rig(geometry)
    for _ in range(attempts):
        rig = _draw_once(declared, rng)
        if _is_physical(rig):
            return rig
    raise UserError(
        f"{attempts} draws gave no physical rig",
        place="tolerances",
        remedy="Declare smaller tolerances or other values",
    )


def apply_effects(rig: TrueRig, effects: Iterable[DeclaredEffect | Extension]) -> TrueRig:
    """The rig with these effects (declared ones or extensions), sorted into the order in which they act.

    Raises UserError for an unknown effect or parameter, and for an effect that is given twice at one place.
    """
    extensions = [
        item
        for effect in effects
        for item in ([effect] if isinstance(effect, Extension) else _declared_extensions(effect, rig.geometry))
    ]
    for index, item in enumerate(extensions):
        if _place(item) in map(_place, extensions[:index]):
            label = f"{item.name}@{','.join(item.where)}" if item.where else item.name
            raise UserError(f"`{label}` is given twice", place="effects", remedy="Remove one of them")
    order = list(EXTENSIONS)
    return rig.with_extensions(*sorted(extensions, key=lambda item: order.index(item.name)))


def _place(item: Extension) -> tuple[type[Extension], tuple[str, ...], tuple[str, ...]]:
    """What only one extension can have: its kind, its place and the words of its choices, as `beside`."""
    words = (getattr(item, name) for name in parameter_names(type(item)))
    return type(item), item.where, tuple(word for word in words if isinstance(word, str))


def _declared_extensions(effect: DeclaredEffect, geometry: Geometry) -> list[Extension]:
    """The extension of a declared effect, in all channels of a group, or one each where they have their own parameters.

    Their own parameters are named PARAMETER_CHANNEL.
    """
    members = channel_groups(geometry).get(effect.where[0], ()) if len(effect.where) == 1 else ()
    known = parameter_names(EXTENSIONS[effect.name]) if effect.name in EXTENSIONS else ()
    own = {
        channel: {name: effect.parameters[full] for name in known if (full := f"{name}_{channel}") in effect.parameters}
        for channel in members
    }
    if not any(own.values()):
        return [extension(effect.name, expand_group(effect.where, geometry), **effect.parameters)]
    return [extension(effect.name, (channel,), **values) for channel, values in own.items() if values]
