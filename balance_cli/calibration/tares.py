"""Natural zeros, and the weight of the metric part, from the zeros of loading sequences in several attitudes.

Loads are applied without the metric part's own weight. In attitude a the unloaded balance reads, in every channel,

    zero(a) = N + C T(a) w,    w = (W, W r),

with the natural zeros N, the straight part C, and the weight W [N] of the metric part at r from the hub [m]: the force
W g(a) and the moment (W r) x g(a) about the hub along the direction of gravity g(a), both linear in w. N and w follow
by generalised least squares from the zeros, which share the errors of the coefficients.

Curved terms depend on the whole load. So the fit is done again with w added to the applied loads, until w settles: what
the zeros then still say of w is its correction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats

from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints
from balance_cli.calibration.outliers import ScreenedFit, screen_outliers
from balance_cli.campaign.rig.attitude import ATTITUDE_TOLERANCE
from balance_cli.campaign.rig.components import COMPONENTS

Array = NDArray[np.float64]
Index = NDArray[np.intp]

TARE_ITERATIONS = 3
# Of a standard error: a change of w that is none.
TARE_TOLERANCE = 0.01
# Distance of the third direction of gravity from the line through two others that tells, some 0.6 deg; unit vectors.
MIN_DIRECTION_SPREAD = 0.01
# Least over largest singular value of the equations, columns scaled, below which they do not tell w.
MIN_SINGULAR_RATIO = 1e-8
# Standard errors by which the weight must differ from zero for its place to be told.
MIN_WEIGHT_SIGNIFICANCE = 3.0
# Probability of a chi-square beyond which the standard errors are widened.
MISFIT_P_VALUE = 1e-3


@dataclass(frozen=True)
class Tares:
    """`w` (4,): weight of the metric part [N] and its first moments about the hub [N m], covariance (4, 4).

    `natural_zeros` (c,) [V]: what the channels read without any load, with sigma. `chi2_per_dof` of the zeros of the
    `sequences` about it, NaN where they are just enough; sigma is widened where it is beyond chance.
    """

    w: Array
    w_covariance: Array
    natural_zeros: Array
    natural_zeros_sigma: Array
    chi2_per_dof: float
    sequences: int

    @property
    def weight(self) -> float:
        """W [N]."""
        return float(self.w[0])

    @property
    def weight_sigma(self) -> float:
        """Standard error of W [N]."""
        return float(np.sqrt(self.w_covariance[0, 0]))

    @property
    def center_of_gravity(self) -> Array:
        """Centre of gravity of the metric part (3,), from the hub in rig axes [m]; NaN where there is no weight."""
        return self.w[1:] / self.weight if self._weight_is_significant else np.full(3, np.nan)

    @property
    def center_of_gravity_sigma(self) -> Array:
        """Standard errors (3,) of the centre [m]."""
        if not self._weight_is_significant:
            return np.full(3, np.nan)
        slope = np.column_stack([-self.center_of_gravity, np.eye(3)]) / self.weight
        return np.asarray(np.sqrt(np.diag(slope @ self.w_covariance @ slope.T)))

    @property
    def _weight_is_significant(self) -> bool:
        return abs(self.weight) > MIN_WEIGHT_SIGNIFICANCE * self.weight_sigma

    def loads(self, gravity: Array, components: tuple[str, ...]) -> Array:
        """Loads (m, k) [N, N m] of the metric part's weight on these components, gravity (m, 3) in rig axes."""
        return np.asarray(weight_loads(gravity, components) @ self.w)


def weight_loads(gravity: Array, components: tuple[str, ...] = COMPONENTS) -> Array:
    """T(a) (m, k, 4): loads on the balance by w = (W, W r), gravity (m, 3) unit vectors in rig axes."""
    force = np.concatenate([gravity[:, :, None], np.zeros((len(gravity), 3, 3))], axis=2)
    moments = np.cross(np.eye(3), gravity[:, None, :]).swapaxes(1, 2)
    moment = np.concatenate([np.zeros((len(gravity), 3, 1)), moments], axis=2)
    return np.concatenate([force, moment], axis=1)[:, [COMPONENTS.index(name) for name in components]]


def screen_outliers_with_tares(
    points: CalibrationPoints, search: bool = True
) -> tuple[CalibrationPoints, ScreenedFit, Tares | None]:
    """The points with the loads of the metric part added, what `suspects.screen_outliers` makes of these, and the
    tares.

    The points as they are, and None, where the attitudes do not tell it.
    """
    found = screen_outliers(points, search)
    tares, total = estimate_tares(points, found.fit), points
    for _ in range(TARE_ITERATIONS if tares is not None else 0):
        assert tares is not None
        total = add_weight_loads(points, tares)
        found = screen_outliers(total, search)
        again = estimate_tares(total, found.fit, tares.w)
        if again is None:
            break
        change, tares = np.abs(again.w - tares.w), again
        if np.all(change <= TARE_TOLERANCE * np.sqrt(np.diag(tares.w_covariance))):
            break
    return total, found, tares


def add_weight_loads(points: CalibrationPoints, tares: Tares) -> CalibrationPoints:
    """The points with the loads of the metric part in the attitude of each stretch added to those applied."""
    assert points.gravity is not None
    return replace(points, loads=points.loads + tares.loads(segment_mean_gravity(points), points.components))


def segment_mean_gravity(points: CalibrationPoints) -> Array:
    """Gravity (m, 3), for each row the mean over its stretch."""
    assert points.gravity is not None
    stretch = points.stretch
    sums = np.zeros((stretch[-1] + 1, 3))
    np.add.at(sums, stretch, points.gravity)
    return np.asarray((sums / np.bincount(stretch)[:, None])[stretch])


def estimate_tares(
    points: CalibrationPoints, fit: CalibrationModelFit, added_weight: Array | None = None
) -> Tares | None:
    """What the zeros of a fit tell, of loads to which the weight `before` (4,) was added already (default: none).

    None where a run does not state its attitude, there are fewer than three directions of gravity, or they lie in line.
    """
    if points.gravity is None or not np.isfinite(points.gravity).all():
        return None
    gravity, is_constant = _series_gravity(points, np.asarray(np.isfinite(fit.residuals).all(axis=1)))
    if np.count_nonzero(is_constant) == 0 or not _directions_suffice(gravity[is_constant]):
        return None
    k = len(points.components)
    slope = fit.model.coefficients[:k].T / fit.model.full_range
    effect = np.einsum("ck,skw->csw", slope, weight_loads(gravity[is_constant], points.components))
    covariance = fit.zero_covariance[:, is_constant][:, :, is_constant]
    solved = _solve_tares(effect, fit.model.zeros[is_constant].T, covariance, fit.model.residual_covariance)
    return None if solved is None else _tares_from_solution(*solved, added_weight)


def _series_gravity(points: CalibrationPoints, used: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
    """Gravity (s, 3) of the sequences that have rows which took part (m,), and in which (s,) it was constant."""
    assert points.gravity is not None
    sequence, means = points.sequence, segment_mean_gravity(points)
    names = np.unique(sequence[used])
    away = np.linalg.norm(points.gravity - means, axis=1)
    is_constant = np.array([away[(sequence == name) & used].max() <= ATTITUDE_TOLERANCE for name in names])
    return np.array([means[np.argmax(sequence == name)] for name in names]), is_constant


def _directions_suffice(gravity: Array) -> bool:
    """Whether directions (s, 3) are at least three, and not in line."""
    away = gravity - gravity[0]
    along = away[np.argmax(np.linalg.norm(away, axis=1))]
    length = np.linalg.norm(along)
    if length < MIN_DIRECTION_SPREAD:
        return False
    return bool(np.max(np.linalg.norm(np.cross(away, along / length), axis=1)) >= MIN_DIRECTION_SPREAD)


def _solve_tares(
    effect: Array, zeros: Array, covariance: Array, residual: Array
) -> tuple[Array, Array, float, int] | None:
    """N and w (c + 4,), their covariance, chi-square and sequences, of effect (c, s, 4), zeros (c, s), covariance

    (c, s, s) of each channel's zeros and that of the residuals (c, c): zeros of two channels are as alike as their
    residuals. None where the equations do not tell it, or there is no noise.
    """
    c, s, _ = effect.shape
    size = np.sqrt(np.diag(residual))
    if np.any(size == 0):
        return None
    natural = np.repeat(np.eye(c)[:, None], s, axis=1)
    table = np.concatenate([natural, effect, zeros[:, :, None]], axis=2)
    own = [
        linalg.solve_triangular(np.linalg.cholesky(K), of, lower=True) for K, of in zip(covariance, table, strict=True)
    ]
    correlation_root = np.linalg.cholesky(residual / (size[:, None] * size))
    white = linalg.solve_triangular(correlation_root, np.reshape(own, (c, -1)), lower=True).reshape(c * s, -1)
    X, y = white[:, :-1], white[:, -1]
    scale = np.linalg.norm(X, axis=0)
    if not np.all(scale > 0) or len(y) < len(scale):
        return None
    U, d, Vt = np.linalg.svd(X / scale, full_matrices=False)
    if d[-1] < MIN_SINGULAR_RATIO * d[0]:
        return None
    root = Vt.T / d / scale[:, None]
    found = root @ (U.T @ y)
    return found, root @ root.T, float(np.sum((y - X @ found) ** 2)), s


def _tares_from_solution(
    found: Array, covariance: Array, chi2: float, sequences: int, added_weight: Array | None
) -> Tares:
    c = len(found) - 4
    dof = c * sequences - len(found)
    ratio = chi2 / dof if dof else float("nan")
    if dof and stats.chi2.sf(chi2, dof) < MISFIT_P_VALUE:
        covariance = covariance * ratio
    return Tares(
        w=found[c:] + (0.0 if added_weight is None else added_weight),
        w_covariance=covariance[c:, c:],
        natural_zeros=found[:c],
        natural_zeros_sigma=np.sqrt(np.diag(covariance)[:c]),
        chi2_per_dof=ratio,
        sequences=sequences,
    )
