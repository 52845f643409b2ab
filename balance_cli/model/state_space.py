"""The balance as a real system in continuous time: a state space of its modes and of the channels' filters.

With the states x of modes and filters, u the hub loads and z the volts before delay and crosstalk,

    x' = A x + B u,        z = C x + D u,        y_c(t) = sum_d mixing_cd z_d(t - delay_d),

has the response of the `System` from which it is made. Poles s_m and residues R_m of the pencil give the springs'
forces, sum_m R_m / (s - s_m) + D_f; D_f is the contribution of parts without mass or without compliance. A loss factor,
which no causal system has at every frequency, is approximated by relaxations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from balance_cli.campaign.rig.geometry import Acquisition, AnalogFilter
from balance_cli.model.mechanics.equations import ChannelPath
from balance_cli.model.realization import (
    Descriptor,
    Realization,
    add_derivative,
    differentiate_twice,
    modal_form,
    parallel,
    proper_part,
    series,
    static_gain_system,
)
from balance_cli.model.relaxation import relaxation_chain
from balance_cli.model.system import System
from balance_cli.signals.anti_alias import butterworth_poles

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LOSS_RANK_TOLERANCE = 1e-12
"""Singular values below this share of the largest are rounding errors in the rank of the springs with loss."""


@dataclass(frozen=True)
class StateSpace:
    """x' = A x + B u, z = C x + D u, y_c(t) = sum_d mixing[c, d] z_d(t - delay[d]).

    A (n, n), B (n, 6), C (c, n), D (c, 6); u (6,) hub loads [N, N m], z (c,) volts before delay and crosstalk. delay
    (c,) [s], positive is late; mixing (c, c).
    """

    channel_names: tuple[str, ...]
    A: Array
    B: Array
    C: Array
    D: Array
    delay: Array
    mixing: Array

    def response(self, frequency: ArrayLike) -> ComplexArray:
        """T (k, c, 6) at `frequency` (k,) [Hz], volts per unit hub load, delay and mixing included."""
        s = 2j * np.pi * np.atleast_1d(np.asarray(frequency, float))
        late = np.exp(-s[:, None] * self.delay)[:, :, None]
        return np.asarray(self.mixing @ (late * Realization(self.A, self.B, self.C, self.D).transfer_function(s)))


def state_space(system: System, spin: float = 0.0) -> StateSpace:
    """The state space of a balance at rotor speed `spin` [Hz], of true hub loads (no cross-axis matrix).

    Nonlinear forces along springs, mains interference and offsets are left out, as in its response. Raises UserError
    where the response is not that of finite poles and a direct term.
    """
    read = sorted({path.spring for path in system.equations.paths})
    forces = modal_form(proper_part(_structural_descriptor(system, spin, read)))
    motions = {item.spring for item in system.equations.point_motions}
    forces = differentiate_twice(forces, [i for i, spring in enumerate(read) if spring in motions])
    volts = parallel([_channel_filters(path) for path in system.equations.paths])
    of_spring = static_gain_system(
        np.array([[float(path.spring == spring) for spring in read] for path in system.equations.paths])
    )
    readings = series(forces, of_spring)
    for i, path in enumerate(system.equations.paths):
        for tau in path.lead:
            readings = add_derivative(readings, i, float(tau.value))
    balance = series(readings, volts)
    delay = np.array([0.0 if path.delay is None else float(path.delay.value) for path in system.equations.paths])
    return StateSpace(
        system.channel_names, balance.A, balance.B, balance.C, balance.D, delay, system.equations.mixing.value
    )


def with_anti_alias(space: StateSpace, acquisition: Acquisition) -> StateSpace:
    """The same system with the anti-alias filter before every load, so that T becomes H T: the response of the samples.

    The filter is that of `anti_alias_response`. It is the same in every channel; before the loads only six are needed.
    """
    if acquisition.filter is None:
        return space
    filters = parallel([_butterworth_filter(acquisition.filter)] * space.B.shape[1])
    filtered = series(filters, Realization(space.A, space.B, space.C, space.D))
    return replace(space, A=filtered.A, B=filtered.B, C=filtered.C, D=filtered.D)


# ---- mechanics -------------------------------------------------------------------------------------------------------


def _structural_descriptor(system: System, spin: float, read: list[int]) -> Descriptor:
    """From hub loads to the forces of the springs `read`, states (q, q', w), w = a / (s + a) r with k eta E q = U r.

    The forces gain h(s) k eta E q = U (instant r - g' w): one w for each relaxation and each independent elongation r
    of the springs with loss, of which there can be no more than motions.
    """
    chain = relaxation_chain()
    U, loss = _rank_factors(system.readings_loss.value)
    reactions = system.reactions.value @ U
    strengths, rates = chain.strengths[None], 2 * np.pi * system.pencil.reference_frequency * chain.rates[:, None]
    M, D, K = _second_order_matrices(system, spin)
    n, relaxing = len(M), len(loss) * len(chain.rates)
    A = np.block(
        [
            [np.zeros((n, n)), np.eye(n), np.zeros((n, relaxing))],
            [chain.instantaneous_increment * reactions @ loss - K, -D, -np.kron(reactions, strengths)],
            [np.kron(loss, rates), np.zeros((relaxing, n)), -np.diag(np.tile(rates[:, 0], len(loss)))],
        ]
    )
    readings = system.readings.value + chain.instantaneous_increment * system.readings_loss.value
    relaxed = -np.kron(U, strengths)
    return Descriptor(
        E=np.asarray(block_diag(np.eye(n), M, np.eye(relaxing)), float),
        A=A,
        B=np.concatenate([np.zeros((n, 6)), system.inputs.value, np.zeros((relaxing, 6))]),
        C=np.concatenate([readings, np.zeros((len(readings), n)), relaxed], axis=1)[read],
        coordinates=n,
    )


def _rank_factors(rows: Array) -> tuple[Array, Array]:
    """U (e, r) and R (r, n) of full rank r with U R = rows (e, n)."""
    U, size, V = np.linalg.svd(rows, full_matrices=False)
    significant = size > LOSS_RANK_TOLERANCE * size[0]
    return U[:, significant], size[significant, None] * V[significant]


def _second_order_matrices(system: System, spin: float) -> tuple[Array, Array, Array]:
    """M, D + Omega G and K (n, n) at rotor speed `spin` [Hz]; the damping includes the gyroscopic part."""
    pencil = system.pencil
    damping = pencil.damping.value + 2 * np.pi * spin * pencil.gyroscopic.value
    return pencil.mass.value, damping, pencil.stiffness.value


# ---- filters ---------------------------------------------------------------------------------------------------------


def _channel_filters(path: ChannelPath) -> Realization:
    """The path from a spring's force to volts, without the delay."""
    filters = static_gain_system(float(path.gain.value))
    for tau in path.low_pass:
        filters = filters if tau.value == 0 else series(filters, _low_pass(1 / float(tau.value)))
    for rate in path.high_pass:
        filters = filters if rate.value <= 0 else series(filters, _high_pass(float(rate.value)))
    return filters


def _low_pass(rate: float) -> Realization:
    """The filter r / (s + r), r in 1/s."""
    one = np.ones((1, 1))
    return Realization(-rate * one, rate * one, one, 0 * one)


def _high_pass(rate: float) -> Realization:
    """The filter s / (s + r) = 1 - r / (s + r), r in 1/s."""
    one = np.ones((1, 1))
    return Realization(-rate * one, rate * one, -one, one)


def _butterworth_filter(declared: AnalogFilter) -> Realization:
    """The low-pass of `butterworth_poles`: its pairs of poles in series, then the real pole, if any."""
    poles = 2 * np.pi * declared.cutoff * butterworth_poles(declared.order)
    sections = static_gain_system(1.0)
    for pole in poles[: declared.order // 2]:
        sections = series(sections, _resonant_low_pass(complex(pole)))
    return series(sections, _low_pass(2 * np.pi * declared.cutoff)) if declared.order % 2 else sections


def _resonant_low_pass(pole: complex) -> Realization:
    """The low-pass |p|^2 / ((s - p) (s - conj p)) of a pole p."""
    a, b, size = pole.real, pole.imag, abs(pole)
    A = np.array([[a, -b], [b, a]])
    return Realization(A, np.array([[size], [0.0]]), np.array([[0.0, size / b]]), np.zeros((1, 1)))
