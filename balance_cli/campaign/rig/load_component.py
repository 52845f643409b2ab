"""One load component as a geometry declares it."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.declared_values import FrozenModel, Vector

COMPONENT_PATTERN = r"^[A-Za-z][A-Za-z0-9_.]*$"
"""Of the name of a component: a word, because the names of terms join it with others (`N1 |Y2|`, `A^2`)."""


class LoadComponent(FrozenModel):
    """A load component of the user's own: a force along `direction`, or a moment about the axis `moment`.

    `position` [m]: of a force, a point on its line of action (force balance format: forces at stations); of a moment,
    the point about which it is taken (moment balance format). By default both refer to the hub.
    """

    name: Annotated[str, Field(min_length=1, max_length=40, pattern=COMPONENT_PATTERN)]
    direction: Vector | None = None
    moment: Vector | None = None
    position: Vector | None = None

    @model_validator(mode="after")
    def _check_one_axis(self) -> LoadComponent:
        if self.name in COMPONENTS:
            if (self.direction, self.moment, self.position) != (None, None, None):
                raise ValueError(f"`{self.name}` is a hub load, whose axis and point are fixed: give the name alone")
            return self
        axis = self.direction or self.moment
        if axis is None or (self.direction is not None and self.moment is not None):
            raise ValueError("give `direction: [x, y, z]` of a force or `moment: [x, y, z]`, the axis of a moment")
        if float(np.linalg.norm(axis)) == 0.0:
            raise ValueError("`direction` or `moment` has no length")
        return self
