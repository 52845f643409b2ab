"""Choice between descriptions of the same data, the noise of which is known.

Orders are those of Akaike's criterion (IEEE Trans. Autom. Control 19, 1974), V + 2 p with the squared whitened
residuals V and p complex parameters. It keeps a simple description until V - V' of a richer one is twice the dp
parameters that that has more, which with many channels is many standard deviations: a bias remains that is as large as
the noise of these parameters, and that no sigma contains. Whether a window is halved, which alone makes such a bias
small, is therefore tested: if the simple description holds, V - V' is half of a chi-square of 2 dp degrees of freedom
(Wilks, Ann. Math. Stat. 9 (1938) 60).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.distributions import chi2

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

REFUTATION_LEVEL = 0.01
"""Chance to refute a description that holds. That costs some noise, which sigma contains; a wrong description that is
kept costs bias, which it does not. With 0.05 errors of long records were 5 % larger."""


@dataclass(frozen=True)
class Descriptions:
    """Descriptions of W sets of data: `cost` (W,), the sum of squares of whitened residuals, and complex `parameters`.

    `places` (W,) is the logarithm of the number of places among which the best were found for its poles.
    """

    cost: Array
    parameters: Array
    places: Array

    def subset(self, selected: Index) -> Descriptions:
        """Return the selected descriptions."""
        return Descriptions(self.cost[selected], self.parameters[selected], self.places[selected])

    def __add__(self, other: Descriptions) -> Descriptions:
        """Return the descriptions of both sets of data side by side."""
        return Descriptions(self.cost + other.cost, self.parameters + other.parameters, self.places + other.places)


def is_refuted(simple: Descriptions, rich: Descriptions) -> Mask:
    """Return whether (W,) the residuals of descriptions are larger than chance explains, beside those of richer ones.

    Each place where a pole could have been is one more chance (Bonferroni). Of as many parameters, less residual wins.
    """
    more = rich.parameters - simple.parameters
    level = REFUTATION_LEVEL * np.exp(-np.maximum(rich.places - simple.places, 0.0))
    chance = 0.5 * chi2.isf(level, 2.0 * np.maximum(more, 0.5))
    return np.asarray(simple.cost - rich.cost > np.where(more > 0.0, chance, 0.0))


def is_preferred(one: Descriptions, other: Descriptions) -> Mask:
    """Return whether (W,) the first of two descriptions is the simpler and not refuted, or the richer and refutes."""
    return np.where(one.parameters < other.parameters, ~is_refuted(one, other), is_refuted(other, one))


def akaike_choice(candidates: Sequence[Descriptions]) -> Index:
    """Return for each set of data which (W,) of the candidates Akaike's criterion selects.

    A pole costs the logarithm of the number of its places twice, because its position is the best of them.
    """
    return np.asarray(np.argmin([one.cost + 2.0 * (one.parameters + one.places) for one in candidates], axis=0))


def take_each(candidates: Sequence[Descriptions], choice: Index) -> Descriptions:
    """Return of each set of data the description that `choice` (W,) names."""
    each = choice, np.arange(len(choice))
    cost, parameters, places = (
        np.array(part)[each] for part in zip(*((d.cost, d.parameters, d.places) for d in candidates), strict=True)
    )
    return Descriptions(cost, parameters, places)
