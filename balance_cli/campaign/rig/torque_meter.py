"""Torque meters: springs in a shaft that carries one moment of the hub, in a row from the hub to its end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from pydantic import SerializerFunctionWrapHandler, model_serializer

from balance_cli.campaign.rig.components import COMPONENTS, FREEDOMS
from balance_cli.campaign.rig.declared_values import Array, FrozenModel, Name, Positive

FREEDOM_ABOUT = {"x": "phi", "y": "theta", "z": "psi"}
"""The rotation of the plate about each axis."""


class TorqueMeter(FrozenModel):
    """A torque meter in a shaft: stiffness [N m/rad], inertia of the parts that turn on its side of the hub [kg m2].

    The moment about `axis` goes through it. Where it is `carried_by` the ground the shaft ends beside the plate; by the
    plate, the drive stands on the plate, which feels the reaction. One of several has a `name`.
    """

    name: Name | None = None
    stiffness: Positive
    inertia: Positive
    axis: Literal["x", "y", "z"] = "z"
    carried_by: Literal["ground", "plate"] = "ground"

    @model_serializer(mode="wrap")
    def _leave_out_defaults(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without name, axis and place where they are those of a geometry with one meter."""
        plain: dict[str, Any] = serialize(self)
        unsaid = {"name": None, "axis": "z", "carried_by": "ground"}
        return {key: value for key, value in plain.items() if key not in unsaid or value != unsaid[key]}

    @property
    def component(self) -> str:
        """The hub load that goes through it."""
        return f"M{self.axis}"

    @property
    def parameter(self) -> str:
        """Beginning of the names of its parameters, `torque_meter` or `torque_meter.NAME`."""
        return "torque_meter" if self.name is None else f"torque_meter.{self.name}"

    def label(self, word: str) -> str:
        """Return the word with the name of the meter, where it has one."""
        return word if self.name is None else f"{word} {self.name}"


def next_in_shaft(meters: Sequence[TorqueMeter], index: int) -> int | None:
    """Return the index of the next meter towards the end of the same shaft; None for the last one."""
    later = range(index + 1, len(meters))
    return next((i for i in later if meters[i].axis == meters[index].axis), None)


def first_in_shaft(meters: Sequence[TorqueMeter], index: int) -> bool:
    """Return whether the hub turns this meter directly."""
    return all(meter.axis != meters[index].axis for meter in meters[:index])


def twist_rows(meters: Sequence[TorqueMeter]) -> tuple[Array, Array]:
    """Return the twist of m meters per rotation of their hub sides (m, m), and per motion of the plate (m, 6)."""
    own, plate = np.eye(len(meters)), np.zeros((len(meters), len(FREEDOMS)))
    for i, meter in enumerate(meters):
        following = next_in_shaft(meters, i)
        if following is not None:
            own[i, following] = -1.0
        elif meter.carried_by == "plate":
            plate[i, FREEDOMS.index(FREEDOM_ABOUT[meter.axis])] = -1.0
    return own, plate


def shaft_inputs(meters: Sequence[TorqueMeter]) -> Array:
    """Return the torque (m, 6) on the hub side of each meter per unit hub load: the hub turns the first of a shaft."""
    rows = np.zeros((len(meters), len(COMPONENTS)))
    for i, meter in enumerate(meters):
        rows[i, COMPONENTS.index(meter.component)] = float(first_in_shaft(meters, i))
    return rows
