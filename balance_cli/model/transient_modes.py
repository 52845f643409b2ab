"""Transient modes: the decaying motion of a balance as its channels read it.

The modes s of the upper half plane form an invariant pair, M X S^2 + D X S + (K + jH) X = 0 with S = diag(s), and the
transient motion is q(t) = Re X exp(S t) a with one complex amplitude a per mode. A channel reads Re Phi exp(S t) a with
Phi = c (r_c X) g_c(S): a filter responds to exp(s t) with its gain at s, once its own transient has decayed. That of
a high-pass with a rate r lasts long: it is a motion exp(-r t) of one channel, with a real amplitude.

A change of parameters changes the pair as a whole. S is then no longer diagonal, but nothing is divided by the
difference of two eigenvalues, so that equal frequencies are allowed (Kressner, Numer. Math. 114, 2009). For any
function of S, (d f(S))_ij = f[s_i, s_j] dS_ij with the divided difference f[a, b] (Daleckii and Krein).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.channel_gains import channel_dynamics, log_gain_derivative
from balance_cli.model.mechanics.equations import ChannelPath
from balance_cli.model.modes import eigenvalues, frequency_stiffness_shift, pencil_matrices
from balance_cli.model.system import System

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

COINCIDENCE_TOLERANCE = 1e-7
"""Relative distance below which two values of s coincide: there a divided difference loses half of its digits."""
UNOBSERVABLE_SHARE = 1e-10
"""Forces below this share of the largest that a motion could cause are rounding errors."""


@dataclass(frozen=True)
class TransientModes:
    """Exponents s (m,) [1/s] of modes and high-passes, and the volts (c, m) of each at t = 0 and unit amplitude.

    The first `oscillating` are modes; high-passes follow, with real s, volts and amplitude. Derivatives by the
    parameters: `s_derivative` (p, m, m) of the matrix S, `volts_derivative` (p, c, m).
    """

    s: ComplexArray
    volts: ComplexArray
    s_derivative: ComplexArray
    volts_derivative: ComplexArray
    oscillating: int

    def select(self, part: slice) -> TransientModes:
        """A part of them that the parameters change independently of the others."""
        s, oscillating = self.s[part], len(range(self.oscillating)[part])
        return TransientModes(
            s, self.volts[:, part], self.s_derivative[:, part, part], self.volts_derivative[:, :, part], oscillating
        )


def transient_modes(
    system: System, spin: float, highest_frequency: float, fastest_decay: float = np.inf, with_derivatives: bool = True
) -> TransientModes:
    """The modes below `highest_frequency` [Hz] and the transients of high-passes, at rotor speed `spin` [Hz].

    Only those with a decay rate up to `fastest_decay` [1/s]. Without derivatives those arrays are empty (p = 0).
    """
    high_passes = _high_pass_transients(system, fastest_decay, with_derivatives)
    if highest_frequency <= 0.0:  # the mean of a record, without any mode: no eigenvalues are needed
        return high_passes
    modes = _structural_transients(system, spin, highest_frequency, fastest_decay, with_derivatives)
    return _join(modes, high_passes)


def _structural_transients(
    system: System, spin: float, highest_frequency: float, fastest_decay: float, with_derivatives: bool
) -> TransientModes:
    M, D, K = pencil_matrices(system, spin)
    s, left, right = eigenvalues(M, D, K)
    is_relevant = (
        (s.imag < 2 * np.pi * highest_frequency) & (-s.real < fastest_decay) & _observable_modes(system, right)
    )
    s, left, X = s[is_relevant], left[is_relevant], right[is_relevant].T
    norm = np.einsum("mi,mij,jm->m", left, 2 * s[:, None, None] * M + D, X)
    shift, d_shift = frequency_stiffness_shift(system, s, left, X.T, norm)
    springs = [path.spring for path in system.equations.paths]
    forces = (system.readings.value @ X)[springs]
    gains = np.stack([_gain(path, s) for path in system.equations.paths])
    volts = system.equations.mixing.value @ (gains * forces)
    if not with_derivatives:
        none, unread = np.zeros((0, len(s), len(s)), complex), np.zeros((0, *volts.shape), complex)
        return TransientModes(s + shift, volts, none, unread, len(s))
    dX, dS = _invariant_pair_derivatives(system, spin, (M, D), s, left, X)
    dS[:, np.arange(len(s)), np.arange(len(s))] += d_shift.T
    d_forces = (system.readings.derivative @ X + system.readings.value @ dX)[:, springs]
    d_volts = gains * d_forces + _gain_function_derivatives(system, s, gains, forces, dS)
    d_volts = system.equations.mixing.value @ d_volts + system.equations.mixing.derivative @ (gains * forces)
    return TransientModes(s + shift, volts, dS, d_volts, len(s))


def _observable_modes(system: System, right: ComplexArray) -> NDArray[np.bool_]:
    """Whether a cell reads each mode (m,) of vectors (m, n): that of a massless part is rounding in all others."""
    R = system.readings.value
    force = np.linalg.norm(right @ R.T, axis=1)
    return np.asarray(force > UNOBSERVABLE_SHARE * np.linalg.norm(R) * np.linalg.norm(right, axis=1))


def _high_pass_transients(system: System, fastest_decay: float, with_derivatives: bool) -> TransientModes:
    """The transient of each slow high-pass: s = -r, one volt in its channel; the amplitude is real."""
    paths = enumerate(system.equations.paths)
    slow = [(c, rate) for c, path in paths for rate in path.high_pass if 0 < rate.value < fastest_decay]
    channels, p = [c for c, _ in slow], system.parameters if with_derivatives else 0
    s = np.array([-rate.value for _, rate in slow], complex)
    s_derivative = np.zeros((p, len(s), len(s)), complex)
    if with_derivatives:
        for i, (_, rate) in enumerate(slow):
            s_derivative[:, i, i] = -rate.derivative
    mixing = system.equations.mixing
    volts_derivative = mixing.derivative[:p, :, channels].astype(complex)
    return TransientModes(s, mixing.value[:, channels].astype(complex), s_derivative, volts_derivative, 0)


def _join(first: TransientModes, second: TransientModes) -> TransientModes:
    m = len(first.s)
    s = np.concatenate([first.s, second.s])
    s_derivative = np.zeros((len(first.s_derivative), len(s), len(s)), complex)
    s_derivative[:, :m, :m], s_derivative[:, m:, m:] = first.s_derivative, second.s_derivative
    volts_derivative = np.concatenate([first.volts_derivative, second.volts_derivative], axis=2)
    volts = np.concatenate([first.volts, second.volts], axis=1)
    return TransientModes(s, volts, s_derivative, volts_derivative, first.oscillating)


def divided_differences(values: ComplexArray, derivative_values: ComplexArray, s: ComplexArray) -> ComplexArray:
    """f[s_i, s_j] (..., m, m) of a function with values f(s_j) (..., m) and derivatives f'(s_j) (..., m)."""
    difference = s[:, None] - s
    same = np.abs(difference) < COINCIDENCE_TOLERANCE * np.abs(s)
    quotient = (values[..., :, None] - values[..., None, :]) / np.where(same, 1.0, difference)
    return np.asarray(np.where(same, derivative_values[..., :, None], quotient))


def _gain(path: ChannelPath, s: ComplexArray) -> ComplexArray:
    return np.asarray(path.gain.value * channel_dynamics(path, s), complex)


def _gain_derivative(path: ChannelPath, s: ComplexArray) -> ComplexArray:
    """The derivative dg/ds by central differences; filters are smooth over 1e-5 of s."""
    step = 1e-5 * np.abs(s)
    return (_gain(path, s + step) - _gain(path, s - step)) / (2 * step)


def _gain_function_derivatives(
    system: System, s: ComplexArray, gains: ComplexArray, forces: ComplexArray, dS: ComplexArray
) -> ComplexArray:
    """Change (p, c, m) of r g(S) for rows r (c, m): by S itself, and by the parameters of the filters."""
    rows = []
    for i, path in enumerate(system.equations.paths):
        change = divided_differences(gains[i], _gain_derivative(path, s), s) * dS
        rows.append(forces[i] @ change + (forces[i] * gains[i]) * log_gain_derivative(path, s[:, None]).T)
    return np.stack(rows, axis=1)


def _invariant_pair_derivatives(
    system: System, spin: float, matrices: tuple[Array, Array], s: ComplexArray, left: ComplexArray, X: ComplexArray
) -> tuple[ComplexArray, ComplexArray]:
    """Derivatives dX (p, n, m) and dS (p, m, m), column by column.

    They solve P(s_j) dx_j + sum_i (M (s_i + s_j) + D) x_i dS_ij = -dP(s_j) x_j, with W (dX, d(XS)) = 0 where
    W (X, XS) = I.
    """
    M, D = matrices
    n, m = X.shape
    pencil = system.pencil
    W1, W2 = s[:, None] * (left @ M) + left @ D, left @ M
    normal = W1 @ X + W2 @ (X * s)
    W1, W2 = (np.asarray(np.linalg.solve(normal, W), complex) for W in (W1, W2))
    K = pencil.stiffness.value + 1j * pencil.hysteresis.value
    bordered = np.empty((m, n + m, n + m), np.complex128)
    for j, sj in enumerate(s):
        coupling = M @ (X * (s + sj)) + D @ X
        bordered[j] = np.block([[sj**2 * M + sj * D + K, coupling], [W1 + sj * W2, W2 @ X]])
    damping = pencil.damping.derivative + 2 * np.pi * spin * pencil.gyroscopic.derivative
    elastic = pencil.stiffness.derivative + 1j * pencil.hysteresis.derivative
    change = (pencil.mass.derivative @ X) * s**2 + (damping @ X) * s + elastic @ X
    right = np.zeros((m, n + m, len(change)), complex)
    right[:, :n] = -change.transpose(2, 1, 0)
    solved = np.asarray(np.linalg.solve(bordered, right), complex).transpose(2, 1, 0)
    return solved[:, :n], solved[:, n:]
