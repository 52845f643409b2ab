"""The load components of a balance: hub loads, or forces and moments at stations under the user's own names.

A run file has the six hub loads. Components are linear functions of them. In the force balance format of AIAA R-091
(N1 N2 Y1 Y2 A Rm) the forces along their lines of action, together with the moments, make up the hub loads: h = B'c. In
the moment balance format the components are moments about stations: c = A'h.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.independence import has_independent_columns
from balance_cli.campaign.rig.load_component import LoadComponent
from balance_cli.io.errors import UserError
from balance_cli.io.units import FORCE, MOMENT

Array = NDArray[np.float64]

COMPONENT_OF_FREEDOM = {"x": "Fx", "y": "Fy", "z": "Fz", "psi": "Mz", "theta": "My", "phi": "Mx"}
"""The load component that drives each motion by itself."""


@dataclass(frozen=True)
class LoadComponents:
    """Components c (k,) and their relation to the hub loads h (6,): c = h `from_hub` (6, k), h = c `to_hub` (k, 6)."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    from_hub: Array
    to_hub: Array

    @property
    def are_hub_loads(self) -> bool:
        """Whether the components are some of the hub loads, under their own names."""
        return set(self.names) <= set(COMPONENTS)

    def from_hub_loads(self, hub_loads: Array) -> Array:
        """Loads (m, k) of the components, for hub loads (m, 6)."""
        return np.asarray(hub_loads @ self.from_hub)

    def remaining_hub_loads(self, hub_loads: Array) -> Array:
        """Hub loads (m, o) that no component describes: those columns that vary."""
        rest = hub_loads - self.from_hub_loads(hub_loads) @ self.to_hub
        largest = np.max(np.abs(hub_loads), axis=0, initial=0.0)
        rest = np.where(np.abs(rest) > 1e-9 * max(float(largest.max()), np.finfo(float).tiny), rest, 0.0)
        return np.asarray(rest[:, np.ptp(rest, axis=0) > 0])


def load_components(geometry: Geometry) -> LoadComponents:
    """The components of a geometry: those declared, else the rated ones, else one for each motion of plate and shaft.

    A geometry without cells and without `components` and `rated_loads` carries all six.
    """
    if geometry.components is not None:
        return _declared_components(geometry, geometry.components)
    names = carried_components(geometry) if geometry.cells else (tuple(geometry.rated_loads or ()) or COMPONENTS)
    names = tuple(name for name in COMPONENTS if name in names)
    to_hub = np.eye(6)[[COMPONENTS.index(name) for name in names]]
    return LoadComponents(names, tuple(UNIT_OF[name] for name in names), to_hub.T, to_hub)


def moment_transfer(about: Sequence[float], to: Sequence[float]) -> Array:
    """Matrix (6, 6) from hub loads about one point [m] to those about another: M' = M + (about - to) x F."""
    x, y, z = np.asarray(about, float) - np.asarray(to, float)
    matrix = np.eye(6)
    matrix[3:, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    return matrix


@dataclass(frozen=True)
class FullScale:
    """The load (k,) [N, N m] that is 100 % of each component: rated where `is_rated` (k,), else calibrated."""

    values: Array
    is_rated: tuple[bool, ...]

    @property
    def meaning(self) -> str:
        """What 100 % stands for, in words."""
        if all(self.is_rated):
            return "rated load"
        return "rated load, or calibrated range where none is declared" if any(self.is_rated) else "calibrated range"


def full_scale(geometry: Geometry, components: Sequence[str], calibrated_range: Array) -> FullScale:
    """Full scale of these components: the rated loads that the geometry declares, else the calibrated range (k,)."""
    rated = geometry.rated_loads or {}
    values = [rated.get(name, float(size)) for name, size in zip(components, calibrated_range, strict=True)]
    return FullScale(np.array(values), tuple(name in rated for name in components))


def component_units(geometry: Geometry) -> dict[str, str]:
    """Unit (N or N m) of each component of a geometry, and of the hub loads."""
    components = load_components(geometry)
    return {**UNIT_OF, **dict(zip(components.names, components.units, strict=True))}


def carried_components(geometry: Geometry) -> tuple[str, ...]:
    """The hub loads that this rig can carry: one per motion of plate and shaft."""
    carried = {COMPONENT_OF_FREEDOM[name] for name in geometry.freedom}
    carried |= {meter.component for meter in geometry.shaft_meters}
    return tuple(name for name in COMPONENTS if name in carried)


def _declared_components(geometry: Geometry, declared: Sequence[LoadComponent]) -> LoadComponents:
    hub = np.asarray(geometry.hub, float)
    if any(_is_moment_at_station(component) for component in declared):
        from_hub = np.array([_reading_of_hub_loads(component, hub) for component in declared]).T
        to_hub = np.linalg.pinv(from_hub)
    else:
        to_hub = np.array([_wrench_about_hub(component, hub) for component in declared])
        from_hub = np.linalg.pinv(to_hub)
    units = tuple(_component_unit(component) for component in declared)
    return LoadComponents(tuple(component.name for component in declared), units, _clean(from_hub), _clean(to_hub))


def _clean(matrix: Array) -> Array:
    """Set rounding errors of the pseudo-inverse to zero, so that columns of zeros stay exact zeros."""
    return np.where(np.abs(matrix) < 1e-12 * np.max(np.abs(matrix)), 0.0, matrix)


def _component_unit(component: LoadComponent) -> str:
    if component.name in UNIT_OF:
        return UNIT_OF[component.name]
    return FORCE if component.direction is not None else MOMENT


def _is_moment_at_station(component: LoadComponent) -> bool:
    return component.moment is not None and component.position is not None


def _wrench_about_hub(component: LoadComponent, hub: Array) -> Array:
    """Hub loads (6,) of a unit of the component."""
    if component.name in COMPONENTS:
        return np.asarray(np.eye(6)[COMPONENTS.index(component.name)])
    axis = np.asarray(component.direction or component.moment, float)
    axis = axis / np.linalg.norm(axis)
    if component.moment is not None:
        return np.asarray(np.r_[np.zeros(3), axis])
    arm = np.zeros(3) if component.position is None else np.asarray(component.position, float) - hub
    return np.asarray(np.r_[axis, np.cross(arm, axis)])


def _reading_of_hub_loads(component: LoadComponent, hub: Array) -> Array:
    """Weights (6,) of the hub loads in the component: M_p = M + (hub - p) x F."""
    if not _is_moment_at_station(component):
        return _wrench_about_hub(component, hub)
    axis = np.asarray(component.moment, float)
    axis = axis / np.linalg.norm(axis)
    return np.asarray(np.r_[np.cross(axis, hub - np.asarray(component.position, float)), axis])


def component_faults(geometry: Geometry) -> Iterator[UserError]:
    """Faults of `components` and `rated_loads`: names, dependence, and stations of both kinds."""
    declared = geometry.components
    if declared is not None:
        names = [component.name for component in declared]
        for index, name in enumerate(names):
            if name in names[:index]:
                fault = f"name `{name}` is already that of components[{names.index(name)}]"
                yield UserError(fault, place=f"components[{index}]", remedy="Names must differ")
        yield from _dependence_faults(geometry, declared)
    known = load_components(geometry).names
    for name in geometry.rated_loads or ():
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            remedy = f"Did you mean `{near[0]}`?" if near else f"The components are {', '.join(known)}"
            yield UserError(f"`{name}` is not a component", place=f"rated_loads.{name}", remedy=remedy)


def _dependence_faults(geometry: Geometry, declared: Sequence[LoadComponent]) -> Iterator[UserError]:
    stations = [component for component in declared if component.position is not None]
    if any(component.moment for component in stations) and any(component.direction for component in stations):
        fault = "forces and moments at stations are mixed"
        yield UserError(fault, place="components", remedy="Give `position` to forces or to moments, not to both")
        return
    if len(declared) > len(COMPONENTS):
        fault = f"has {len(declared)} entries, which cannot be independent"
        yield UserError(fault, place="components", remedy="Declare one to six components")
        return
    to_hub = load_components(geometry).to_hub
    arms = np.abs(to_hub[:, 3:]).max()
    scaled = to_hub / np.r_[np.ones(3), np.full(3, arms if arms > 0 else 1.0)]
    if not has_independent_columns(scaled.T):
        fault = "depend on each other: one is a combination of the others"
        yield UserError(fault, place="components", remedy="Check `direction`, `moment` and `position`")
