"""Eq. (6) of the paper, corrected: s'' + D s' + K s = B_F u, with free matrices; its response, derivative and modes.

The corrections are those of docs/theory/paper-notes.md, cited as notes by their numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.paper.sensors import SensorRule, sensor_matrix
from balance_cli.model.plate import plate_matrices

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MIN_REFLECTED_DAMPING = 1e-3
"""Least damping ratio of a reflected mode, below that of real balances, so that it is safely stable."""


@dataclass(frozen=True)
class Coefficients:
    """The coefficients of eq. (6): D (n, n) [1/s], K (n, n) [1/s2], B_F (n, m) [1/s2, 1/(m s2)]."""

    D: Array
    K: Array
    B_F: Array

    @property
    def table(self) -> Array:
        """[D, K, B_F] (n, 2n+m): a row holds one sensor's equation, -omega^2 s_a = table[a] . regressors."""
        return np.hstack([self.D, self.K, self.B_F])


def coefficients_from_table(table: Array) -> Coefficients:
    """Coefficients from [D, K, B_F] (n, 2n+m)."""
    n = len(table)
    return Coefficients(table[:, :n], table[:, n : 2 * n], table[:, 2 * n :])


def free_coefficients(n: int, m: int, full_damping: bool) -> NDArray[np.bool_]:
    """Which entries of the table (n, 2n+m) are parameters: all of K and B_F; of D the diagonal, or all."""
    D = np.ones((n, n), bool) if full_damping else np.eye(n, dtype=bool)
    return np.hstack([D, np.ones((n, n + m), bool)])


def declared_coefficients(geometry: Geometry, rule: SensorRule, inputs: tuple[str, ...]) -> Coefficients:
    """P M^-1 D P^-1, P M^-1 K P^-1 and P M^-1 F of the declared rigid plate (note 4); K is that of all the cells."""
    plate = plate_matrices(geometry)
    P = sensor_matrix(rule.matrix, plate)
    PM, P_inverse = P @ np.linalg.inv(plate.M), np.linalg.inv(P)
    F = plate.F[:, [COMPONENTS.index(name) for name in inputs]]
    return Coefficients(PM @ plate.D @ P_inverse, PM @ plate.K @ P_inverse, PM @ F)


def regressors(frequency: Array, s: ComplexArray, u: ComplexArray, axis: int = -1) -> ComplexArray:
    """Phi = [-j omega s, -s, u], so that -omega^2 s = [D, K, B_F] phi.

    `frequency` [Hz] runs along the first axis of s and u; sensors, inputs and the 2n+m regressors along `axis`.
    """
    jw = 2j * np.pi * frequency.reshape(-1, *[1] * (s.ndim - 1))
    return np.concatenate([-jw * s, -s, u], axis=axis)


def compliance(model: Coefficients, frequency: Array) -> ComplexArray:
    """(-omega^2 I + j omega D + K)^-1 (N, n, n) [s2] at `frequency` (N,) [Hz]."""
    w = 2 * np.pi * frequency[:, None, None]
    return np.asarray(np.linalg.inv(model.K - w**2 * np.eye(len(model.K)) + 1j * w * model.D))


def model_response(model: Coefficients, frequency: Array) -> ComplexArray:
    """G = (-omega^2 I + j omega D + K)^-1 B_F (N, n, m) [N/N, N/(N m)] at `frequency` (N,) [Hz]; 0 is static."""
    return np.asarray(compliance(model, np.asarray(frequency, float)) @ model.B_F)


def model_response_jacobian(model: Coefficients, free: NDArray[np.bool_], frequency: Array) -> ComplexArray:
    """dG/dtheta (N, n, m, p) by the free entries of the table, in row order.

    dG = compliance (-j omega dD G - dK G + dB_F): the entry in row a and column r gives compliance[:, a] times
    regressor r of the response itself.
    """
    frequency = np.asarray(frequency, float)
    R = compliance(model, frequency)
    G = R @ model.B_F
    m = model.B_F.shape[1]
    phi = regressors(frequency, G, np.broadcast_to(np.eye(m, dtype=complex), (len(frequency), m, m)), axis=1)
    row, column = np.nonzero(free)
    return np.asarray(np.einsum("kip,kpj->kijp", R[:, :, row], phi[:, column, :]))


def first_order_matrix(model: Coefficients) -> Array:
    """The system matrix of eq. (7) with its signs restored (note 5): [[-D, -K], [I, 0]] for x = [s', s]."""
    n = len(model.K)
    return np.block([[-model.D, -model.K], [np.eye(n), np.zeros((n, n))]])


def is_stable(model: Coefficients) -> bool:
    """Whether all eigenvalues lie in the left half plane."""
    A = first_order_matrix(model)
    return bool(np.all(np.isfinite(A)) and np.max(np.linalg.eigvals(A).real) < 0.0)


def stabilize(model: Coefficients) -> Coefficients | None:
    """Reflect unstable eigenvalues into the left half plane, with the same eigenvectors; None where that fails.

    With the eigenvectors V and eigenvalues Lambda of the quadratic problem, [D, K] solves
    V Lambda^2 + D V Lambda + K V = 0.
    """
    if is_stable(model):
        return model
    n = len(model.K)
    eigenvalues, vectors = np.linalg.eig(first_order_matrix(model))
    V = vectors[n:]
    damped = np.minimum(-np.abs(eigenvalues.real), -MIN_REFLECTED_DAMPING * np.abs(eigenvalues))
    reflected = np.where(eigenvalues.real < 0, eigenvalues.real, damped) + 1j * eigenvalues.imag
    VL = V * reflected
    try:
        DK = np.asarray(np.linalg.solve(np.vstack([VL, V]).T, -(VL * reflected).T).T.real, float)
    except np.linalg.LinAlgError:
        return None
    result = Coefficients(DK[:, :n], DK[:, n:], model.B_F)
    return result if is_stable(result) else None


@dataclass(frozen=True)
class Mode:
    """An eigenvalue of the identified system: frequency |lambda| / 2 pi [Hz], damping ratio, one sigma of each.

    A real eigenvalue is a mode of its own with damping ratio 1 (or -1).
    """

    frequency_hz: float
    damping_ratio: float
    sigma_frequency_hz: float
    sigma_damping_ratio: float


def modes_of_coefficients(model: Coefficients, free: NDArray[np.bool_], covariance: Array) -> tuple[Mode, ...]:
    """Modes in order of frequency, with sigma propagated from the covariance (p, p) of the free entries.

    With A X = X Lambda and Y = X^-1, d lambda_i / d A_ab = Y_ia X_bi (analytic, eigenvalues assumed distinct); D and
    K enter the first block row of A with a minus sign, B_F not at all.
    """
    n = len(model.K)
    eigenvalues, X = np.linalg.eig(first_order_matrix(model))
    Y = np.linalg.inv(X)
    row, column = np.nonzero(free)
    in_A = column < 2 * n
    result = []
    for i in np.flatnonzero(eigenvalues.imag >= 0.0):
        derivative = np.zeros(len(row), complex)
        derivative[in_A] = -Y[i, row[in_A]] * X[column[in_A], i]
        result.append(_mode(complex(eigenvalues[i]), derivative, covariance))
    return tuple(sorted(result, key=lambda mode: mode.frequency_hz))


def _mode(eigenvalue: complex, derivative: ComplexArray, covariance: Array) -> Mode:
    size = abs(eigenvalue)
    d_size = (np.conj(eigenvalue) * derivative).real / size
    zeta = -eigenvalue.real / size
    d_zeta = -derivative.real / size - zeta * d_size / size
    sigma_size, sigma_zeta = (float(np.sqrt(max(d @ covariance @ d, 0.0))) for d in (d_size, d_zeta))
    return Mode(size / (2 * np.pi), zeta, sigma_size / (2 * np.pi), sigma_zeta)
