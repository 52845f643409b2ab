"""Consistency of a geometry: names, references, inertia, and cells that restrain the plate."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence

import numpy as np

from balance_cli.campaign.rig.components import FREEDOMS
from balance_cli.campaign.rig.declared_values import Array
from balance_cli.campaign.rig.geometry import Body, Geometry
from balance_cli.campaign.rig.kinematics import elongation_matrix
from balance_cli.campaign.rig.load_components import component_faults
from balance_cli.campaign.rig.mass_properties import metric_side
from balance_cli.io.errors import UserError

RELATIVE_ROUNDING = 1e-9
"""Tolerance for declared values exactly at a limit (a flat disc has Ixx + Iyy = Izz)."""
LARGEST_EXTENT = 50.0
"""Of a rig [m]: the test sections of the largest wind tunnels are 24 m x 37 m. Of a rig of 50 mm, in mm."""
FAR_FROM_OTHERS = 50.0
"""Distance of a point from the others over their extent from which it was given in another unit."""
MOST_COMPARED_POINTS = 500
"""More points are not compared one by one."""
SINGULAR_VALUE_TOLERANCE = 1e-6
"""Singular values of the elongations below this share of the largest are motions that no cell restrains."""


def geometry_faults(geometry: Geometry) -> Iterator[UserError]:
    """All faults between the parts of a geometry, in the order of the file; each part is valid by itself."""
    if geometry.bodies and "hub" not in geometry.model_fields_set:
        yield UserError("is missing", place="hub", remedy="Give the point to which the hub loads refer [m]")
    yield from _duplicate_name_faults("bodies", [body.name for body in geometry.bodies])
    for index, body in enumerate(geometry.bodies):
        yield from _inertia_faults(index, body)
    yield from _duplicate_name_faults("cells", [cell.name for cell in geometry.cells])
    yield from _duplicate_name_faults("channels", geometry.channel_names)
    yield from _torque_meter_faults(geometry)
    yield from _channel_reference_faults(geometry)
    yield from _channel_group_faults(geometry)
    yield from _duplicate_name_faults("freedom", geometry.freedom)
    yield from component_faults(geometry)
    yield from _extent_faults(geometry)
    if not missing_mechanics(geometry):
        yield from _restraint_faults(geometry)


def _extent_faults(geometry: Geometry) -> Iterator[UserError]:
    """Faults of positions that are far from all others, or too large for any rig: they were given in mm."""
    points = {
        "hub": geometry.hub,
        **{f"bodies[{index}].position": body.position for index, body in enumerate(geometry.bodies)},
        **{f"cells[{index}].position": cell.position for index, cell in enumerate(geometry.cells)},
        **{
            f"channels[{index}].accelerometer.position": channel.accelerometer.position
            for index, channel in enumerate(geometry.channels)
            if channel.accelerometer is not None
        },
        **{f"load_points.{name}.position": point.position for name, point in (geometry.load_points or {}).items()},
    }
    positions = np.array(list(points.values()), float)
    remedy = "Positions are in m"
    if np.ptp(positions, axis=0).max() > LARGEST_EXTENT and len(points) <= MOST_COMPARED_POINTS:
        for index, place in enumerate(points):
            others = np.delete(positions, index, axis=0)
            extent, center = float(np.ptp(others, axis=0).max()), others.mean(axis=0)
            distance = float(np.linalg.norm(positions[index] - center))
            if 0.0 < extent < LARGEST_EXTENT and distance > FAR_FROM_OTHERS * extent:
                fault = f"lies {distance:.4g} m from all others, which lie within {extent:.3g} m: was it given in mm?"
                yield UserError(fault, place=place, remedy=remedy)
                return
        fault = f"extends over {np.ptp(positions, axis=0).max():.4g} m: were the positions given in mm?"
        yield UserError(fault, place="positions", remedy=remedy)


def missing_mechanics(geometry: Geometry) -> tuple[str, ...]:
    """Keys that are absent from a geometry which is only calibrated, and that equations of motion need."""
    missing = [key for key in ("bodies", "cells") if not getattr(geometry, key)]
    missing += [
        f"cells[{index}].stiffness"
        for index, cell in enumerate(geometry.cells)
        if cell.stiffness is None and cell.series is None
    ]
    missing += [
        f"channels[{index}].cell" for index, channel in enumerate(geometry.channels) if not channel.measures_mechanics
    ]
    return (*missing, *(["damping_ratio"] if geometry.damping_ratio is None else []))


def require_mechanics(geometry: Geometry, file: str = "") -> None:
    """Raise UserError for a geometry without what equations of motion need."""
    missing = missing_mechanics(geometry)
    if missing:
        names = ", ".join(f"`{key}`" for key in missing[:4]) + (" and others" if len(missing) > 4 else "")
        fault = f"{names} {'is' if len(missing) == 1 else 'are'} missing"
        raise UserError(
            fault, file, remedy="Add what is missing; only `calibrate`, `apply` and `sweep-tf` do without it"
        )


def _duplicate_name_faults(key: str, names: Sequence[str]) -> Iterator[UserError]:
    first: dict[str, int] = {}
    for index, name in enumerate(names):
        if name in first:
            fault = f"name `{name}` is already that of {key}[{first[name]}]"
            yield UserError(fault, place=f"{key}[{index}]", remedy="Names must differ")
        first.setdefault(name, index)


def _inertia_faults(index: int, body: Body) -> Iterator[UserError]:
    """A mass distribution has principal moments J1 <= J2 <= J3 with J1 >= 0 and J3 <= J1 + J2."""
    least, middle, largest = np.linalg.eigvalsh(body.inertia.tensor())
    slack = RELATIVE_ROUNDING * max(largest, abs(least))
    shown = f"{least:.4g}, {middle:.4g}, {largest:.4g} kg m2"
    place = f"bodies[{index}].inertia"
    if least < -slack:
        fault = f"no mass has this inertia: a principal moment is negative ({shown})"
        yield UserError(fault, place=place, remedy="Check the products of inertia against the moments")
    elif largest > least + middle + slack:
        fault = f"no mass has this inertia: the largest principal moment exceeds the sum of the others ({shown})"
        yield UserError(fault, place=place, remedy="Check the moments of inertia")


def _channel_reference_faults(geometry: Geometry) -> Iterator[UserError]:
    cells = geometry.cell_names
    for index, channel in enumerate(geometry.channels):
        for name in channel.cell_weights:
            if name not in cells:
                place = f"channels[{index}].{'cell' if channel.cells is None else f'cells.{name}'}"
                yield UserError(f"there is no cell `{name}`", place=place, remedy=_known("cells", name, cells))
        if channel.torque_meter:
            yield from _torque_channel_faults(geometry, channel.torque_meter, f"channels[{index}].torque_meter")


def _torque_channel_faults(geometry: Geometry, named: bool | str, place: str) -> Iterator[UserError]:
    """Faults of a channel of the only torque meter (`true`) or of a named one of several."""
    names = [meter.name or "" for meter in geometry.torque_meters or ()]
    if not geometry.shaft_meters:
        yield UserError("no torque meter is declared", place=place, remedy="Add the key `torque_meter`")
    elif named is True and names:
        remedy = f"Name one of {', '.join(names)}"
        yield UserError("does not say which of the torque meters is read", place=place, remedy=remedy)
    elif named is not True and named not in names:
        remedy = _known("torque meters", str(named), names) if names else "Write `torque_meter: true`"
        yield UserError(f"there is no torque meter `{named}`", place=place, remedy=remedy)


def _torque_meter_faults(geometry: Geometry) -> Iterator[UserError]:
    """Faults of names, of both keys at once, and of one shaft that ends in two places."""
    meters = geometry.torque_meters or ()
    if geometry.torque_meter and meters:
        yield UserError("`torque_meter` is declared, too", place="torque_meters", remedy="List all meters here")
    yield from _duplicate_name_faults("torque_meters", [meter.name or "" for meter in meters])
    ends: dict[str, str] = {}
    for index, meter in enumerate(meters):
        place = f"torque_meters[{index}]"
        if meter.name is None:
            yield UserError("has no `name`", place=place, remedy="Name each meter; its channels refer to it")
        if ends.setdefault(meter.axis, meter.carried_by) != meter.carried_by:
            fault = f"meters of one shaft (axis {meter.axis}) are carried by the ground and by the plate"
            yield UserError(fault, place=f"{place}.carried_by", remedy="Give the place where the shaft ends to each")


def _channel_group_faults(geometry: Geometry) -> Iterator[UserError]:
    """Faults of groups that name no channel, one twice, or are named as a channel or a cell."""
    for name, members in geometry.acquisition.groups.items():
        place = f"acquisition.groups.{name}"
        if name in (*geometry.channel_names, *geometry.cell_names):
            yield UserError("a channel or a cell has this name", place=place, remedy="Give the group a name of its own")
        for member in members:
            if member not in geometry.channel_names:
                remedy = _known("channels", member, geometry.channel_names)
                yield UserError(f"there is no channel `{member}`", place=place, remedy=remedy)
        yield from _duplicate_name_faults(place, members)


def _known(kind: str, name: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1)
    return f"Did you mean `{near[0]}`?" if near else f"The {kind} are {', '.join(known)}"


def _restraint_faults(geometry: Geometry) -> Iterator[UserError]:
    """Faults unless the inertia is positive definite in the degrees of freedom and the cells restrain them all."""
    moving = metric_side(geometry)
    moment = dict(zip(("phi", "theta", "psi"), np.eye(3), strict=True))
    turns = np.array([moment[name] for name in geometry.freedom if name in moment]).reshape(-1, 3)
    least = RELATIVE_ROUNDING * float(np.trace(moving.inertia))
    if len(turns) and np.linalg.eigvalsh(turns @ moving.inertia @ turns.T)[0] <= least:
        fault = "the metric side has no inertia against one of its rotations"
        yield UserError(fault, place="bodies", remedy="Declare the inertia, or leave the rotation out of `freedom`")
    motion = unrestrained_motion(geometry, moving.centre_of_gravity)
    if motion:
        fault = f"the cells do not hold the plate: it is free to move in {motion}"
        yield UserError(fault, place="cells", remedy="Add a cell, or leave that motion out of `freedom`")


def unrestrained_motion(geometry: Geometry, center: Array) -> str:
    """The motion that elongates no cell, as in `psi + 0.4 y`; empty where every motion elongates some cell.

    `center` (3,) is the center of gravity [m]. Rotations are scaled by the spread of the cells, so that the rank does
    not depend on the unit of length.
    """
    freedom = list(dict.fromkeys(geometry.freedom))
    rows = elongation_matrix(geometry, center)[:, [FREEDOMS.index(name) for name in freedom]]
    arms = np.array([cell.position for cell in geometry.cells]) - center
    length = max(float(np.abs(arms).max()), np.finfo(float).tiny)
    scale = np.array([1.0 if name in "xyz" else 1.0 / length for name in freedom])
    _, singular, motions = np.linalg.svd(rows * scale)
    rank = int((singular > SINGULAR_VALUE_TOLERANCE * singular[0]).sum()) if singular[0] > 0 else 0
    return "" if rank == len(freedom) else _format_motion(motions[-1] * scale, freedom)


def _format_motion(motion: Array, freedom: Sequence[str]) -> str:
    """A motion in words, its largest part first."""
    parts = motion / motion[np.argmax(np.abs(motion))]
    order = [index for index in np.argsort(-np.abs(parts)) if abs(parts[index]) > 1e-3]
    words = [freedom[index] if parts[index] == 1.0 else f"{parts[index]:.3g} {freedom[index]}" for index in order]
    return " + ".join(words)
