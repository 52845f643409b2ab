"""Coordinates in which a fit steps: those that make the scale of the whole rig a straight line.

Multiplying all masses, inertias and stiffnesses by one factor leaves every response as it is. In the parameters
themselves that valley is curved and steps along it must be tiny; with logarithms of the positive ones, and products of
inertia relative to sqrt(Iii Ijj), it is straight. Logarithms also keep positive what must be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.parameters import ParameterSet

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Coordinates:
    """Map between parameters theta (p,) and coordinates z (p,).

    `logarithmic` (p,): z = ln theta; `products` (r, 3) rows (product, i, j) of indices: z = theta / sqrt(theta_i
    theta_j); the others are themselves.
    """

    logarithmic: NDArray[np.bool_]
    products: NDArray[np.intp]

    def inward(self, theta: Array) -> Array:
        """Coordinates of a parameter vector."""
        z = np.array(theta, float)
        for product, i, j in self.products:
            z[product] = theta[product] / np.sqrt(theta[i] * theta[j])
        z[self.logarithmic] = np.log(theta[self.logarithmic])
        return z

    def outward(self, z: Array) -> Array:
        """Parameters at coordinates z."""
        theta = np.array(z, float)
        theta[self.logarithmic] = np.exp(z[self.logarithmic])
        for product, i, j in self.products:
            theta[product] = z[product] * np.sqrt(theta[i] * theta[j])
        return theta

    def jacobian(self, theta: Array) -> Array:
        """The derivative d theta / d z (p, p) at theta."""
        J = np.diag(np.where(self.logarithmic, theta, 1.0))
        for product, i, j in self.products:
            J[product, product] = np.sqrt(theta[i] * theta[j])
            J[product, i] = J[product, j] = 0.5 * theta[product]
        return J


def coordinates(parameters: ParameterSet) -> Coordinates:
    """Logarithms of the free stiffnesses, masses and inertias; products of inertia relative to these."""
    names = parameters.names
    logarithmic = np.array([name.startswith(POSITIVE) or name.endswith(POSITIVE_ENDS) for name in names])
    products = []
    for pair in ("xy", "xz", "yz"):
        if f"inertia.{pair}" in names:
            products.append([names.index(f"inertia.{part}") for part in (pair, pair[0] * 2, pair[1] * 2)])
    chosen = np.array(products, dtype=np.intp).reshape(-1, 3)
    return Coordinates(logarithmic & parameters.free & (parameters.value > 0), chosen)


POSITIVE = ("stiffness.", "mass", "inertia.xx", "inertia.yy", "inertia.zz", "torque_meter.inertia")
POSITIVE_ENDS = (".stiffness",)
