"""C0 by linear regression of static load points, its inverse T0, and the errors of both (paper, section 1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.repeated_tares import lack_of_fit_variance, repeated_tares
from balance_cli.io.errors import UserError
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]

COLLINEARITY_RATIO = 1e-6
"""Least over largest singular value of the scaled columns below which they are collinear: loads are read no better."""
NOISE_FLOOR_SHARE = 1e-7
"""Floor of a channel's noise over its range: no reading is better, and a computed one must not have infinite weight."""
HC3_LEVERAGE_FLOOR = 0.1
"""Floor of 1 - leverage in HC3, so that a row that alone determines a coefficient has a finite error."""
CONTRADICTED_NOISE_P_VALUE = 1e-3
"""P-value of residuals so much smaller than the noise, below which that noise estimate is rejected."""
ZERO_SHIFT_P_VALUE = 0.01
"""P-value, corrected for the number of channels, below which the zeros of load series differ within a run."""
MIN_MOVEMENT = 0.01
"""Share of a component's range by which consecutive rows must differ to count as a movement: above load noise."""
MIN_NULL_SHARE = 0.1
"""Share in the null direction from which a component is named in an error about collinear loads."""


@dataclass(frozen=True)
class TrimRows:
    """Rows of the static runs of one trim, in the order of loading: channels (m, c) [V], loads (m, k) [N, N m].

    `uncarried_loads` (m, o) [N, N m]: loads that were applied but that the balance does not carry; `run` (m,):
    number of the run, or of the segment of constant attitude, of each row; `weight` (m,): from the noise of its run.
    """

    channels: Array
    loads: Array
    uncarried_loads: Array
    run: NDArray[np.intp]
    weight: Array


@dataclass(frozen=True)
class TrimRegression:
    """Regression s = offset of the run + C0 f: offsets (runs, c) [V], C0 (c, k) and residuals (m, c) [V].

    `C0_covariance` (c, k, c, k) is that of the coefficients, `covariance` (c, c) [V2] that of the residuals of a row.
    """

    offsets: Array
    C0: Array
    C0_covariance: Array
    residuals: Array
    covariance: Array
    dof: int


@dataclass(frozen=True)
class ColumnsFit:
    """Coefficients (p, c) of columns X (m, p), influence (p, m) of rows on them, residuals (m, c), leverage (m,)."""

    coefficients: Array
    influence: Array
    residuals: Array
    leverage: Array
    dof: int

    def covariance(self, columns: slice) -> Array:
        """Covariance (c, q, c, q) of the coefficients of some columns.

        Rows are not equally noisy, because the noise of a load reading is present only where that load was applied. The
        covariance is therefore robust to heteroscedasticity (MacKinnon and White, J. Econometrics 29, 1985, HC3).
        """
        e = self.residuals / np.maximum(1.0 - self.leverage, HC3_LEVERAGE_FLOOR)[:, None]
        each = np.einsum("mi,jm->mij", e, self.influence[columns])
        return np.asarray(np.einsum("mij,mkl->ijkl", each, each, optimize=True))


def regress(rows: TrimRows, components: tuple[str, ...]) -> TrimRegression:
    """Estimate C0 and the offsets by linear regression over all rows.

    All channels have the same regressors, so that their joint weighted regression equals that of each channel alone
    (Zellner, J. Am. Stat. Assoc. 57, 1962).

    Raises UserError where there are too few rows, or components were only loaded together.
    """
    offsets = run_columns(rows)
    r, k = offsets.shape[1], rows.loads.shape[1]
    X = np.hstack([offsets, rows.loads, rows.uncarried_loads])
    tare = repeated_tares(_load_shares(rows))
    points = len(X) - np.count_nonzero(tare) + len(np.unique(rows.run[tare]))
    if points <= X.shape[1]:
        fault = f"{points} load points for {X.shape[1]} coefficients of each channel"
        raise UserError(fault, remedy="Apply more load points, so that some are left that show an error")
    fit = fit_columns(X, rows, (*[""] * r, *components))
    covariance = (fit.residuals.T * rows.weight) @ fit.residuals / fit.dof
    inner = slice(r, r + k)
    C0 = fit.coefficients[inner].T
    return TrimRegression(fit.coefficients[:r], C0, fit.covariance(inner), fit.residuals, covariance, fit.dof)


def lack_of_fit_covariance(covariance: Array, regression: TrimRegression, rows: TrimRows) -> tuple[Array, int]:
    """Covariance (c, c) [V2] of a row, and its degrees of freedom, from that of all, repeated unloaded ones too."""
    dof = np.full(len(covariance), float(regression.dof))
    growth, dof = lack_of_fit_variance(regression.residuals, rows.weight, _load_shares(rows), rows.run, dof)
    return np.asarray(covariance * np.sqrt(growth[:, None] * growth)), int(dof.min())


def zeros_differ(few: TrimRegression, many: TrimRegression) -> bool:
    """Whether a regression with more zeros explains significantly more than one with few, in any channel (F-test)."""
    added = few.dof - many.dof
    if added <= 0:
        return False
    gain = np.diag(few.covariance) * few.dof - np.diag(many.covariance) * many.dof
    F = gain / added / np.maximum(np.diag(many.covariance), np.finfo(float).tiny)
    return bool(np.min(stats.f.sf(F, added, many.dof)) * len(F) < ZERO_SHIFT_P_VALUE)


def standard_errors(covariance: Array) -> Array:
    """Standard errors (c, k) from a covariance (c, k, c, k)."""
    return np.asarray(np.sqrt(np.einsum("ijij->ij", covariance)))


def _load_shares(rows: TrimRows) -> Array:
    """Return all loads (m, k + u) over their ranges: rows with a load that the rig does not carry are not unloaded."""
    loads = np.hstack([rows.loads, rows.uncarried_loads])
    spread = np.ptp(loads, axis=0)
    return np.asarray(loads / np.where(spread > 0, spread, 1.0))


def run_columns(rows: TrimRows) -> Array:
    """Indicator columns (m, runs) of the runs, for their offsets."""
    return np.eye(int(rows.run[-1]) + 1)[rows.run]


def fit_columns(X: Array, rows: TrimRows, names: tuple[str, ...] = ()) -> ColumnsFit:
    """Weighted regression of the channels on X (m, p); raises UserError where columns of X are collinear."""
    root = np.sqrt(rows.weight)[:, None]
    scale = np.linalg.norm(root * X, axis=0)
    U, s, Vt = np.linalg.svd(root * X / np.where(scale > 0, scale, 1.0), full_matrices=False)
    if s[-1] <= COLLINEARITY_RATIO * s[0]:
        involved = [name for name, share in zip(names, np.abs(Vt[-1]), strict=False) if name and share > MIN_NULL_SHARE]
        fault = f"{' and '.join(f'`{name}`' for name in involved)} were never loaded separately"
        raise UserError(fault, remedy="Load each component without the others")
    influence = (Vt.T / s) @ (root * U).T / np.where(scale > 0, scale, 1.0)[:, None]
    coefficients = influence @ rows.channels
    leverage = np.sum(U**2, axis=1)
    return ColumnsFit(coefficients, influence, rows.channels - X @ coefficients, leverage, len(X) - X.shape[1])


def significance(regression: TrimRegression) -> Array:
    """Mean squared t (k,) over the channels for each component: about 1 if its coefficients are noise."""
    sigma = standard_errors(regression.C0_covariance) + np.finfo(float).tiny
    return np.asarray(np.mean((regression.C0 / sigma) ** 2, axis=0))


def inverse_matrix(C0: Array, covariance: Array) -> tuple[Array, Array]:
    """Compute T0 (k, c) with T0 C0 = 1, and its derivatives (k, c, c, k) with respect to the elements of C0.

    T0 is the inverse where there are as many channels as components, otherwise the pseudo-inverse weighted by the
    covariance of the residuals, T0 = (C0' W C0)^-1 C0' W, W = S^-1: the loads then have the least variance (Aitken).
    With N = (C0' W C0)^-1 and P = W (1 - C0 T0),

        dT0 = -T0 dC0 T0 + N dC0' P,

    where P = 0 for as many channels as components.
    """
    W = np.linalg.inv(covariance)
    N = np.linalg.inv(C0.T @ W @ C0)
    T0 = np.asarray(np.linalg.inv(C0) if C0.shape[0] == C0.shape[1] else N @ C0.T @ W)
    P = W @ (np.eye(len(C0)) - C0 @ T0)
    return T0, np.asarray(np.einsum("aj,ib->abij", N, P) - np.einsum("ai,jb->abij", T0, T0))


def inverse_sigma(derivative: Array, C0_covariance: Array) -> Array:
    """Standard errors (k, c) of T0 by the delta method, from the covariance (c, k, c, k) of C0."""
    variance = np.einsum("abij,ijlm,ablm->ab", derivative, C0_covariance, derivative, optimize=True)
    return np.asarray(np.sqrt(variance))


def lack_of_fit(residual: Array, noise: Array, dof: float) -> float:
    """Mean square of the residuals over that of the noise, corrected for the bias of the inverse of its covariance.

    The noise covariance (c, c) is estimated with `dof` degrees of freedom; its inverse is too large by a factor of
    dof/(dof - c - 1).
    """
    c = len(noise)
    unbiased = (dof - c - 1) / dof if dof > c + 1 else 1.0
    return float(np.trace(np.linalg.solve(noise, residual)) / c * unbiased)


def known_lack_of_fit(residual: Array, residual_dof: int, noise: Array, noise_dof: float) -> float:
    """Lack of fit where the noise is known; NaN where it is not.

    It is not known without degrees of freedom, nor where it exceeds the residuals beyond chance: no model leaves less
    than the noise of its rows, so that what was measured as noise was something else (jumps, friction, creep).
    """
    if noise_dof <= 0:
        return float("nan")
    ratio, c = lack_of_fit(residual, noise, noise_dof), len(noise)
    least = stats.f.ppf(CONTRADICTED_NOISE_P_VALUE, c * residual_dof, c * noise_dof)
    return ratio if ratio >= least else float("nan")


def add_variance_floor(covariance: Array, channels: Array) -> Array:
    """Add variances far below any real noise to a covariance (c, c), so that it is invertible."""
    spread = np.ptp(channels, axis=0)
    return covariance + np.diag((NOISE_FLOOR_SHARE * np.where(spread > 0, spread, 1.0)) ** 2)


def loading_directions(rows: TrimRows) -> Array:
    """Direction of the last load change (m, k): +1 up, -1 down, 0 where another component was changed."""
    spread = np.ptp(rows.loads, axis=0)
    steps = np.diff(rows.loads, axis=0, prepend=rows.loads[:1]) / np.where(spread > 0, spread, 1.0)
    steps[np.diff(rows.run, prepend=rows.run[:1]) != 0] = 0.0
    moved = np.argmax(np.abs(steps), axis=1)
    most = steps[np.arange(len(steps)), moved]
    U = np.zeros_like(steps)
    U[np.arange(len(steps)), moved] = np.where(np.abs(most) > MIN_MOVEMENT, np.sign(most), 0.0)
    return U
