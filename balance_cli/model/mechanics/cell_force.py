"""Forces along the springs of a balance that are nonlinear in the motion which the channels measure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.mechanics.dual_numbers import Dual, constant

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CellMotion:
    """The motion of a spring through time: its `elongation` (n,) [m] and the `rate` (n,) [m/s] of that.

    `is_periodic`: the n elongations repeat; otherwise the spring was unloaded before the first.
    """

    elongation: Dual
    rate: Dual
    is_periodic: bool

    @classmethod
    def at_rest(cls, elongation: Dual, is_periodic: bool) -> CellMotion:
        """A motion so slow that it has no rate."""
        rate = constant(np.zeros_like(elongation.value), elongation.parameters)
        return cls(elongation, rate, is_periodic)


@dataclass(frozen=True)
class CellForce:
    """A force along a spring, f = strength * shape, that is nonlinear in the motion of the spring.

    `values` (q,): the strength, zero where there is no such force, then the parameters of the shape. `shape` takes
    the motion over time (n,) and the values. `read`: the force acts inside the cell, whose channels read it; beside
    the cell they do not.
    `held`, of a force with a memory: the largest size [N] that it may keep at rest, by the values (q,) and by the
    distance [m] through which d has moved since nobody knew it; None of forces that the present motion determines.
    `has_kinks`: its slope jumps, so that its spectrum is wide. `needs_rate`: it depends on the rate of elongation, and
    acts beside the cell.
    """

    spring: int
    values: Dual
    shape: Callable[[CellMotion, Dual], Dual]
    read: bool
    held: Callable[[Array, float], float] | None = None
    has_kinks: bool = False
    needs_rate: bool = False

    def along(self, motion: CellMotion, values: Dual) -> Dual:
        """The force (n,) [N] along the spring, by its values with the derivatives that are asked for."""
        force: Dual = values[0] * self.shape(motion, values)
        return force
