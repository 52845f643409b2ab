"""Eigenfrequencies, damping ratios and shapes of a system, with their derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eig

from balance_cli.model.system import System

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

OSCILLATION_SHARE = 1e-9
"""Imaginary parts up to this share of the largest eigenvalue are rounding: such a motion does not oscillate."""


@dataclass(frozen=True)
class Modes:
    """m oscillatory modes in order of rising frequency.

    frequency (m,) [Hz] is that of the undamped oscillator |s| / (2 pi); damping_ratio (m,) = -Re s / |s|; shape (m, n)
    complex, its largest element 1; frequency_derivative and damping_derivative (m, p) for the system's free parameters.
    """

    coordinates: tuple[str, ...]
    frequency: Array
    damping_ratio: Array
    shape: ComplexArray
    frequency_derivative: Array
    damping_derivative: Array


def modes(system: System, spin: float = 0.0) -> Modes:
    """Eigenvalues s of (s^2 M + s (D + Omega G) + K + jH) x = 0 in the upper half plane.

    Derivatives are ds = -y (s^2 dM + s dD + dK + j dH) x / y (2 s M + D) x, with y the left eigenvector. The
    frequency-dependent stiffness of springs is included to first order by the same formula.
    """
    M, D, K = pencil_matrices(system, spin)
    s, left, right = eigenvalues(M, D, K)
    norm = np.einsum("mi,mij,mj->m", left, 2 * s[:, None, None] * M + D, right)
    ds = -_pencil_derivative_products(system, spin, s, left, right) / norm[:, None]
    shift, d_shift = frequency_stiffness_shift(system, s, left, right, norm)
    s, ds = s + shift, ds + d_shift
    size = np.abs(s)
    d_size = np.real(s.conj()[:, None] * ds) / size[:, None]
    zeta = -s.real / size
    d_zeta = -ds.real / size[:, None] - zeta[:, None] * d_size / size[:, None]
    largest = np.take_along_axis(right, np.argmax(np.abs(right), axis=1)[:, None], axis=1)
    return Modes(system.equations.coordinates, size / (2 * np.pi), zeta, right / largest, d_size / (2 * np.pi), d_zeta)


def frequency_stiffness_shift(
    system: System, s: ComplexArray, left: ComplexArray, right: ComplexArray, norm: ComplexArray
) -> tuple[ComplexArray, ComplexArray]:
    """First-order change (m,) of the eigenvalues by frequency-dependent stiffness, and its derivatives (m, p).

    `left` and `right` (m, n) are the eigenvectors, `norm` (m,) = y (2 s M + D) x.
    """
    frequency_stiffness = system.pencil.frequency_stiffness
    each = -np.log(np.abs(s) / (2 * np.pi * system.pencil.reference_frequency)) / norm
    shift = each * np.einsum("mi,ij,mj->m", left, frequency_stiffness.value, right)
    derivatives = np.zeros((len(s), system.parameters), complex)
    if frequency_stiffness.derivative.any():
        derivatives += each[:, None] * np.einsum(
            "mi,pij,mj->mp", left, frequency_stiffness.derivative, right, optimize=True
        )
    return shift, derivatives


def pencil_matrices(system: System, spin: float) -> tuple[Array, Array, ComplexArray]:
    """Mass, damping with the gyroscopic part, and complex stiffness at a rotor speed `spin` [Hz]."""
    pencil = system.pencil
    damping = pencil.damping.value + 2 * np.pi * spin * pencil.gyroscopic.value
    return pencil.mass.value, damping, pencil.stiffness.value + 1j * pencil.hysteresis.value


def overdamped_decay_rates(system: System, spin: float = 0.0) -> Array:
    """Decay rates [1/s], positive, of motions that do not oscillate; no order, and none where all motions oscillate.

    Structural damping, which a motion without oscillation hardly feels, is left out.
    """
    M, D, K = pencil_matrices(system, spin)
    values = _finite_eigenvalues(M, D, K.real)[0]
    creeping = np.abs(values.imag) <= OSCILLATION_SHARE * np.abs(values).max(initial=0.0)
    return np.asarray(-values.real[creeping & (values.real < 0.0)])


def eigenvalues(M: Array, D: Array, K: ComplexArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Oscillatory eigenvalues (m,) of rising size with left and right vectors (m, n) of the quadratic problem.

    Raises LinAlgError where the matrices are not finite, or inertia or stiffness vanish.
    """
    values, left, right = _finite_eigenvalues(M, D, K)
    oscillating = np.flatnonzero(values.imag > OSCILLATION_SHARE * np.abs(values).max(initial=0.0))
    order = oscillating[np.argsort(np.abs(values[oscillating]))]
    return values[order], left[order], right[order]


def _finite_eigenvalues(M: Array, D: Array, K: Array | ComplexArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """All finite eigenvalues (m,) with left and right vectors (m, n).

    The companion pencil is [[0, I], [-K, -D]] v = s [[I, 0], [0, M]] v; M may be singular (infinite eigenvalues).
    Raises LinAlgError where the matrices are not finite, or inertia or stiffness vanish.
    """
    inertia, stiffness = np.trace(M), np.abs(np.trace(K))
    if not (inertia > 0.0 and stiffness > 0.0 and all(np.isfinite(part).all() for part in (M, D, K))):
        raise np.linalg.LinAlgError("the matrices of motion are not finite, or have no inertia or stiffness")
    n = len(M)
    identity, nothing = np.eye(n), np.zeros((n, n))
    scale = np.sqrt(stiffness / inertia)
    companion = np.block([[nothing, identity], [-K / scale**2, -D / scale]])
    weight = np.block([[identity, nothing], [nothing, M]])
    values, left, right = eig(companion, weight, left=True, right=True)
    finite = np.isfinite(values) & (np.abs(values) < 1e6)
    # The lower half of the companion's left vector is the left vector of the quadratic problem.
    return values[finite] * scale, left[n:, finite].conj().T, right[:n, finite].T


def _pencil_derivative_products(
    system: System, spin: float, s: ComplexArray, left: ComplexArray, right: ComplexArray
) -> ComplexArray:
    """The products y (s^2 dM + s dD + dK + j dH) x (m, p)."""
    pencil = system.pencil

    def between(derivative: Array) -> ComplexArray:
        return np.asarray(np.einsum("mi,pij,mj->mp", left, derivative, right, optimize=True))

    damping = pencil.damping.derivative + 2 * np.pi * spin * pencil.gyroscopic.derivative
    inertia, viscous = between(pencil.mass.derivative), between(damping)
    elastic = between(pencil.stiffness.derivative) + 1j * between(pencil.hysteresis.derivative)
    return np.asarray(s[:, None] ** 2 * inertia + s[:, None] * viscous + elastic)
