"""The equations of a balance while they are assembled: what effects receive and return.

    M q'' + (D + Omega G) q' + (E' diag(k (1 + j eta)) E + K_extra) q = F u,        force of spring i: k_i E_i q

E has one row per spring that a channel can read: the cells in their declared order, then the torque meter. Channels
that sum the forces of several cells, and accelerometers, read springs of their own, without stiffness: their readings
follow from the forces of the others (`SpringSum`) or from the motion of a point (`PointMotion`). All matrices are dual
numbers and carry the derivatives with respect to all parameters.

The cells stand on the non-metric side. Its motion is `non_metric_motion`, zero where it is rigid; cells are elongated
by the motion of the plate relative to it.

A flexible part is regular where it does nothing only if its compliance, not its stiffness, is the parameter. Its
equations are therefore multiplied by the compliance (`row_factor`), and its spring is a one on the diagonal
(`own_stiffness`): c (m q'' + d q' + ...) + q = c F u, which for c = 0 reads q = 0.

A force along a spring that is nonlinear in its elongation d = E q or in the rate of it enters as an input like a load,
-E' f(d, d'), because both are known: the spring's channels measure d (`CellForce`). In the same way a channel that is
nonlinear tells by its own reading what it adds to that of a linear one (`ChannelDistortion`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.kinematics import MOTION_AT_CENTER, MOTION_PER_ARM, motion_at
from balance_cli.model.mechanics.cell_force import CellForce
from balance_cli.model.mechanics.dual_numbers import Dual, block_diagonal, concatenate, constant, stack

Array = NDArray[np.float64]

SHAFT = "shaft"
TORQUE = "torque"


@dataclass(frozen=True)
class ChannelPath:
    """The path from a spring's force to volts: gain [V/N, V/(N m)], first-order low- and high-passes, pure delay.

    `low_pass` are time constants tau [s]: 1/(1 + j omega tau); `high_pass` are rates r [1/s]: 1/(1 + r/(j omega)).
    `lead` are times tau [s] of viscous forces that are read with the spring's: 1 + j omega tau.
    In this form each is regular where it does nothing (0). `delay` is in s, positive if the channel is late.
    `differentiations` of the reading come first: two for an accelerometer, whose spring reads the motion of a point.
    """

    channel: str
    spring: int
    gain: Dual
    low_pass: tuple[Dual, ...] = ()
    high_pass: tuple[Dual, ...] = ()
    lead: tuple[Dual, ...] = ()
    delay: Dual | None = None
    differentiations: int = 0

    @property
    def dual_numbers(self) -> tuple[Dual, ...]:
        """All numbers of the path that may depend on a parameter."""
        delay = () if self.delay is None else (self.delay,)
        return (self.gain, *self.low_pass, *self.high_pass, *self.lead, *delay)


@dataclass(frozen=True)
class SpringSum:
    """A spring that reads the sum of the forces of others, each times its weight (by index); it exerts none itself."""

    spring: int
    weights: Mapping[int, float]


@dataclass(frozen=True)
class PointMotion:
    """A spring that reads the motion [m] of a point at `position` (3,) [m] along `direction` (3,); it exerts no force.

    The point belongs to the metric side, or to the non-metric one.
    """

    spring: int
    position: Array
    direction: Array
    on_metric_side: bool


@dataclass(frozen=True)
class ChannelDistortion:
    """What a channel (its index) reads beyond a linear one, as a function of its reading v [V]: strength * shape(v).

    `values` (q,): the strength, zero where the channel is linear, then the parameters of the shape.
    """

    channel: int
    values: Dual
    shape: Callable[[Array, Dual], Dual]


@dataclass(frozen=True)
class Crosstalk:
    """The `fraction` of the volts of channel `source` (its index) that is added to those of channel `to`."""

    to: int
    source: int
    fraction: Dual


@dataclass(frozen=True)
class InterferenceTone:
    """A tone in one channel (its index): amplitude squared [V2] and frequency [Hz]; its phase differs in each run."""

    channel: int
    power: Dual
    frequency: Dual


@dataclass(frozen=True)
class Equations:
    """Mechanics and channels of a balance with derivatives; n coordinates, e springs, c channels.

    - `mass`, `damping`, `gyroscopic` (per rad/s of spin), `extra_stiffness` (n, n); `inputs` (n, 6) per unit hub load.
    - `elongation` (e, n) and `stiffness` (e,) of the springs, their loss factor `loss` (e,), and `frequency_stiffness`
      (e,): the relative increase of stiffness for each factor e of frequency, zero at `reference_frequency` [Hz].
    - `extra_readings` (e, n): forces that the channels of a spring read in addition to its own.
    - `exciter_cross_axis` (6, 6) transforms the loads that exciters apply, as measured, to true ones, and
      `weight_cross_axis` (6, 6) those of static runs.
    - The exciters' force cells read `load_gain` (6,) times their loads, late by `load_delay` (6,) [s]; the loads follow
      what is recorded by the terms `load_lag` (6, 2) [s, s2] of s and s^2 in a denominator; while an
      exciter is attached, its row of `exciter_mass` (6, 6) [kg, kg m2] moves with the hub along the six components,
      and its row of `exciter_stiffness` (6, 6) [N/m, N m/rad] holds the hub (see `model.exciter_loads`).
    - `center` (3,) [m]: center of gravity of the metric side; `freedom`: the motions of it that the first coordinates
      are; `non_metric_motion` (6, n): motion x y z psi theta phi of the non-metric side at the rig's origin.
    - `row_factor` and `own_stiffness` (n,): one and zero except for flexible parts.
    - `forces` act along springs, `distortions`, `crosstalk` and `interference_tones` in channels; `channel_offset` (c,)
      [V] and `load_offset` (6,) [N, N m] are added to the readings of the channels and of the exciters' force cells.
    - `sums` and `point_motions` are the springs without stiffness.
    - `plate_damping`: the damping of the plate by its damping ratios for a mass matrix of its motions, both (f, f).
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
    reference_frequency: float
    extra_readings: Dual
    inputs: Dual
    paths: tuple[ChannelPath, ...]
    exciter_cross_axis: Dual
    weight_cross_axis: Dual
    load_gain: Dual
    load_delay: Dual
    load_lag: Dual
    exciter_mass: Dual
    exciter_stiffness: Dual
    center: Dual
    freedom: tuple[int, ...]
    non_metric_motion: Dual
    row_factor: Dual
    own_stiffness: Array
    channel_offset: Dual
    load_offset: Dual
    forces: tuple[CellForce, ...] = ()
    distortions: tuple[ChannelDistortion, ...] = ()
    crosstalk: tuple[Crosstalk, ...] = ()
    interference_tones: tuple[InterferenceTone, ...] = ()
    sums: tuple[SpringSum, ...] = ()
    point_motions: tuple[PointMotion, ...] = ()
    plate_damping: Callable[[Dual], Dual] | None = None

    @property
    def parameters(self) -> int:
        """Number of parameters that the derivatives refer to."""
        return self.mass.parameters

    @property
    def nonlinear_terms(self) -> int:
        """Number of forces and distortions, which are not linear in the motion."""
        return len(self.forces) + len(self.distortions)

    @property
    def has_nonlinear_terms(self) -> bool:
        """Whether the strength of any of them differs from zero."""
        terms: list[CellForce | ChannelDistortion] = [*self.forces, *self.distortions]
        return any(term.values.value[0] != 0.0 for term in terms)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels in order."""
        return tuple(path.channel for path in self.paths)

    @cached_property
    def mixing(self) -> Dual:
        """The matrix (c, c) that acts on the channels' volts: one, with the crosstalk beside its diagonal."""
        c = len(self.paths)
        value, derivative = np.eye(c), np.zeros((self.parameters, c, c))
        for item in self.crosstalk:
            value[item.to, item.source] += item.fraction.value
            derivative[:, item.to, item.source] += item.fraction.derivative
        return Dual(value, derivative)

    def cross_axis(self, is_static: bool) -> Dual:
        """The matrix (6, 6) from recorded loads to true ones, of static runs or of those with exciters."""
        return self.weight_cross_axis if is_static else self.exciter_cross_axis

    @property
    def summation(self) -> Array:
        """The matrix (e, e) from the springs' own forces to what their channels read: rows of sums have weights."""
        matrix = np.eye(len(self.springs))
        for item in self.sums:
            matrix[item.spring, list(item.weights)] = list(item.weights.values())
        return matrix

    def motion_readings(self) -> Dual:
        """Rows (e, n) of the motions that springs read, zero where a spring reads a force."""
        rows = [constant(np.zeros(len(self.coordinates)), self.parameters)] * len(self.springs)
        for item in self.point_motions:
            on_ground = motion_at(item.position) @ self.non_metric_motion
            motion = self.motion(item.position) if item.on_metric_side else on_ground
            rows[item.spring] = item.direction @ motion
        return stack(rows)

    def motion(self, point: Dual | Array) -> Dual:
        """Motion (..., 3, n) of points (..., 3) [m] of the metric side, in rig axes, per unit of each coordinate."""
        rows = dual_motion_at(point - self.center)[..., list(self.freedom)]
        others = len(self.coordinates) - len(self.freedom)
        return concatenate([rows, constant(np.zeros((*rows.value.shape[:-1], others)), self.parameters)], axis=-1)

    def relative_motion(self, point: Array) -> Dual:
        """Motion (..., 3, n) of points (..., 3) [m] of the metric side relative to the non-metric side."""
        return self.motion(point) - motion_at(point) @ self.non_metric_motion

    def with_coordinates(
        self, names: tuple[str, ...], mass: Dual, damping: Dual, inputs: Dual, compliance: Dual
    ) -> Equations:
        """The equations with further flexible coordinates, which are not yet coupled to the others.

        `mass` and `damping` (m, m), `inputs` (m, 6), `compliance` (m,) of their springs.
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
            non_metric_motion=concatenate([self.non_metric_motion, constant(np.zeros((6, added)), p)], axis=1),
            row_factor=concatenate([self.row_factor, compliance]),
            own_stiffness=np.concatenate([self.own_stiffness, np.ones(added)]),
        )

    def with_force(self, force: CellForce) -> Equations:
        """The equations with a further force along a spring."""
        return replace(self, forces=(*self.forces, force))

    def with_distortion(self, distortion: ChannelDistortion) -> Equations:
        """The equations with a channel that is nonlinear."""
        return replace(self, distortions=(*self.distortions, distortion))

    def with_springs(self, motion: Dual, stiffness: Dual) -> Equations:
        """The equations with springs that no channel reads: elongation (m, n) per coordinate and stiffness (m,)."""
        return replace(self, extra_stiffness=self.extra_stiffness + motion.T @ (stiffness.insert_axis(-1) * motion))


def dual_motion_at(arm: Dual) -> Dual:
    """Motion (..., 3, 6) of points at `arm` (..., 3) [m] from the center of gravity, per unit q; linear in the arm."""
    return arm.dot(MOTION_PER_ARM) + MOTION_AT_CENTER
