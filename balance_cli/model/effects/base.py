"""What an effect is: one physical property that the rigid balance lacks, defined in one file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.places import Choice, Where
from balance_cli.model.effects.search_hints import SearchHints
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect: name, unit, null, scale, description and bounds.

    At its null the effect does nothing; `scale` is the size of a change that matters. `start` is where a fit begins
    when the null is singular for other parameters (a mass without compliance does nothing). A `nuisance` parameter
    does nothing while the others are at their nulls: it only shapes what they do once they differ from them. Its own
    null is the value at which it then stays.

    A `held` parameter is never fitted: it stays as declared, or at its start.

    A `reciprocal` parameter has an infinite null (the cutoff of a low-pass). Its reciprocal is fitted, and passed to
    the effect, under the name `1/NAME`; `scale` and `start` are those of the reciprocal. The data determine a `squared`
    parameter only by its square, which is fitted under the name `NAME^2`; `scale` is that of the parameter itself.
    """

    name: str
    unit: str
    null: float
    scale: float
    description: str
    lower: float = -np.inf
    upper: float = np.inf
    start: float | None = None
    nuisance: bool = False
    reciprocal: bool = False
    squared: bool = False
    held: bool = False

    @property
    def fitted_name(self) -> str:
        """The name under which the parameter is fitted."""
        return f"{self.name}^2" if self.squared else f"1/{self.name}" if self.reciprocal else self.name

    @property
    def fitted_unit(self) -> str:
        """The unit of the fitted value."""
        return f"{self.unit}2" if self.squared else f"1/{self.unit}" if self.reciprocal else self.unit

    @property
    def fitted_null(self) -> float:
        """The null of the fitted value."""
        return float(self.fitted_value(self.null))

    @property
    def fitted_start(self) -> float:
        """The fitted value at which a fit begins."""
        return self.fitted_null if self.start is None else self.start

    @property
    def fitted_bounds(self) -> tuple[float, float]:
        """Lower and upper bound of the fitted value."""
        bounds = (self.fitted_value(self.lower), self.fitted_value(self.upper))
        return (min(bounds), max(bounds))

    @property
    def fitted_scale(self) -> float:
        """The size of a change of the fitted value that matters."""
        return self.scale**2 if self.squared else self.scale

    def fitted_value(self, value: float) -> float:
        """The fitted value that belongs to a value of the parameter."""
        if self.squared:
            return value**2
        if not self.reciprocal:
            return value
        return np.inf if value == 0 else 1.0 / value

    def physical_value(self, fitted_value: float) -> float:
        """The value of the parameter that belongs to a fitted value."""
        return float(np.sqrt(max(fitted_value, 0.0))) if self.squared else self.fitted_value(fitted_value)

    def physical_sigma(self, fitted_value: float, sigma: float) -> float:
        """Standard deviation of the parameter where that of the fitted value is `sigma`."""
        if self.squared:
            return sigma / (2.0 * float(np.sqrt(max(fitted_value, 0.5 * sigma)))) if sigma > 0 else 0.0
        if not self.reciprocal:
            return sigma
        return np.inf if fitted_value == 0 else sigma / fitted_value**2


@dataclass(frozen=True)
class Effect:
    """An effect: what it is, where it acts, where it was published, and what it adds to the equations.

    - `summary`, `validity`, `reference`: one sentence each; `signature` is what the effect leaves in a residual when
      the model lacks it; `separated_by` is the measurement that distinguishes it from effects that look alike.
    - `place` describes a place in words; `places(geometry)` are all its possible places; `parameters(geometry, where)`
      are its parameters at one of them.
    - `apply(equations, geometry, where, values)` adds the effect, `values` being its fitted parameters as dual numbers
      by name. With every parameter at its null the equations stay as they are. The formulas stand at the head of the
      effect's file.
    - `choice`: each of its words makes a place of its own, as the last name of `where`.
    - `empirical`: the effect describes without explaining; it is tried only after all others.
    - `needs_mean`: it shows in the mean of a record, in the curvature of static rows or through channels as functions
      of time. `needs_spin`: it shows only with the rotor turning. `is_zero_reading`: it is a reading without load, on
      which nothing but the mean of a channel depends in a linear model. `is_load_gain`: a gain of an
      exciter's load.
    - `search`: how the diagnosis finds it.
    """

    name: str
    summary: str
    validity: str
    reference: str
    signature: str
    separated_by: str
    place: str
    places: Callable[[Geometry], tuple[Where, ...]]
    parameters: Callable[[Geometry, Where], tuple[EffectParameter, ...]]
    apply: Callable[[Equations, Geometry, Where, Mapping[str, Dual]], Equations]
    choice: Choice | None = None
    empirical: bool = False
    needs_mean: bool = False
    needs_spin: bool = False
    is_zero_reading: bool = False
    is_load_gain: bool = False
    search: SearchHints = field(default_factory=SearchHints)
