"""Nonlinear forces along the springs as functions of time, computed from the springs' own channels.

The channels of a spring measure its force r = k d + (nonlinear forces inside), and so its elongation d at every
instant, and the rate d', whose spectrum is that of d times i w. Hence all forces f(d, d') are known functions of time.
Noise on d matters little: it is small, and f is a small part of the load of a cell. Where the anti-alias filter leaves
nothing to measure, the motion is that which the forces themselves cause.

Derivatives are carried through time as dual numbers of the few parameters that influence a spring. While a force is
zero, only its own strength has a derivative.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.channel_gains import channel_gains, log_gain_derivative
from balance_cli.model.mechanics.cell_force import CellForce, CellMotion
from balance_cli.model.mechanics.dual_numbers import Dual, constant
from balance_cli.model.system import System
from balance_cli.model.system_response import solve
from balance_cli.signals.waveform_types import Waveform

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

# Newton's method converges quadratically where the stiffness stays positive; beyond this it has no solution.
MAX_NEWTON_ITERATIONS = 50
# Last step relative to the largest elongation: a thousand times the rounding of doubles.
NEWTON_TOLERANCE = 1e-12
# Rms of the nonlinear forces inside a cell over that of its reading. They are computed from the reading: at a share of
# one the reading would explain itself, whatever it is, and a load cell that is half nonlinear is none.
MAX_INTERNAL_SHARE = 0.5
# Frequencies beyond the filter at which a balance is solved: beyond its modes its compliance is a smooth function.
MAX_HIDDEN_SOLUTIONS = 200
# Passes over the motion beyond the filter where a force depends on the rate: of the third harmonic of a damper of 10 %
# of critical damping each pass leaves a tenth of the error.
RATE_PASSES = 3


def force_histories(
    waveform: Waveform, system: System, spin: float, derivatives: bool
) -> Iterator[tuple[CellForce, Array, Dual, Index]]:
    """Each force and its spring's elongation as functions of time; derivatives by the parameters `columns`.

    What the forces cause beyond the filter is computed from the motion without it: there a balance yields so little
    that a second pass changes nothing, unless a force depends on the rate.
    """
    measured = _unmix(waveform, system)
    hidden = _hidden_motion(waveform, system, spin)
    if hidden is not None:
        for _ in range(RATE_PASSES if any(force.needs_rate for force in system.equations.forces) else 1):
            measured = replace(measured, beyond=_forces_beyond_filter(waveform, system, measured, hidden))
    return _histories(waveform, system, measured, derivatives)


def _histories(
    waveform: Waveform, system: System, unmixed: _UnmixedVolts, derivatives: bool
) -> Iterator[tuple[CellForce, Array, Dual, Index]]:
    for spring in dict.fromkeys(force.spring for force in system.equations.forces):
        forces = [force for force in system.equations.forces if force.spring == spring]
        present = [force for force in forces if force.values.value[0] != 0.0]
        columns = _influencing_parameters(system, unmixed, spring, present) if derivatives else np.zeros(0, np.intp)
        d = _elongation(waveform, system, unmixed, spring, present, columns)
        motion = _motion(waveform, d, any(force.needs_rate for force in forces))
        at_null = replace(motion, elongation=constant(d.value, 0), rate=constant(motion.rate.value, 0))
        for force in forces:
            if force.values.value[0] != 0.0:
                yield force, d.value, force.along(motion, _select_parameters(force.values, columns)), columns
            elif derivatives:
                own = np.flatnonzero(force.values.derivative[:, 0])
                shape = force.shape(at_null, constant(force.values.value, 0)).value
                yield force, d.value, Dual(np.zeros_like(shape), force.values.derivative[own, 0, None] * shape), own


def _motion(waveform: Waveform, d: Dual, has_rate: bool) -> CellMotion:
    """The motion with the elongation d (n,), and with its rate where a force needs it."""
    if not has_rate:
        return CellMotion.at_rest(d, waveform.is_periodic)
    rate = waveform.differentiate(np.concatenate([d.value[None], d.derivative]).T)
    return CellMotion(d, Dual(rate[:, 0], rate[:, 1:].T), waveform.is_periodic)


def _select_parameters(dual: Dual, columns: Index) -> Dual:
    """The dual number with derivatives by the given parameters only."""
    return Dual(dual.value, dual.derivative[columns])


def _influencing_parameters(system: System, unmixed: _UnmixedVolts, spring: int, forces: Sequence[CellForce]) -> Index:
    """The parameters that influence the forces along one spring; none where there are no forces."""
    if not forces:
        return np.zeros(0, np.intp)
    p, equations = system.parameters, system.equations
    duals = [force.values for force in forces]
    duals += [equations.stiffness[spring], equations.loss[spring], equations.frequency_stiffness[spring]]
    own = [i for i, path in enumerate(equations.paths) if path.spring == spring]
    duals += [dual for i in own for dual in equations.paths[i].dual_numbers]
    # Crosstalk between channels of other springs is most of the parameters of a score test.
    unmixing = unmixed.inverse[own]
    derivatives = [dual.derivative for dual in duals]
    derivatives += [unmixing @ equations.mixing.derivative, equations.channel_offset.derivative @ unmixing.T]
    return np.flatnonzero(np.any([np.any(each.reshape(p, -1), axis=1) for each in derivatives], axis=0))


# ---- elongation ------------------------------------------------------------------------------------------------------


def _elongation(
    waveform: Waveform,
    system: System,
    unmixed: _UnmixedVolts,
    spring: int,
    forces: Sequence[CellForce],
    columns: Index,
) -> Dual:
    """The elongation d (n,) of a spring through time, from k d + (forces inside) = the measured force."""
    force = _elastic_force(waveform, system, unmixed, spring, columns, any(item.has_kinks for item in forces))
    k = _select_parameters(system.equations.stiffness[spring], columns)
    internal_forces = [item for item in forces if item.read]
    if not internal_forces:
        return force * k.reciprocal()
    value = _solve_elongation(force.value, float(k.value), internal_forces, waveform.is_periodic)
    if np.linalg.norm(force.value - float(k.value) * value) > MAX_INTERNAL_SHARE * np.linalg.norm(force.value):
        raise np.linalg.LinAlgError("nonlinear forces inside a cell are most of its reading")
    at = CellMotion.at_rest(constant(value, len(columns)), waveform.is_periodic)
    error = k * at.elongation - force
    for internal in internal_forces:
        error = error + internal.along(at, _select_parameters(internal.values, columns))
    stiffness = k.value + _force_and_stiffness(internal_forces, value, waveform.is_periodic)[1]
    return Dual(value, -error.derivative / stiffness)


def _elastic_force(
    waveform: Waveform, system: System, unmixed: _UnmixedVolts, spring: int, columns: Index, is_fine: bool
) -> Dual:
    """The measured force of a spring through time (n,), divided by 1 + j eta and the growth of k with frequency."""
    loss, growth = system.equations.loss, system.equations.frequency_stiffness
    reading, derivative = _measured_spring_force(waveform, system, unmixed, spring, columns)
    if unmixed.beyond is not None:
        further = len(unmixed.beyond) - len(reading)
        reading, derivative = np.pad(reading, (0, further)), np.pad(derivative, ((0, further), (0, 0)))
        reading = reading + unmixed.beyond[:, spring]
    frequency = waveform.fine_frequency[: len(reading)]
    # Loss and growth hold only where there is motion.
    quadrature, logarithmic = 1j * (frequency > 0), system.pencil.log_frequency_ratio(frequency)
    factor = 1.0 + quadrature * loss.value[spring] + logarithmic * growth.value[spring]
    d_loss, d_growth = loss.derivative[columns, spring], growth.derivative[columns, spring]
    change = quadrature[:, None] * d_loss + logarithmic[:, None] * d_growth
    derivative = (derivative - (reading / factor)[:, None] * change) / factor[:, None]
    history = waveform.to_time_domain(np.concatenate([(reading / factor)[:, None], derivative], axis=1), is_fine)
    return Dual(history[:, 0], history[:, 1:].T)


def _solve_elongation(reading: Array, k: float, internal_forces: Sequence[CellForce], is_periodic: bool) -> Array:
    """Elongation (n,) by Newton's method. Raises LinAlgError where no elongation gives the reading."""
    d = reading / k
    for _ in range(MAX_NEWTON_ITERATIONS):
        force, derivative = _force_and_stiffness(internal_forces, d, is_periodic)
        if np.any(k + derivative <= 0.0):
            break
        step = (k * d + force - reading) / (k + derivative)
        d = d - step
        if np.abs(step).max() <= NEWTON_TOLERANCE * np.abs(d).max():
            return d
    raise np.linalg.LinAlgError("the stiffness of a cell becomes negative under its load")


def _force_and_stiffness(forces: Sequence[CellForce], d: Array, is_periodic: bool) -> tuple[Array, Array]:
    """Sum of forces (n,) that depend on the present elongation d (n,) alone, and its derivative by d."""
    total = constant(np.zeros_like(d), 1)
    motion = CellMotion.at_rest(Dual(d, np.ones((1, len(d)))), is_periodic)
    for force in forces:
        total = total + force.along(motion, constant(force.values.value, 1))
    return total.value, total.derivative[0]


@dataclass(frozen=True)
class _UnmixedVolts:
    """The channels' volts (F, c) before crosstalk and offsets, by the inverse (c, c) of the mixing.

    `constant` (F, 1): change of an amplitude per unit offset. `beyond` (G, e): amplitudes of the springs' forces [N] at
    those of the G fine frequencies that no channel measures; None where they are not known.
    """

    volts: ComplexArray
    inverse: Array
    constant: Array
    beyond: ComplexArray | None = None


def _unmix(waveform: Waveform, system: System) -> _UnmixedVolts:
    constant_volts = np.where(waveform.frequency == 0, waveform.mean_factor, 0.0)[:, None]
    inverse = np.linalg.inv(system.equations.mixing.value)
    volts = (waveform.volts - constant_volts * system.equations.channel_offset.value) @ inverse.T
    return _UnmixedVolts(volts, np.asarray(inverse, float), constant_volts)


def _measured_spring_force(
    waveform: Waveform, system: System, unmixed: _UnmixedVolts, spring: int, columns: Index
) -> tuple[ComplexArray, ComplexArray]:
    """Amplitudes (F,) of the spring's force as its channels read it, and their derivatives (F, q)."""
    own = [i for i, path in enumerate(system.equations.paths) if path.spring == spring]
    paths = [system.equations.paths[i] for i in own]
    gains = channel_gains(paths, waveform.frequency)
    weight = np.where(gains != 0.0, waveform.share[:, own] / np.where(gains != 0.0, gains, 1.0), 0.0)
    parts = weight * unmixed.volts[:, own]
    derivative = np.zeros((len(parts), len(columns)), complex)
    s = np.asarray(2j * np.pi * waveform.frequency[:, None], complex)
    for i, path in enumerate(paths if len(columns) else []):
        derivative -= parts[:, i, None] * log_gain_derivative(path, s)[:, columns]
    offset = system.equations.channel_offset.derivative[columns]
    if offset.any():
        derivative -= unmixed.constant * (weight @ (unmixed.inverse @ offset.T)[own])
    mixing = system.equations.mixing.derivative[columns]
    if mixing.any():
        derivative -= np.einsum("fi,qij,fj->fq", weight, (unmixed.inverse @ mixing)[:, own], unmixed.volts)
    return np.asarray(parts.sum(axis=1)), derivative


# ---- beyond the anti-alias filter ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _HiddenMotion:
    """Fine frequencies that no channel measures, by `index` (h,), and the springs along which forces act.

    `influence` (h, q, q): elastic forces of these springs per unit of force along them.
    """

    index: Index
    springs: tuple[int, ...]
    influence: ComplexArray


def _hidden_motion(waveform: Waveform, system: System, spin: float) -> _HiddenMotion | None:
    """Where the channels do not show the motion that nonlinear forces cause; None where all is measured, or none acts.

    Loads beyond the filter are not known, and exciters have none. Beyond the samples, too: the fifth harmonic of a
    force by the square of the speed changes its third.
    """
    frequency = waveform.fine_frequency
    is_measured = np.zeros(len(frequency), bool)
    is_measured[: len(waveform.share)] = waveform.share.any(axis=1)
    index = np.flatnonzero(~is_measured)
    springs = list(dict.fromkeys(item.spring for item in system.equations.forces if item.values.value[0] != 0.0))
    if not len(index) or not springs:
        return None
    coarse = np.unique(np.linspace(0, len(index) - 1, MAX_HIDDEN_SOLUTIONS).astype(int))
    solution = solve(system, frequency[index[coarse]], spin)
    at_coarse = (solution.force_influence @ system.reactions.value)[:, springs][:, :, springs].reshape(len(coarse), -1)
    between = [np.interp(np.arange(len(index)), coarse, column) for column in at_coarse.T]
    return _HiddenMotion(index, tuple(springs), np.transpose(between).reshape(len(index), len(springs), len(springs)))


def _forces_beyond_filter(
    waveform: Waveform, system: System, unmixed: _UnmixedVolts, hidden: _HiddenMotion
) -> ComplexArray:
    """Amplitudes (G, e) of the springs' forces, as read, that nonlinear forces cause where no channel measures."""
    acting, read = np.zeros((2, len(hidden.index), len(hidden.springs)), complex)
    for force, _, through_time, _ in _histories(waveform, system, unmixed, derivatives=False):
        column = hidden.springs.index(force.spring)
        amplitudes = waveform.to_amplitudes(through_time.value)[hidden.index]
        acting[:, column] += amplitudes
        if force.read:
            read[:, column] += amplitudes
    beyond = np.zeros((len(waveform.fine_frequency), len(system.equations.springs)), complex)
    beyond[hidden.index[:, None], hidden.springs] = read + np.matmul(hidden.influence, acting[:, :, None])[:, :, 0]
    return beyond
