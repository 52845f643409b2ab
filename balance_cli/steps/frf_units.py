"""Units of measured frequency responses: readings of a channel for one unit of a load, whatever the file has."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.frf_map import MappedReference, MappedResponse
from balance_cli.campaign.rig.channel import Channel
from balance_cli.importers.frf.functions import FrfFunction
from balance_cli.io.errors import UserError
from balance_cli.io.units import ACCELERATION, FORCE, LENGTH, MOMENT, Unit, parse_unit

ComplexArray = NDArray[np.complex128]

VELOCITY = "m/s"
VELOCITIES = {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "in/s": 0.0254, "ft/s": 0.3048}
MOTIONS = {LENGTH: ("receptance", 2), VELOCITY: ("mobility", 1), ACCELERATION: ("accelerance", 0)}
"""Name of the response of each kind of motion, and how often it is differentiated to be an acceleration."""
QUANTITY_UNITS = {"a displacement": LENGTH, "a velocity": VELOCITY, "an acceleration": ACCELERATION, "a force": FORCE}
"""SI unit of what a universal file says was measured, where it states no unit."""


@dataclass(frozen=True)
class Conversion:
    """A value in V (or the unit of the channel's readings) is `factor` (2 pi i f)^`derivatives` times that of the file.

    `note` says what was assumed; empty where nothing was. `by_sensitivity` is the unit that the declared sensitivity of
    the channel converts; empty where it does not.
    """

    factor: float
    derivatives: int = 0
    note: str = ""
    by_sensitivity: str = ""


def convert_response(function: FrfFunction, mapped: MappedResponse, channel: Channel) -> Conversion:
    """Return how a response becomes readings of a channel. Raises UserError where its quantity is not that of one."""
    terminal = function.response
    unit, assumed = _stated_unit(mapped.unit or terminal.unit, terminal.quantity, "responses", terminal.name)
    stated = QUANTITY_UNITS.get(terminal.quantity, "")
    motion = unit.dimension if unit.dimension in MOTIONS else stated if stated in MOTIONS else ""
    if motion and channel.accelerometer is None:
        kind = f"{_article(MOTIONS[motion][0])} ({motion} over a force)"
        fault = f"`{terminal.name}` is {kind}, which channel `{channel.name}` does not read"
        remedy = "Export responses of the cells, in V or N over N; motion goes to accelerometer channels"
        raise UserError(fault, place=function.place, remedy=remedy)
    if unit.dimension == channel.reading_unit:
        return Conversion(mapped.sign * unit.factor * (mapped.scale or 1.0), note=assumed)
    if mapped.scale is not None:
        derivatives = MOTIONS[unit.dimension][1] if unit.dimension in MOTIONS else 0
        return Conversion(mapped.sign * unit.factor * mapped.scale, derivatives, assumed)
    derivatives = _own_quantity(unit, channel, function)
    return Conversion(mapped.sign * unit.factor * channel.sensitivity, derivatives, assumed, unit.symbol)


def _own_quantity(unit: Unit, channel: Channel, function: FrfFunction) -> int:
    """Return the derivatives of a unit of what a channel measures. Raises UserError where it is of something else."""
    if channel.accelerometer is not None and unit.dimension in MOTIONS:
        return MOTIONS[unit.dimension][1]
    measured = MOMENT if channel.torque_meter else FORCE
    if channel.measures_mechanics and channel.accelerometer is None and unit.dimension == measured:
        return 0
    fault = f"`{function.response.name}` is in {unit.symbol}, but channel `{channel.name}` reads {channel.reading_unit}"
    remedy = f"State `scale`, {channel.reading_unit} for one {unit.dimension}, or export it in {channel.reading_unit}"
    raise UserError(fault, place=function.place, remedy=remedy)


def convert_reference(function: FrfFunction, mapped: MappedReference) -> Conversion:
    """Return the factor of a response by which it is one for N or N m. Raises UserError where it refers to no load."""
    terminal = function.reference
    if QUANTITY_UNITS.get(terminal.quantity, FORCE) != FORCE:
        fault = f"the reference `{terminal.name}` is {terminal.quantity}, not a force"
        raise UserError(fault, place=function.place, remedy="Export responses over the force of the exciter")
    needed = MOMENT if mapped.component is not None and mapped.component.startswith("M") else FORCE
    unit, note = _stated_unit(mapped.unit or terminal.unit, terminal.quantity, "references", terminal.name, needed)
    if unit.dimension != needed:
        fault = f"the reference `{terminal.name}` is in {unit.symbol}, where a unit of {needed} is needed"
        raise UserError(fault, place=function.place, remedy="Correct `unit`, or the component of the reference")
    return Conversion(1.0 / unit.factor, note=note)


def apply_conversions(function: FrfFunction, response: Conversion, reference: Conversion) -> ComplexArray:
    """Return the values (k,) of a function in readings for N or N m, with the phase of exp(+j omega t)."""
    omega = 2j * np.pi * function.frequency
    return np.asarray(function.value * (response.factor * reference.factor) * omega**response.derivatives)


def _stated_unit(text: str, quantity: str, key: str, name: str, needed: str = "") -> tuple[Unit, str]:
    """Return a unit as a text, or else the quantity of a universal file, states it, and a note where it is assumed."""
    note = ""
    if not text and quantity in QUANTITY_UNITS and needed != MOMENT:
        text = QUANTITY_UNITS[quantity]
        note = f"`{name}` is {quantity} without a unit, taken as {text}"
    if not text:
        raise UserError(f"the unit of `{name}` is not known", place=key, remedy="State `unit` in the map")
    plain = text.strip().replace("^", "").replace("sec", "s")
    if plain in VELOCITIES:
        return Unit(plain, VELOCITY, VELOCITIES[plain]), note
    try:
        return parse_unit(text, *((needed,) if needed else ())), note
    except UserError as error:
        raise error.with_location(place=f"{key}.{name}") from error


def _article(word: str) -> str:
    return f"{'an' if word[0] in 'aeiou' else 'a'} {word}"
