"""The balance model: a geometry, its parameters, and the system that they define."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_checks import require_mechanics
from balance_cli.io.errors import UserError
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.parameters import ParameterSet, declared_parameters
from balance_cli.model.placed_effects import PlacedEffect, apply_placed_effects, declared_effects, effect_parameters
from balance_cli.model.rigid import rigid_equations
from balance_cli.model.system import System, assemble_system

Array = NDArray[np.float64]

NEGATIVE_INERTIA = 1e-9
"""Of the largest inertia; rounding alone leaves less."""


@dataclass(frozen=True)
class BalanceModel:
    """A rig as equations in its parameters: plate, shaft, channels and the `effects` declared in the geometry."""

    geometry: Geometry
    parameters: ParameterSet
    effects: tuple[PlacedEffect, ...] = ()

    def system(self, theta: Array | None = None, derivatives: bool = True) -> System:
        """The system at the full parameter vector `theta`, by default the declared one.

        Its derivatives refer to the free parameters only, in their order. Without `derivatives` it has none, and is
        assembled in a third of the time.
        """
        vector = self.parameters.value if theta is None else np.asarray(theta, float)
        unit = np.eye(len(vector))
        dual = Dual(vector, unit[self.parameters.free] if derivatives else unit[:0])
        value = {name: dual[i] for i, name in enumerate(self.parameters.names)}
        rigid = rigid_equations(self.geometry, value, dual.parameters)
        return assemble_system(apply_placed_effects(rigid, self.geometry, self.effects, value))

    def at(self, theta: Array | None = None) -> Estimate:
        """The model with values `theta` (p,) of its parameters, by default the declared ones."""
        return Estimate(self, self.parameters.value if theta is None else theta)

    def free_all_parameters(self) -> BalanceModel:
        """The same model with derivatives for every parameter, including exact ones."""
        sigma = np.where(self.parameters.sigma > 0, self.parameters.sigma, self.parameters.scale)
        return self.with_sigma(sigma)

    def with_sigma(self, sigma: Array) -> BalanceModel:
        """The same model with other prior standard deviations (p,); 0 holds a parameter."""
        return replace(self, parameters=replace(self.parameters, sigma=sigma))

    def with_exact_effects(self) -> BalanceModel:
        """The same model with its effects held at their declared values, for which no tolerance is declared."""
        sigma = self.parameters.sigma
        return self.with_sigma(np.where(np.isfinite(sigma), sigma, 0.0))


@dataclass(frozen=True)
class Estimate:
    """A model with values `theta` (p,) of its parameters, fitted ones or those from which a fit starts."""

    model: BalanceModel
    theta: Array

    @property
    def geometry(self) -> Geometry:
        """The geometry with the effects of the model."""
        return self.model.geometry

    def system(self, derivatives: bool = True) -> System:
        """The system at these values, as `BalanceModel.system`."""
        return self.model.system(self.theta, derivatives)


def balance_model(geometry: Geometry) -> BalanceModel:
    """The model of a declared rig; raises UserError where masses, stiffness or damping are not declared."""
    require_mechanics(geometry)
    effects = declared_effects(geometry)
    return BalanceModel(geometry, declared_parameters(geometry) + effect_parameters(effects), effects)


def _has_positive_inertia(geometry: Geometry) -> bool:
    if not geometry.effects:
        return True
    try:
        mass = balance_model(geometry).system().equations.mass.value
    except np.linalg.LinAlgError:  # the damping of the modes has no solution
        return False
    if not np.isfinite(mass).all():
        return False
    least, largest = np.linalg.eigvalsh(mass)[[0, -1]]
    return bool(least >= -NEGATIVE_INERTIA * abs(largest))


def check_effects(geometry: Geometry, file: str) -> None:
    """Raise UserError, with the file named, where an effect is unknown, has no such place, or is not physical."""
    try:
        if not _has_positive_inertia(geometry):
            names = ", ".join(f"`{effect.name}`" for effect in geometry.effects)
            fault = f"these parameters are not physical: the inertia with {names} is not positive"
            raise UserError(fault, place="effects", remedy="Check the masses of the effects")
    except UserError as error:
        raise error.with_location(file) from error
