"""What an effect tells the search of the diagnosis about itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.places import Where

Start = Mapping[str, float]
"""Starting values of a fit by the fitted names of the parameters; those not named begin at their own start."""

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class ChannelRatio:
    """The ratio of a channel with the effect to a channel of the same cell without it, as one parameter shapes it.

    `log_ratio` and its derivative by the parameter are given at s = j w (K,); the ratio is one where the parameter is
    zero. `sizes`: smallest and largest magnitude from which a fit begins, in units of w to the power `rate_exponent`, w
    being the median angular frequency of the lines. `one_sided`: the parameter is not negative;
    otherwise a negative one is the same effect, positive, in the other channel. `start(value)`: the effect's
    parameters that make this ratio.

    `sensitivity`: the declared tolerance of the sensitivities covers this difference. `at_rest`: however small the
    parameter, the response at rest changes by a finite amount, which no derivative at the null shows.

    `finding` is a sentence about `{channel}`, `{reference}` and `{size}`; `shown(value, sigma)` is the size in `unit`
    with its standard deviation. `names_positive`: the channel named is the one in which the parameter is positive.
    """

    log_ratio: Callable[[ComplexArray, float], ComplexArray]
    derivative: Callable[[ComplexArray, float], ComplexArray]
    sizes: tuple[float, float]
    start: Callable[[float], Start]
    finding: str
    shown: Callable[[float, float], tuple[float, float]]
    unit: str = ""
    one_sided: bool = False
    sensitivity: bool = False
    at_rest: bool = False
    names_positive: bool = False
    rate_exponent: int = 0


@dataclass(frozen=True)
class PointMassParameters:
    """Names of the parameters of a point mass on the metric side: its mass [kg] and its position x, y, z [m].

    `damping_share`: how far the plate's damping follows the mass, from 0 (not at all) to 1.
    """

    mass: str
    position: tuple[str, str, str]
    damping_share: str

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the mass and of its position."""
        return (self.mass, *self.position)


@dataclass(frozen=True)
class ToneParameters:
    """Fitted names of the parameters of a tone: its amplitude, squared, and its frequency [Hz].

    Chi-square has a minimum along the frequency for each lobe of a record's spectrum, so the frequency is searched.
    The effect adds exactly one interference tone to the equations.
    """

    power: str
    frequency: str


@dataclass(frozen=True)
class CommonAlternative:
    """The effect `label` (with its place) that looks the same where an effect acts on all channels.

    `separated_by`: what tells them apart.
    """

    label: str
    separated_by: str


@dataclass(frozen=True)
class BodyMode:
    """A body on a spring in one of its motions: eigenfrequency [Hz] and compliance [m/N or rad/(N m)].

    `explained`: the share of the motion that it explains, of what is not in proportion to the force.
    """

    frequency: float
    compliance: float
    explained: float

    @property
    def inertia(self) -> float:
        """Mass [kg] or moment of inertia [kg m2]."""
        return 1.0 / (self.compliance * (2 * np.pi * self.frequency) ** 2)


@dataclass(frozen=True)
class SearchHints:
    """How a search finds an effect; an effect without hints is scored once, at the null, at each of its places.

    - `places(geometry)`: the places worth trying, where not all are. A large place is reduced after it is fitted.
    - `starts(geometry, where)`: values from which a fit begins; several where one start may end in a wrong minimum.
    - `extra_starts(geometry, where)`: further starts at which only the score is computed, for an effect whose nuisance
      parameters matter as much as its size; `start_from_score(geometry, where, start, step)` then gives the values
      from which a fit begins, `step` being the score test's estimate of the parameters that have a null.
    - `restarts(geometry, where)`: sets of values; each may replace those of a fit in a wrong minimum.
    - `body_start(start, modes)`: values from which a non-metric side with these modes, by motion, is fitted, about the
      center of another start.
    - `inaccuracy`: shares of the effect's own signature that noise in the measured motion leaves uncertain, in periodic
      records and in others. Smaller effects beside a large one of this kind are rejected.
    - `at_most_once`: a rig has the effect at one place at most.
    - `start_at_frequency(frequency)`: values from which a resonance at a frequency [Hz] is fitted.
    - `best_place(where, values)`: the same effect declared at the place where its parameters are determined best.
    - `channel_ratio`: the difference between two channels of one cell that the effect explains.
    - `point_mass`: the effect is a point mass, which can be scored at all positions at once.
    - `tone`: the effect is a tone, whose frequency is searched over the lobes of the spectrum.
    - `on_request`: the search tries it only where a user asks for it.
    - `alike_in_all`: the effect that looks the same where this one acts on all channels, or on all exciters.
    - `whole_fit_starts(geometry)`: at `all` exciters it turns the phase of all channels; whole fits begin here.
    - `in_every_set_up`: each set-up of the exciters may have it, with a value of its own, so that all places are tried
      at once, those on request as well. The first name of a place is the component excited, the last one what it
      acts on.
    """

    places: Callable[[Geometry], tuple[Where, ...]] | None = None
    starts: Callable[[Geometry, Where], tuple[Start, ...]] | None = None
    extra_starts: Callable[[Geometry, Where], tuple[Start, ...]] | None = None
    start_from_score: Callable[[Geometry, Where, Start, Start], Start] | None = None
    restarts: Callable[[Geometry, Where], tuple[Start, ...]] | None = None
    body_start: Callable[[Start, Mapping[str, BodyMode]], Start] | None = None
    inaccuracy: tuple[float, float] = (0.0, 0.0)
    at_most_once: bool = False
    start_at_frequency: Callable[[float], Start] | None = None
    best_place: Callable[[Where, Mapping[str, float]], tuple[Where, Mapping[str, float]]] | None = None
    channel_ratio: ChannelRatio | None = None
    point_mass: PointMassParameters | None = None
    tone: ToneParameters | None = None
    alike_in_all: CommonAlternative | None = None
    whole_fit_starts: Callable[[Geometry], tuple[Start, ...]] | None = None
    on_request: bool = False
    in_every_set_up: bool = False

    def restart_values(self, geometry: Geometry, where: Where) -> tuple[Start, ...]:
        """Return the sets of values of `restarts`, none without them."""
        return () if self.restarts is None else self.restarts(geometry, where)
