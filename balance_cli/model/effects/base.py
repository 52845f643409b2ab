"""What an effect is: one physical thing that the rigid balance lacks, whole in one file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import FREEDOMS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.kinematics import motion_at
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations

Where = tuple[str, ...]
Start = Mapping[str, float]
Array = NDArray[np.float64]

ALL = "all"
"""The place of an effect that is the same in every cell."""


@dataclass(frozen=True)
class EffectParameter:
    """One parameter: unit, the value at which it does nothing, bounds, the size of a change that matters, a sentence.

    `start` is where a fit begins when the null itself is singular for other parameters (a mass without compliance
    does nothing). A `nuisance` parameter does nothing by itself: it shapes what the others do once they have left
    their nulls, so that at the null the equations do not depend on it; its own null is where it is left then.

    A `reciprocal` parameter has an infinite null (the cutoff of a low-pass). What is fitted, and what the effect is
    given, is one over it, under the name `1/NAME`; `scale` and `start` are those of the reciprocal. Of a `squared`
    parameter the data tell the square alone: that is fitted, as `NAME^2`; `scale` is that of the parameter itself.
    """

    name: str
    unit: str
    null: float
    scale: float
    description: str
    lower: float = -np.inf
    upper: float = np.inf
    start: float | None = None
    nuisance: bool = False
    reciprocal: bool = False
    squared: bool = False

    @property
    def fitted_name(self) -> str:
        """The name under which the parameter is fitted."""
        return f"{self.name}^2" if self.squared else f"1/{self.name}" if self.reciprocal else self.name

    @property
    def fitted_unit(self) -> str:
        """The unit of what is fitted."""
        return f"{self.unit}2" if self.squared else f"1/{self.unit}" if self.reciprocal else self.unit

    @property
    def fitted_null(self) -> float:
        """The null of what is fitted."""
        return float(self.fitted_value(self.null))

    @property
    def fitted_start(self) -> float:
        """Where a fit begins."""
        return self.fitted_null if self.start is None else self.start

    @property
    def fitted_bounds(self) -> tuple[float, float]:
        """Bounds of what is fitted, the lower one first."""
        bounds = (self.fitted_value(self.lower), self.fitted_value(self.upper))
        return (min(bounds), max(bounds))

    def fitted_value(self, value: float) -> float:
        """What is fitted, from the value."""
        if self.squared:
            return value**2
        if not self.reciprocal:
            return value
        return np.inf if value == 0 else 1.0 / value

    def physical_value(self, fitted_value: float) -> float:
        """The value, from what is fitted."""
        return float(np.sqrt(max(fitted_value, 0.0))) if self.squared else self.fitted_value(fitted_value)

    def physical_sigma(self, fitted_value: float, sigma: float) -> float:
        """Standard deviation of the value where that of what is fitted is `sigma`."""
        if self.squared:
            return sigma / (2.0 * float(np.sqrt(max(fitted_value, 0.5 * sigma)))) if sigma > 0 else 0.0
        if not self.reciprocal:
            return sigma
        return np.inf if fitted_value == 0 else sigma / fitted_value**2

    @property
    def fitted_scale(self) -> float:
        """The size of a change of what is fitted that matters."""
        return self.scale**2 if self.squared else self.scale


@dataclass(frozen=True)
class Choice:
    """A parameter that is one of a few words, the first unless another is declared."""

    name: str
    words: tuple[str, ...]
    description: str


@dataclass(frozen=True)
class Effect:
    """An effect: what it is, where it holds, where it was published, and what it adds to the equations.

    `place` says in words what a place of it is; `places(geometry)` are all places that it can have;
    `parameters(geometry, where)` its parameters there; `apply(equations, geometry, where, values)` adds it, `values`
    being the parameters as jets by name. At the null of every parameter the equations are left as they are. `trace`
    says what it leaves in a residual, `separated_by` which measurement tells it from what looks alike. What it adds is
    written as formulas at the head of its file.

    For a search: `search_places(geometry)` are the places worth trying where not all are (a large place, that is made
    smaller afterwards); `starts(geometry, where)` fitted values to begin from, several where one start may lead into a
    wrong minimum; `once`: a rig has it once at most; `empirical`: it describes and does not explain. Where what shapes
    an effect counts as much as its size, `scanned(geometry, where)` are further starts at whose nulls a search scores
    it, and `sized(geometry, where, start, own)` the values from which a fit then begins, `own` being what the score
    makes of the parameters that do something by themselves. `inaccuracy`: the shares of its own signature to which the
    measured motion tells it, where it is large, in periodic records and in others; what is smaller beside it is not
    believed.

    Where there is a `choice`, every word of it makes a place of its own: the word is the last name of `where`.
    `needs_mean`: it shows, among other things, in the mean of a record and in static rows that are not straight, or
    through channels as functions of time. `needs_spin`: it shows with the rotor turning alone.
    """

    name: str
    summary: str
    validity: str
    reference: str
    signature: str
    separated_by: str
    place: str
    places: Callable[[Geometry], tuple[Where, ...]]
    parameters: Callable[[Geometry, Where], tuple[EffectParameter, ...]]
    apply: Callable[[Equations, Geometry, Where, Mapping[str, Dual]], Equations]
    search_places: Callable[[Geometry], tuple[Where, ...]] | None = None
    starts: Callable[[Geometry, Where], tuple[Start, ...]] | None = None
    extra_starts: Callable[[Geometry, Where], tuple[Start, ...]] | None = None
    start_from_score: Callable[[Geometry, Where, Start, Start], Start] | None = None
    inaccuracy: tuple[float, float] = (0.0, 0.0)
    at_most_once: bool = False
    needs_spin: bool = False
    empirical: bool = False
    choice: Choice | None = None
    needs_mean: bool = False


def each_cell(geometry: Geometry) -> tuple[Where, ...]:
    """One place a cell."""
    return tuple((cell.name,) for cell in geometry.cells)


def each_cell_or_all(geometry: Geometry) -> tuple[Where, ...]:
    """All cells alike, or one of them."""
    return ((ALL,), *each_cell(geometry))


def cells_at(geometry: Geometry, where: Where) -> list[int]:
    """Indices of the cells at a place, which is the name of one or `all`."""
    return [i for i, cell in enumerate(geometry.cells) if where == (ALL,) or cell.name in where]


INSIDE, BESIDE = "inside", "beside"
SIDE = Choice("side", (INSIDE, BESIDE), "`inside` the cell, whose channels read the force too, or `beside` it.")


def each_cell_and_side(geometry: Geometry) -> tuple[Where, ...]:
    """Each cell, inside and beside it."""
    return tuple((cell.name, side) for cell in geometry.cells for side in SIDE.words)


def each_channel(geometry: Geometry) -> tuple[Where, ...]:
    """One place a channel."""
    return tuple((channel.name,) for channel in geometry.channels)


def whole_rig(_: Geometry) -> tuple[Where, ...]:
    """The one place of an effect of the whole rig."""
    return ((),)


def nonempty_subsets(names: tuple[str, ...]) -> tuple[Where, ...]:
    """Every choice of at least one of `names`, the small ones first, each in the order of `names`."""
    chosen = [tuple(name for i, name in enumerate(names) if bits >> i & 1) for bits in range(1, 2 ** len(names))]
    return tuple(sorted(chosen, key=lambda where: (len(where), [names.index(name) for name in where])))


def ordered_pairs(names: tuple[str, ...]) -> tuple[Where, ...]:
    """Every two different names, in both orders."""
    return tuple((one, other) for one in names for other in names if one != other)


def transverse_axes(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors (3,) across a unit `axis`, in right-handed order; for a cell along x they are y and z.

    The first is the rig axis that follows, in cyclic order, the one nearest to the cell's, less its part along the
    cell.
    """
    following = np.eye(3)[(int(np.argmax(np.abs(axis))) + 1) % 3]
    across = following - (following @ axis) * axis
    first = across / np.linalg.norm(across)
    return first, np.cross(axis, first)


def stiffness_by_motion(geometry: Geometry) -> dict[str, float]:
    """What the cells oppose to each motion x y z [N/m] psi theta phi [N m/rad] of the plate about the origin."""
    rows = np.array([cell.direction @ motion_at(np.array(cell.position)) for cell in geometry.cells])
    diagonal = np.array([cell.effective_stiffness for cell in geometry.cells]) @ rows**2
    return dict(zip(FREEDOMS, diagonal.tolist(), strict=True))


def inertia_by_motion(geometry: Geometry) -> dict[str, float]:
    """Mass [kg] for x y z and moment of inertia [kg m2] about the origin for psi theta phi, of all bodies together."""
    inertia = np.zeros((3, 3))
    for body in geometry.bodies:
        r = np.array(body.position)
        inertia += body.inertia.tensor() + body.mass * (r @ r * np.eye(3) - np.outer(r, r))
    mass = sum(body.mass for body in geometry.bodies)
    return dict(zip(FREEDOMS, (mass, mass, mass, *np.diag(inertia)[::-1].tolist()), strict=True))


def position_bound(geometry: Geometry) -> float:
    """Twice the distance [m] from the origin of what lies farthest from it: nothing that matters lies beyond."""
    points = [geometry.hub, *(cell.position for cell in geometry.cells), *(body.position for body in geometry.bodies)]
    return 2.0 * float(np.linalg.norm(np.array(points), axis=1).max()) or np.inf


def clip_below(dual: Dual, floor: float | Array) -> Dual:
    """The jet, and `floor` without slope wherever it is less: keeps square roots and reciprocals regular at zero."""
    above = dual.value > floor
    return Dual(np.maximum(dual.value, floor), dual.derivative * above)
