"""The equations of a balance while they are being put together: what effects receive and return.

    M q'' + (D + Omega G) q' + (E' diag(k (1 + j eta)) E + K_extra) q = F u,        force of spring i: k_i E_i q

One row of E per spring that a channel can read: the cells in their declared order, then the torque meter. Every matrix
is a jet, so derivatives with respect to all parameters go along.

The cells stand on a lower body. Its motion is `base`, zero where it is rigid; cells are elongated by the motion of the
plate relative to it.

A flexible part is regular where it does nothing only if its compliance, not its stiffness, is the parameter. Its
equations are then multiplied by the compliance (`row_factor`), and its spring is a one on the diagonal
(`own_stiffness`): c (m q'' + d q' + ...) + q = c F u, which for c = 0 says q = 0.

A force along a spring that is not linear in its elongation d = E q is an input like a load, -E' f(d), for d is known:
the spring's channels measure it (`CellForce`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.kinematics import MOTION_AT_CENTER, MOTION_PER_ARM, motion_at
from balance_cli.model.mechanics.dual_numbers import Dual, block_diagonal, concatenate, constant

Array = NDArray[np.float64]

SHAFT = "shaft"
TORQUE = "torque"


@dataclass(frozen=True)
class ChannelPath:
    """From a spring's force to volts: gain [V/N, V/(N m)], first-order low- and high-passes, pure delay.

    `low_pass` are time constants tau [s]: 1/(1 + j omega tau); `high_pass` are rates r [1/s]: 1/(1 + r/(j omega)).
    In this form each is regular where it does nothing (0). `delay` [s], positive is late.
    """

    channel: str
    spring: int
    gain: Dual
    low_pass: tuple[Dual, ...] = ()
    high_pass: tuple[Dual, ...] = ()
    delay: Dual | None = None


@dataclass(frozen=True)
class CellForce:
    """A force along a spring, f = strength * shape(d), that is not linear in the elongation d [m].

    `values` (q,): the strength, which is zero where there is no such force, then what the shape depends on. `shape`
    takes d (n,) through time, the values and whether the n elongations recur for ever (if not, the spring was unloaded
    before the first). `read`: the force acts inside the cell, whose channels read it; beside it they do not.
    """

    spring: int
    values: Dual
    shape: Callable[[Dual, Dual, bool], Dual]
    read: bool


@dataclass(frozen=True)
class InterferenceTone:
    """A tone in one channel (its index): square of its amplitude [V2], its frequency [Hz]; any phase in each run."""

    channel: int
    power: Dual
    frequency: Dual


@dataclass(frozen=True)
class Equations:
    """Mechanics and channels of a balance with derivatives; n coordinates, e springs, c channels.

    mass, damping, gyroscopic (per rad/s of spin), extra_stiffness (n, n); elongation (e, n); stiffness (e,) of the
    springs, their loss factor and stiffening (e,), a share for each factor e of frequency; extra_readings (e, n) are
    forces that the channels of a spring read besides its own; inputs (n, 6); spill (6, 6) takes measured exciter loads
    to true ones; mixing (c, c) acts on the channels' volts. centre (3,) [m] is that of gravity of the moving part,
    `freedom` which of its six motions the first coordinates are; base (6, n) is the motion x y z psi theta phi of the
    lower body at the rig's origin; row_factor and own_stiffness (n,) are one and zero but for flexible parts. `forces`
    act along springs, `pickups` are in channels; channel_offset (c,) [V] and load_offset (6,) [N, N m] are what the
    channels and the exciters' force cells read too much.
    """

    coordinates: tuple[str, ...]
    springs: tuple[str, ...]
    mass: Dual
    damping: Dual
    gyroscopic: Dual
    extra_stiffness: Dual
    elongation: Dual
    stiffness: Dual
    loss: Dual
    frequency_stiffness: Dual
    extra_readings: Dual
    inputs: Dual
    paths: tuple[ChannelPath, ...]
    exciter_cross_axis: Dual
    mixing: Dual
    center: Dual
    freedom: tuple[int, ...]
    base: Dual
    row_factor: Dual
    own_stiffness: Array
    channel_offset: Dual
    load_offset: Dual
    forces: tuple[CellForce, ...] = ()
    interference_tones: tuple[InterferenceTone, ...] = ()

    @property
    def parameters(self) -> int:
        """Number of parameters that the jets refer to."""
        return self.mass.parameters

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels in order."""
        return tuple(path.channel for path in self.paths)

    def motion(self, point: Dual | Array) -> Dual:
        """Motion (..., 3, n) of points (..., 3) [m] of the moving part, rig axes, per unit of each coordinate."""
        rows = dual_motion_at(point - self.center)[..., list(self.freedom)]
        others = len(self.coordinates) - len(self.freedom)
        return concatenate([rows, constant(np.zeros((*rows.value.shape[:-1], others)), self.parameters)], axis=-1)

    def relative_motion(self, point: Array) -> Dual:
        """Motion (..., 3, n) of points (..., 3) [m] of the moving part against the lower body."""
        return self.motion(point) - motion_at(point) @ self.base

    def with_coordinates(
        self, names: tuple[str, ...], mass: Dual, damping: Dual, inputs: Dual, compliance: Dual
    ) -> Equations:
        """Further flexible coordinates: mass and damping (m, m), inputs (m, 6), compliance (m,) of their springs.

        They are not yet coupled to the others.
        """
        added, p = len(names), self.parameters
        nothing = constant(np.zeros((added, added)), p)
        unread = constant(np.zeros((len(self.springs), added)), p)
        return replace(
            self,
            coordinates=self.coordinates + names,
            mass=block_diagonal(self.mass, mass),
            damping=block_diagonal(self.damping, damping),
            gyroscopic=block_diagonal(self.gyroscopic, nothing),
            extra_stiffness=block_diagonal(self.extra_stiffness, nothing),
            elongation=concatenate([self.elongation, unread], axis=1),
            extra_readings=concatenate([self.extra_readings, unread], axis=1),
            inputs=concatenate([self.inputs, inputs]),
            base=concatenate([self.base, constant(np.zeros((6, added)), p)], axis=1),
            row_factor=concatenate([self.row_factor, compliance]),
            own_stiffness=np.concatenate([self.own_stiffness, np.ones(added)]),
        )

    def with_force(self, force: CellForce) -> Equations:
        """A further force along a spring."""
        return replace(self, forces=(*self.forces, force))

    def with_springs(self, motion: Dual, stiffness: Dual) -> Equations:
        """Springs that no channel reads: elongation (m, n) per coordinate and stiffness (m,)."""
        return replace(self, extra_stiffness=self.extra_stiffness + motion.T @ (stiffness.insert_axis(-1) * motion))


def dual_motion_at(arm: Dual) -> Dual:
    """Motion (..., 3, 6) of points at `arm` (..., 3) [m] from the centre of gravity, per unit q; linear in the arm."""
    return arm.dot(MOTION_PER_ARM) + MOTION_AT_CENTER
