"""The linear balance at one parameter vector: its equations, and the matrices that follow from them.

With A(w) = K + j H + ln(w / w0) L + j w (D + Omega G) - w^2 M the forces of the springs are f = (R + j R_H + ...) A^-1
F u, with the readings R = k E and R_H = k eta E, and the channels' volts are y = X g(w) f. H, L and R_H hold only where
there is motion; at rest they are zero, and the sign of H is that of the frequency.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Pencil:
    """A(w) = K + j hysteresis + ln(w / w0) frequency_stiffness + j w (damping + Omega gyroscopic) - w^2 mass.

    Each (n, n) with derivatives; hysteresis and frequency_stiffness only where there is motion; w0 / (2 pi) is
    `reference_frequency` [Hz].
    """

    mass: Dual
    damping: Dual
    gyroscopic: Dual
    stiffness: Dual
    hysteresis: Dual
    frequency_stiffness: Dual
    reference_frequency: float

    def log_frequency_ratio(self, frequency: Array) -> Array:
        """ln(w / w0) (k,) at frequencies [Hz]; zero at rest."""
        moving = np.asarray(frequency, float) > 0
        return np.where(moving, np.log(np.where(moving, frequency, 1.0) / self.reference_frequency), 0.0)

    def damping_derivative(self, spin: float) -> Array:
        """Derivatives (p, n, n) of the damping at rotor speed `spin` [Hz], gyroscopic terms included."""
        return np.asarray(self.damping.derivative + 2 * np.pi * spin * self.gyroscopic.derivative)


@dataclass(frozen=True, eq=False)
class System:
    """A balance with derivatives, ready to be solved; n coordinates, e springs. Two of them are never equal.

    `equations` are those it was assembled from. In `pencil`, `inputs` (n, 6) and `reactions` (n, e) the rows of
    flexible parts are multiplied by their compliance. `readings` R (e, n) are the forces of the springs per unit
    motion, `readings_loss` (e, n) the part in quadrature, `readings_frequency_stiffness` (e, n) the part that grows
    with the logarithm of frequency; `reactions` (n, e) act on the balance per unit force along each spring.
    """

    equations: Equations
    pencil: Pencil
    inputs: Dual
    readings: Dual
    readings_loss: Dual
    readings_frequency_stiffness: Dual
    reactions: Dual

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels in order."""
        return self.equations.channel_names

    @property
    def springs_of_channels(self) -> list[int]:
        """Index of the spring that each channel reads (c,)."""
        return [path.spring for path in self.equations.paths]

    @cached_property
    def structural_parameters(self) -> NDArray[np.bool_]:
        """Which parameters (p,) change the forces of the springs; those of channels and exciters do not."""
        pencil = self.pencil
        parts = (
            pencil.mass,
            pencil.damping,
            pencil.gyroscopic,
            pencil.stiffness,
            pencil.hysteresis,
            pencil.frequency_stiffness,
            self.readings,
            self.readings_loss,
            self.readings_frequency_stiffness,
            self.inputs,
            self.reactions,
        )
        return np.asarray(np.any([part.derivative.any(axis=(1, 2)) for part in parts], axis=0))

    def coupled_spin(self, spin: float) -> float:
        """Return the rotor speed [Hz] that the equations depend on: 0 without gyroscopic coupling."""
        return spin if self.pencil.gyroscopic.value.any() else 0.0

    @property
    def parameters(self) -> int:
        """Number p of parameters."""
        return self.inputs.parameters


def assemble_system(equations: Equations) -> System:
    """Form the pencil, with the rows of flexible parts multiplied by their compliance.

    K = E' diag(k) E + K_extra, H = E' diag(k eta) E, and likewise with the frequency-dependent stiffness.
    """
    E = equations.elongation
    springs = equations.stiffness.insert_axis(-1) * E
    springs_loss = equations.loss.insert_axis(-1) * springs
    springs_frequency_stiffness = equations.frequency_stiffness.insert_axis(-1) * springs
    readings = springs + equations.extra_readings
    readings_loss, readings_frequency_stiffness = springs_loss, springs_frequency_stiffness
    if equations.sums:
        S = equations.summation
        readings, readings_loss = S @ readings, S @ readings_loss
        readings_frequency_stiffness = S @ readings_frequency_stiffness
    if equations.point_motions:
        readings = readings + equations.motion_readings()
    factor = equations.row_factor.insert_axis(-1)
    pencil = Pencil(
        mass=factor * equations.mass,
        damping=factor * equations.damping,
        gyroscopic=factor * equations.gyroscopic,
        stiffness=factor * (E.T @ springs + equations.extra_stiffness) + np.diag(equations.own_stiffness),
        hysteresis=factor * (E.T @ springs_loss),
        frequency_stiffness=factor * (E.T @ springs_frequency_stiffness),
        reference_frequency=equations.reference_frequency,
    )
    return System(
        equations=equations,
        pencil=pencil,
        inputs=factor * equations.inputs,
        readings=readings,
        readings_loss=readings_loss,
        readings_frequency_stiffness=readings_frequency_stiffness,
        reactions=-(factor * E.T),
    )


def dynamic_stiffness(pencil: Pencil, frequency: Array, spin: float) -> ComplexArray:
    """A (k, n, n) at `frequency` (k,) [Hz] and rotor speed `spin` [Hz]."""
    w = (2 * np.pi * np.asarray(frequency, float))[:, None, None]
    damping = pencil.damping.value + 2 * np.pi * spin * pencil.gyroscopic.value
    stiffness: Array | ComplexArray = pencil.stiffness.value
    if pencil.hysteresis.value.any():
        stiffness = stiffness + 1j * np.sign(w) * pencil.hysteresis.value
    if pencil.frequency_stiffness.value.any():
        ratio = pencil.log_frequency_ratio(frequency)[:, None, None]
        stiffness = stiffness + ratio * pencil.frequency_stiffness.value
    return np.asarray(stiffness + 1j * w * damping - w**2 * pencil.mass.value)


def complex_readings(system: System, frequency: Array) -> ComplexArray:
    """Forces (k, e, n) of the springs per unit motion at `frequency` (k,) [Hz], loss included."""
    readings = system.readings.value.astype(complex)
    if system.readings_loss.value.any():
        readings = readings + 1j * np.sign(frequency)[:, None, None] * system.readings_loss.value
    if system.readings_frequency_stiffness.value.any():
        ratio = system.pencil.log_frequency_ratio(frequency)[:, None, None]
        readings = readings + ratio * system.readings_frequency_stiffness.value
    return np.broadcast_to(readings, (len(frequency), *readings.shape[-2:]))
