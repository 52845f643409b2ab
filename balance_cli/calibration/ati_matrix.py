"""Calibration files of ATI force/torque sensors (`.cal`): XML with one element for each axis.

`UserAxis` elements hold the matrix, loads per volt. Where there are none, it follows from the `Axis` elements, divided
by their `scale` and moved by `BasicTransform`, the position of the user's origin in the sensor's axes.
"""

from __future__ import annotations

import re
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.linear_matrix import LinearMatrix, check_condition
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.load_components import moment_transfer
from balance_cli.io.errors import UserError
from balance_cli.io.units import FORCE, LENGTH, MOMENT, VOLTAGE, Unit, parse_unit

Array = NDArray[np.float64]

AXES = dict(zip(("Fx", "Fy", "Fz", "Tx", "Ty", "Tz"), COMPONENTS, strict=True))


def read_ati_matrix(text: str, file: str) -> LinearMatrix:
    """Read the matrix of an ATI calibration file; raises UserError that names the element at fault."""
    root = _parse(text, file)
    calibration = root if root.tag == "Calibration" else root.find(".//Calibration")
    if calibration is None:
        raise UserError("has no element `Calibration`", file, remedy="Give the .cal file of the sensor")
    force = _unit(calibration, "ForceUnits", FORCE, file)
    torque = _unit(calibration, "TorqueUnits", MOMENT, file)
    user = calibration.findall("UserAxis")
    T0, ranges = _axes(user or calibration.findall("Axis"), not user, (force, torque), file)
    if not user:
        T0 = _moved(calibration, file) @ T0
    check_condition(T0, file)
    return LinearMatrix(COMPONENTS, None, (VOLTAGE,) * T0.shape[1], T0, ranges, root.get("Serial", ""))


def _parse(text: str, file: str) -> Element:
    if "<!ENTITY" in text or "<!DOCTYPE" in text:
        raise UserError("has a document type, which a calibration file has not", file, remedy="Remove it")
    try:
        return ElementTree.fromstring(re.sub(r"^\s*<\?xml[^>]*\?>", "", text))
    except ElementTree.ParseError as error:
        fault = f"is not well-formed XML: {error}"
        raise UserError(fault, file, f"line {error.position[0]}", "Give the .cal file as it was delivered") from error


def _unit(calibration: Element, name: str, dimension: str, file: str) -> Unit:
    try:
        return parse_unit(calibration.get(name, ""), dimension)
    except UserError as error:
        raise error.with_location(file, f"Calibration, {name}") from None


def _axes(elements: list[Element], scaled: bool, units: tuple[Unit, Unit], file: str) -> tuple[Array, Array]:
    """Matrix (6, c) and largest loads (6,) in SI units."""
    by_name = {AXES.get(element.get("Name", "")): element for element in elements}
    rows, ranges = [], []
    for axis, name in AXES.items():
        element = by_name.get(name)
        if element is None:
            raise UserError(f"has no axis `{axis}`", file, "Calibration", "Give the file of a six-axis sensor")
        unit = units[name.startswith("M")]
        values = _numbers(element, "values", file)
        scale = _numbers(element, "scale", file)[0] if scaled else 1.0
        rows.append(unit.to_base(values) / scale)
        ranges.append(unit.factor * _numbers(element, "max", file)[0] if element.get("max") else np.nan)
    if len({len(row) for row in rows}) != 1:
        raise UserError("has axes of unequal length", file, "Calibration", "Give each axis one value for each channel")
    return np.array(rows), np.array(ranges)


def _numbers(element: Element, name: str, file: str) -> Array:
    text = element.get(name, "").replace(",", " ")
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if not len(values) or not np.isfinite(values).all() or (name == "scale" and not values[0] > 0):
        place = f"{element.tag} {element.get('Name', '')}, {name}"
        raise UserError(f"`{text[:40]}` is no list of numbers", file, place, "Correct it")
    return values


def _moved(calibration: Element, file: str) -> Array:
    """Matrix (6, 6) from loads about the sensor's origin to those about the user's; refuses rotations."""
    transform = calibration.find("BasicTransform")
    if transform is None:
        return np.eye(6)
    shift, turn = ([_number(transform, f"{kind}{axis}", file) for axis in "xyz"] for kind in "DR")
    if any(turn):
        fault = "turns the axes, and there are no elements `UserAxis`"
        raise UserError(fault, file, "BasicTransform", "Give a file with UserAxis elements")
    unit = _unit(calibration, "DistUnits", LENGTH, file)
    return moment_transfer((0.0, 0.0, 0.0), [unit.factor * value for value in shift])


def _number(element: Element, name: str, file: str) -> float:
    return float(_numbers(element, name, file)[0]) if element.get(name) else 0.0
