"""Weight of the metric part and natural zeros, as a calibration stores them; `tares` estimates them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS

Array = NDArray[np.float64]

MIN_WEIGHT_SIGNIFICANCE = 3.0
"""Standard errors by which the weight must differ from zero for its center of gravity to be stated."""


@dataclass(frozen=True)
class Tares:
    """Weight of the metric part and natural zeros.

    `w` (4,): weight [N] and its first moments about the hub [N m], with covariance (4, 4). `natural_zeros` (c,) [V]:
    reading of the channels without any load, with sigma. Elements of `w` that the balance does not tell (first moments
    where it measures no moments) are zero, without error. `chi2_per_dof` of the zeros of `series_count` load series
    about this model, NaN without degrees of freedom; the standard errors are widened where it is significant.
    `beside_shaft` (c, k) [V/N, V/(N m)]: what channels read of a load on the plate beyond that of the hub load, about a
    shaft with a torque meter, through which the weight does not go; None without such a shaft.
    """

    w: Array
    w_covariance: Array
    natural_zeros: Array
    natural_zeros_sigma: Array
    chi2_per_dof: float
    series_count: int = field(metadata={"stored_as": "sequences"})
    beside_shaft: Array | None = field(default=None, metadata={"omit_if_none": True})

    @property
    def weight(self) -> float:
        """Weight W [N] of the metric side."""
        return float(self.w[0])

    @property
    def weight_sigma(self) -> float:
        """Standard error of W [N]."""
        return float(np.sqrt(self.w_covariance[0, 0]))

    @property
    def center_of_gravity(self) -> Array:
        """Center of gravity (3,) [m] of the metric part from the hub, in rig axes; NaN for an insignificant weight."""
        if not self._weight_is_significant:
            return np.full(3, np.nan)
        return np.where(self._informed[1:], self.w[1:] / self.weight, np.nan)

    @property
    def center_of_gravity_sigma(self) -> Array:
        """Standard errors (3,) of the center of gravity [m]."""
        if not self._weight_is_significant:
            return np.full(3, np.nan)
        derivative = np.column_stack([-self.center_of_gravity, np.eye(3)]) / self.weight
        sigma = np.sqrt(np.diag(derivative @ self.w_covariance @ derivative.T))
        return np.where(self._informed[1:], sigma, np.nan)

    @property
    def _informed(self) -> NDArray[np.bool_]:
        """Elements (4,) of w that the balance tells: without moments not where the weight acts."""
        return np.asarray(np.diag(self.w_covariance) > 0)

    @property
    def _weight_is_significant(self) -> bool:
        return abs(self.weight) > MIN_WEIGHT_SIGNIFICANCE * self.weight_sigma

    def loads(self, gravity: Array, components: tuple[str, ...]) -> Array:
        """Loads (m, k) [N, N m] on these components by the weight of the metric part; gravity (m, 3) in rig axes."""
        return np.asarray(weight_loads(gravity, components) @ self.w)

    def readings_beside_shaft(self, gravity: Array, components: tuple[str, ...]) -> Array:
        """Readings (m, c) [V] by the weight beyond those of its hub loads, as its moment goes beside the shaft."""
        if self.beside_shaft is None:
            return np.zeros((len(gravity), len(self.natural_zeros)))
        return np.asarray(self.loads(gravity, components) @ self.beside_shaft.T)

    def difference_covariance(self, gravity: Array, other: Array, components: tuple[str, ...]) -> Array:
        """Covariance (m, k, k) of what the weight changes between the directions `other` and `gravity` (m, 3)."""
        change = weight_loads(gravity, components) - weight_loads(other, components)
        return np.asarray(change @ self.w_covariance @ change.swapaxes(1, 2))


def weight_loads(gravity: Array, components: tuple[str, ...] = COMPONENTS) -> Array:
    """T(a) (m, k, 4): loads on the balance per element of w = (W, W r), for unit vectors of gravity (m, 3)."""
    force = np.concatenate([gravity[:, :, None], np.zeros((len(gravity), 3, 3))], axis=2)
    moments = np.cross(np.eye(3), gravity[:, None, :]).swapaxes(1, 2)
    moment = np.concatenate([np.zeros((len(gravity), 3, 1)), moments], axis=2)
    return np.concatenate([force, moment], axis=1)[:, [COMPONENTS.index(name) for name in components]]
