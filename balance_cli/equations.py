"""The equations of a balance while they are being put together: what effects receive and return.

    M q'' + (D + Omega G) q' + (E' diag(k (1 + j eta)) E + K_extra) q = F u,        force of spring i: k_i E_i q

One row of E per spring: the cells in their declared order, then the torque meter, then whatever effects add. Every
matrix is a jet, so derivatives with respect to all parameters go along.

A flexible part is regular where it does nothing only if its compliance, not its stiffness, is the parameter. Its
equations are then multiplied by the compliance (`row_factor`), and its spring is a one on the diagonal
(`own_stiffness`): c (m q'' + d q' + ...) + q = c F u, which for c = 0 says q = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.jets import Jet, block_diagonal, concatenate, constant
from balance_cli.kinematics import motion_at

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
    gain: Jet
    low_pass: tuple[Jet, ...] = ()
    high_pass: tuple[Jet, ...] = ()
    delay: Jet | None = None


@dataclass(frozen=True)
class Equations:
    """Mechanics and channels of a balance with derivatives; n coordinates, e springs, c channels.

    mass, damping, gyroscopic (per rad/s of spin), extra_stiffness (n, n); elongation (e, n); stiffness, loss (e,);
    inputs (n, 6); spill (6, 6) takes measured exciter loads to true ones; mixing (c, c) acts on the channels' volts.
    centre (3,) [m] is the centre of gravity of the moving part, `freedom` which of its six motions the first
    coordinates are; row_factor and own_stiffness (n,) are one and zero but for flexible parts.
    """

    coordinates: tuple[str, ...]
    springs: tuple[str, ...]
    mass: Jet
    damping: Jet
    gyroscopic: Jet
    extra_stiffness: Jet
    elongation: Jet
    stiffness: Jet
    loss: Jet
    inputs: Jet
    paths: tuple[ChannelPath, ...]
    spill: Jet
    mixing: Jet
    centre: Jet
    freedom: tuple[int, ...]
    row_factor: Jet
    own_stiffness: Array

    @property
    def parameters(self) -> int:
        """Number of parameters that the jets refer to."""
        return self.mass.parameters

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels in order."""
        return tuple(path.channel for path in self.paths)

    def motion(self, point: Jet | Array) -> Jet:
        """Motion (3, n) of a point (3,) [m] of the moving part, rig axes, per unit of each coordinate."""
        arm = point - self.centre
        free = list(self.freedom)
        still = motion_at(np.zeros(3))[:, free]
        rows = constant(still, self.parameters)
        for k, unit in enumerate(np.eye(3)):
            rows = rows + arm[k] * (motion_at(unit)[:, free] - still)
        others = constant(np.zeros((3, len(self.coordinates) - len(free))), self.parameters)
        return concatenate([rows, others], axis=1)

    def with_coordinates(
        self, names: tuple[str, ...], mass: Jet, damping: Jet, inputs: Jet, compliance: Jet
    ) -> Equations:
        """Further flexible coordinates: mass and damping (m, m), inputs (m, 6), compliance (m,) of their springs.

        They are not yet coupled to the others.
        """
        added, p = len(names), self.parameters
        nothing = constant(np.zeros((added, added)), p)
        return replace(
            self,
            coordinates=self.coordinates + names,
            mass=block_diagonal(self.mass, mass),
            damping=block_diagonal(self.damping, damping),
            gyroscopic=block_diagonal(self.gyroscopic, nothing),
            extra_stiffness=block_diagonal(self.extra_stiffness, nothing),
            elongation=concatenate([self.elongation, constant(np.zeros((len(self.springs), added)), p)], axis=1),
            inputs=concatenate([self.inputs, inputs]),
            row_factor=concatenate([self.row_factor, compliance]),
            own_stiffness=np.concatenate([self.own_stiffness, np.ones(added)]),
        )

    def with_springs(self, names: tuple[str, ...], elongation: Jet, stiffness: Jet) -> Equations:
        """Further springs: elongation rows (m, n) and stiffness (m,)."""
        return replace(
            self,
            springs=self.springs + names,
            elongation=concatenate([self.elongation, elongation]),
            stiffness=concatenate([self.stiffness, stiffness]),
            loss=concatenate([self.loss, constant(np.zeros(len(names)), self.parameters)]),
        )
