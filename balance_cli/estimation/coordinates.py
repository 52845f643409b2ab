"""Coordinates in which a fit takes its steps: those that make the scale of the whole rig a straight line.

Multiplying all masses, inertias and stiffnesses by one factor leaves every response unchanged. In the parameters
themselves this valley is curved, and steps along it must be tiny; with logarithms of the positive parameters, and
products of inertia relative to sqrt(Iii Ijj), it is straight. Logarithms also keep these parameters positive.
Parameters of effects may be zero; those with units of kg or N are taken relative to the mass.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.parameters import ParameterSet

Array = NDArray[np.float64]

POSITIVE_PARAMETERS = (
    "stiffness.",
    "mass",
    "inertia.xx",
    "inertia.yy",
    "inertia.zz",
)
POSITIVE_SHAFT_PARAMETERS = (".stiffness", ".inertia")
"""Endings of the names of parameters of torque meters."""

SCALE_EXPONENT = {
    "kg": 1.0,
    "kg m2": 1.0,
    "N/m": 1.0,
    "N m/rad": 1.0,
    "N s/m": 1.0,
    "m/N": -1.0,
    "rad/(N m)": -1.0,
    "N/m2": 2.0,
    "N/m3": 3.0,
    "N s2/m2": 2.0,
    "m/s": -1.0,
}
"""Exponent of a parameter's growth with the scale of the rig, by its unit: the loads stay, so deflections shrink."""

INERTIA_UNITS = ("kg", "kg m2")
"""Units of masses and moments of inertia."""


@dataclass(frozen=True)
class Coordinates:
    """Map between parameters theta (p,) and coordinates z (p,).

    `logarithmic` (p,): z = ln theta; `vanishing` (p,): those among them that may go to zero. `products` (r, 3) has rows
    (product, i, j) of indices with z = theta / sqrt(theta_i theta_j). `power` (p,): z = theta (m0 / m)^power, with the
    parameter m at index `mass` and its declared value m0. All other parameters are their own coordinates.
    """

    logarithmic: NDArray[np.bool_]
    vanishing: NDArray[np.bool_]
    products: NDArray[np.intp]
    power: Array
    mass: int
    m0: float

    def _scale_factor(self, theta: Array) -> Array:
        return np.asarray((theta[self.mass] / self.m0) ** self.power)

    def to_coordinates(self, theta: Array) -> Array:
        """Coordinates of a parameter vector."""
        z = np.asarray(theta, float) / self._scale_factor(theta)
        for product, i, j in self.products:
            z[product] = theta[product] / np.sqrt(theta[i] * theta[j])
        z[self.logarithmic] = np.log(theta[self.logarithmic])
        return z

    def to_parameters(self, z: Array) -> Array:
        """Parameters at coordinates z."""
        theta = np.array(z, float)
        theta[self.logarithmic] = np.exp(z[self.logarithmic])
        for product, i, j in self.products:
            theta[product] = z[product] * np.sqrt(theta[i] * theta[j])
        return np.asarray(theta * self._scale_factor(theta))

    def jacobian(self, theta: Array) -> Array:
        """The derivative d theta / d z (p, p) at theta."""
        J = np.diag(np.where(self.logarithmic, theta, self._scale_factor(theta)))
        for product, i, j in self.products:
            J[product, product] = np.sqrt(theta[i] * theta[j])
            J[product, i] = J[product, j] = 0.5 * theta[product]
        J[:, self.mass] += self.power * theta
        return J


def _has_positive_nature(name: str) -> bool:
    """Whether a parameter of the rigid balance is a stiffness, mass or moment of inertia."""
    of_shaft = name.startswith("torque_meter.") and name.endswith(POSITIVE_SHAFT_PARAMETERS)
    return of_shaft or name.startswith(POSITIVE_PARAMETERS)


def coordinates(parameters: ParameterSet, start: Array, near_minimum: bool = False) -> Coordinates:
    """Logarithms of the free stiffnesses, masses and inertias; products of inertia and effects relative to these.

    An effect's mass or inertia that is not zero at the `start` (p,) of the fit is logarithmic too: far from the minimum
    only its order of magnitude is known. `near_minimum` it is not: a body of mass m on a compliance c yields by
    c + w^2 m c^2 below its resonance, so that the data leave a line in m, which the logarithm would bend.
    """
    names = parameters.names
    plate = np.array([_has_positive_nature(name) for name in names])
    products = []
    for pair in ("xy", "xz", "yz"):
        if f"inertia.{pair}" in names:
            products.append([names.index(f"inertia.{part}") for part in (pair, pair[0] * 2, pair[1] * 2)])
    product_indices = np.array(products, dtype=np.intp).reshape(-1, 3)
    plate[product_indices[:, 0]] = True
    inertia = ~plate & np.isin(parameters.units, INERTIA_UNITS) & (parameters.lower == 0) & (start > 0)
    logarithmic = (plate & (parameters.value > 0) | inertia & (not near_minimum)) & parameters.free
    logarithmic[product_indices[:, 0]] = False
    mass = names.index("mass") if "mass" in names else 0
    relative = ~plate & ~logarithmic if logarithmic[mass] else np.zeros(len(names), bool)
    power = np.where(relative, [SCALE_EXPONENT.get(unit, 0.0) for unit in parameters.units], 0.0)
    return Coordinates(logarithmic, logarithmic & inertia, product_indices, power, mass, float(parameters.value[mass]))
