"""Realizations of linear systems: descriptor systems to state space, state space to modal form, and connections.

A descriptor system E x' = A x + B u, y = C x with a singular E has finite poles and infinite ones. The finite part is
that of its deflating subspaces: V of the finite poles, and W orthogonal to the image of the infinite ones (generalized
Schur form; Moler and Stewart, SIAM J. Numer. Anal. 10, 1973),

    C (s E - A)^-1 B = C V (s W' E V - W' A V)^-1 W' B + D.

It needs no eigenvectors, so that poles may coincide. D is the direct term of a proper system.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag, eigvals, ordqz

from balance_cli.io.errors import UserError

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Mask = NDArray[np.bool_]

# Units of s [rad/s], tried in turn: the middle of the band of a balance, then a value on either side of it.
TIME_SCALE_RATES = 2 * np.pi * np.array([100.0, 250.0, 40.0])
# Points on the real axis [rad/s] at which the response is compared with the exact one.
CHECK_FREQUENCIES = 2 * np.pi * np.array([10.0, 1000.0])
# Faster poles [rad/s] count as infinite: in the band of a balance their contribution is constant. Rounding leaves
# infinite poles beyond 1e7 rad/s.
FASTEST_FINITE_POLE = 2 * np.pi * 1e6
# Factor that must separate finite from infinite poles; otherwise the two subspaces are ill-conditioned.
POLE_GAP = 3.0
# Equilibration sweeps; each halves the remaining imbalance on a logarithmic scale.
EQUILIBRATION_SWEEPS = 12
# Lower bound of the size of a weakly driven or observed state, relative to the largest one.
LEAST_STATE_SHARE = 1e-5
# Rounding error of the direct term, relative to the largest response of its input or output.
DIRECT_TERM_ROUNDING = 1e-11
# Relative agreement at these points, which a proper system exceeds by orders of magnitude.
RESPONSE_TOLERANCE = 1e-7
# Condition of the eigenvectors above which the states stay coupled: for two coincident poles it is 1e8, and residues
# cancel to as many digits.
WORST_EIGENVECTOR_CONDITION = 1e6
# Residues below this share of the largest one of their input or output are rounding errors.
NEGLIGIBLE_RESIDUE = 1e-13


@dataclass(frozen=True)
class Realization:
    """x' = A x + B u, y = C x + D u: A (n, n), B (n, i), C (o, n), D (o, i)."""

    A: Array
    B: Array
    C: Array
    D: Array

    def transfer_function(self, s: ArrayLike) -> ComplexArray:
        """C (s I - A)^-1 B + D (k, o, i) at s (k,) [rad/s], k solutions of n equations."""
        identity = np.eye(len(self.A))
        each = [self.C @ np.linalg.solve(value * identity - self.A, self.B) for value in np.atleast_1d(s)]
        return np.asarray(np.stack(each) + self.D, np.complex128)


@dataclass(frozen=True)
class Descriptor:
    """E x' = A x + B u, y = C x: E, A (n, n), B (n, i), C (o, n); E may be singular.

    The first states are as many `coordinates`, and then their rates.
    """

    E: Array
    A: Array
    B: Array
    C: Array
    coordinates: int

    def transfer_function(self, s: float) -> Array:
        """C (s E - A)^-1 B (o, i) at one real s [rad/s]."""
        return np.asarray(self.C @ np.linalg.solve(s * self.E - self.A, self.B))


# ---- connections -----------------------------------------------------------------------------------------------------


def series(first: Realization, second: Realization) -> Realization:
    """The second system driven by the outputs of the first, whose states come first."""
    nothing = np.zeros((len(first.A), len(second.A)))
    return Realization(
        A=np.block([[first.A, nothing], [second.B @ first.C, second.A]]),
        B=np.concatenate([first.B, second.B @ first.D]),
        C=np.concatenate([second.D @ first.C, second.C], axis=1),
        D=second.D @ first.D,
    )


def parallel(parts: Sequence[Realization]) -> Realization:
    """Systems in parallel, each with its own inputs and outputs."""
    return Realization(*(_block_diagonal_array([getattr(part, name) for part in parts]) for name in "ABCD"))


def differentiate_twice(system: Realization, outputs: Sequence[int]) -> Realization:
    """The same system with some outputs, motions of masses, replaced by their second derivatives.

    y'' = C A^2 x + C A B u, because a force moves no mass at once (C B = 0 and D = 0). What a part without mass would
    contribute to C B and D has been neglected: it is beyond `FASTEST_FINITE_POLE`.
    """
    C, D = system.C.copy(), system.D.copy()
    rows = list(outputs)
    C[rows], D[rows] = system.C[rows] @ system.A @ system.A, system.C[rows] @ system.A @ system.B
    return replace(system, C=C, D=D)


def add_derivative(system: Realization, output: int, time: float) -> Realization:
    """The same system with y + time y' in place of one of its outputs y, the force of a spring on a mass.

    y' = C A x + C B u. What a part without mass would contribute to D has been neglected, as in `differentiate_twice`.
    """
    C, D = system.C.copy(), system.D.copy()
    C[output], D[output] = C[output] + time * C[output] @ system.A, D[output] + time * C[output] @ system.B
    return replace(system, C=C, D=D)


def _block_diagonal_array(blocks: Sequence[Array]) -> Array:
    return np.asarray(block_diag(*blocks), float)


def static_gain_system(value: ArrayLike) -> Realization:
    """A system without states, y = D u; D (o, i), or a number."""
    D = np.atleast_2d(np.asarray(value, float))
    return Realization(np.zeros((0, 0)), np.zeros((0, D.shape[1])), np.zeros((len(D), 0)), D)


# ---- from a descriptor system ----------------------------------------------------------------------------------------


def proper_part(system: Descriptor) -> Realization:
    """State space of a proper descriptor system, its poles beyond `FASTEST_FINITE_POLE` in the direct term.

    Raises UserError where the response is not that of finite poles and a direct term.
    """
    for rate in TIME_SCALE_RATES:
        # The QZ iteration may fail to converge; in another unit of time it does.
        with suppress(np.linalg.LinAlgError, ValueError):
            proper = _add_direct_term(_finite_part(system, rate), system)
            if all(
                _responses_agree(proper.transfer_function(s)[0].real, system.transfer_function(s))
                for s in CHECK_FREQUENCIES
            ):
                return proper
    raise UserError(
        "the balance has no state space: its response is not that of finite poles and a direct term",
        remedy="Look for an effect with an implausibly large parameter",
    )


def _add_direct_term(finite: Realization, system: Descriptor) -> Realization:
    """The finite part with D from the difference at one point, without rounding errors."""
    exact = system.transfer_function(TIME_SCALE_RATES[0])
    D = exact - finite.transfer_function(TIME_SCALE_RATES[0])[0].real
    return replace(finite, D=np.where(np.abs(D) > DIRECT_TERM_ROUNDING * _reference_size(np.abs(exact)), D, 0.0))


def _responses_agree(response: Array, exact: Array) -> bool:
    return bool(np.all(np.abs(response - exact) <= RESPONSE_TOLERANCE * _reference_size(np.abs(exact))))


def _reference_size(size: Array) -> Array:
    """The larger (o, i) of the largest elements of each output and each input of `size` (..., o, i)."""
    largest = size.reshape(-1, *size.shape[-2:]).max(axis=0)
    return np.asarray(np.maximum(largest.max(axis=1)[:, None], largest.max(axis=0)), float)


def _equilibrate(system: Descriptor, rate: float) -> Descriptor:
    """Rows and columns scaled until the largest element of each is one, time in units of 1 / `rate`.

    The sweeps are those of Ruiz (Rutherford Appleton Laboratory RAL-TR-2001-034); the response does not change.
    """
    size = rate * np.abs(system.E) + np.abs(system.A)
    row, column = np.ones((len(size), 1)), np.ones(len(size))
    for _ in range(EQUILIBRATION_SWEEPS):
        scaled = row * size * column
        row = row / np.sqrt(scaled.max(axis=1))[:, None]
        column = column / np.sqrt(scaled.max(axis=0))
    return _scale_rows_and_columns(replace(system, E=rate * system.E), row[:, 0], column)


def _scale_rows_and_columns(system: Descriptor, row: Array, column: Array) -> Descriptor:
    by_row = row[:, None]
    E, A = by_row * system.E * column, by_row * system.A * column
    return replace(system, E=E, A=A, B=by_row * system.B, C=system.C * column)


def _balance_states(system: Descriptor) -> Descriptor:
    """The system with states scaled so that each is equally controllable and observable at s = 1.

    Otherwise a coordinate in different units, such as a load, would spread its rounding errors to all responses. A
    coordinate and its rate keep their ratio, because the rate of a fast mode is large.
    """
    pencil = system.E - system.A
    driven = _raise_to_least(np.linalg.norm(np.linalg.solve(pencil, system.B), axis=1))
    read = _raise_to_least(np.linalg.norm(np.linalg.solve(pencil.T, system.C.T), axis=1))
    size, pairs = np.sqrt(driven / read), 2 * system.coordinates
    q, rate = np.split(size[:pairs], 2)
    size[:pairs] = np.tile(np.sqrt(q * rate), 2)
    return _scale_rows_and_columns(system, 1 / size, size)


def _raise_to_least(size: Array) -> Array:
    return np.asarray(np.maximum(size, LEAST_STATE_SHARE * size.max()), float)


def _finite_part(system: Descriptor, rate: float) -> Realization:
    """C V (s W' E V - W' A V)^-1 W' B, by a pencil in units of time of 1 / `rate`."""
    scaled = _balance_states(_equilibrate(system, rate))
    V, W = _subspaces(scaled, FASTEST_FINITE_POLE / rate)
    E, C = W.T @ scaled.E @ V, scaled.C @ V
    A = np.asarray(rate * np.linalg.solve(E, W.T @ scaled.A @ V), float)
    B = np.asarray(rate * np.linalg.solve(E, W.T @ scaled.B), float)
    return Realization(A, B, C, np.zeros((len(C), B.shape[1])))


def _subspaces(system: Descriptor, limit: float) -> tuple[Array, Array]:
    """V (n, f) of the f finite poles, up to `limit`, and W (n, f) orthogonal to the image of the others."""
    fastest = _limit_in_pole_gap(system, limit)

    def finite(alpha: NDArray[Any], beta: NDArray[Any]) -> Mask:
        return np.asarray(np.abs(alpha) < fastest * np.abs(beta))

    def infinite(alpha: NDArray[Any], beta: NDArray[Any]) -> Mask:
        return ~finite(alpha, beta)

    # SciPy passes all eigenvalues at once; its stubs declare a single one.
    select_finite: Any = finite
    select_infinite: Any = infinite
    *_, alpha, beta, _, V = ordqz(system.A, system.E, sort=select_finite, output="real")
    *_, W, _ = ordqz(system.A, system.E, sort=select_infinite, output="real")
    count = int(np.count_nonzero(finite(alpha, beta)))
    return np.asarray(V, float)[:, :count], np.asarray(W, float)[:, len(system.A) - count :]


def _limit_in_pole_gap(system: Descriptor, limit: float) -> float:
    """The smallest of limit, limit POLE_GAP, ... from which every pole is at least a factor `POLE_GAP` away."""
    alpha, beta = np.abs(eigvals(system.A, system.E, homogeneous_eigvals=True))
    while np.any((alpha > limit / POLE_GAP * beta) & (alpha < limit * POLE_GAP * beta)):
        limit *= POLE_GAP
    return limit


# ---- modal form ------------------------------------------------------------------------------------------------------


def modal_form(system: Realization) -> Realization:
    """The same system in modal form, by increasing |s|.

    A pair of poles a +- jb makes a block [[a, -b], [b, a]], a real pole one state. Input and output norms of each mode
    are equal. Unobservable and uncontrollable modes are left out. Where the condition of the eigenvectors is worse than
    `WORST_EIGENVECTOR_CONDITION` (coincident poles) the system is returned unchanged.
    """
    s, vectors = np.linalg.eig(system.A)
    if not len(s) or np.linalg.cond(vectors) > WORST_EIGENVECTOR_CONDITION:
        return system
    c, b = np.asarray(system.C @ vectors, complex), np.asarray(np.linalg.solve(vectors, system.B), complex)
    poles = np.flatnonzero(_significant_residues(s, b, c) & (s.imag >= 0))
    blocks = [_mode(complex(s[m]), b[m], c[:, m]) for m in poles[np.argsort(np.abs(s[poles]))]]
    outputs, inputs = system.D.shape
    return Realization(
        A=_block_diagonal_array([A for A, _, _ in blocks] or [np.zeros((0, 0))]),
        B=np.concatenate([np.zeros((0, inputs)), *(B for _, B, _ in blocks)]),
        C=np.concatenate([np.zeros((outputs, 0)), *(C for _, _, C in blocks)], axis=1),
        D=system.D,
    )


def _significant_residues(s: ComplexArray, b: ComplexArray, c: ComplexArray) -> Mask:
    """Whether each pole (m,) has a residue c b' / |s|, of b (m, i) and c (o, m), above rounding errors."""
    size = np.abs(c.T[:, :, None] * b[:, None, :] / s[:, None, None])
    return np.asarray((size > NEGLIGIBLE_RESIDUE * _reference_size(size)).any(axis=(1, 2)))


def _mode(s: complex, b: ComplexArray, c: ComplexArray) -> tuple[Array, Array, Array]:
    """Real A, B, C of the residue c b' / (s' - s), and of its conjugate for a complex pole."""
    scale = np.sqrt(np.linalg.norm(c) / np.linalg.norm(b))
    b, c = b * scale, c / scale
    if s.imag == 0:
        return np.array([[s.real]]), b.real[None], c.real[:, None]
    A = np.array([[s.real, -s.imag], [s.imag, s.real]])
    return A, np.sqrt(2) * np.stack([b.real, b.imag]), np.sqrt(2) * np.stack([c.real, -c.imag], axis=1)
