"""Runs with forces at points other than the hub, as runs with hub loads."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from balance_cli.campaign.recording.additions import LoadPoints, RunAdditions
from balance_cli.campaign.recording.run import Array, Run, SampleBlock, SampleSource
from balance_cli.campaign.rig.geometry import DeclaredLoadPoint, Geometry
from balance_cli.io.errors import UserError

POSITION_TOLERANCE = 5e-3
"""[m] between a declared point and that of a run: a stinger is placed to millimeters, and drawings round to them."""
LEAST_COSINE = 0.996
"""Of the angle between a declared direction and that of a run: 5 deg."""


@dataclass(frozen=True)
class PointLoadSource:
    """Samples of a run whose loads are those at the hub and the forces at its points, about the hub."""

    parent_source: SampleSource
    additions: RunAdditions
    hub: tuple[float, float, float]

    def read(self, start: int, stop: int) -> SampleBlock:
        """Return samples start to stop."""
        block = self.parent_source.read(start, stop)
        at_points: Array = self.additions.hub_loads(np.array(self.hub), start, stop)
        return SampleBlock(start, block.channels, at_points if block.loads is None else block.loads + at_points)


def with_hub_loads(run: Run, geometry: Geometry) -> Run:
    """The run with its forces at points added to the hub loads; the same run where it has no such forces.

    Points without position and direction are those that the geometry declares under the same name
    (`load_point_faults` says which are missing there).
    """
    additions = run.additions
    if additions is None or additions.load_points is None or isinstance(run.source, PointLoadSource):
        return run
    placed = replace(additions, load_points=_place_by_name(additions.load_points, geometry))
    return replace(run, source=PointLoadSource(run.source, placed, geometry.hub), has_loads=True)


def without_point_loads(run: Run) -> Run:
    """The run as its file holds it: loads at the hub alone, forces at points beside them."""
    if not isinstance(run.source, PointLoadSource):
        return run
    source = run.source.parent_source
    return replace(run, source=source, has_loads=source.read(0, min(run.samples, 1)).loads is not None)


def _place_by_name(points: LoadPoints, geometry: Geometry) -> LoadPoints:
    if not points.are_named_only:
        return points
    declared = [(geometry.load_points or {})[name] for name in points.names]
    direction = np.array([point.direction for point in declared], float)
    return LoadPoints(points.names, direction, np.array([point.position for point in declared], float))


def points_beside_shaft(run: Run, geometry: Geometry) -> tuple[str, ...]:
    """Return the points whose force has a moment about a shaft that passes the plate.

    Their forces are taken as hub loads, whose moment about that axis goes through the torque meter. A force on the
    plate itself turns the plate instead. Points that move are not judged.
    """
    points = None if run.additions is None else run.additions.load_points
    axes = ["xyz".index(meter.axis) for meter in geometry.shaft_meters if meter.carried_by == "ground"]
    if points is None or not axes or any(load_point_faults(run, geometry)):
        return ()
    placed = _place_by_name(points, geometry)
    if placed.position is None:
        return ()
    arms = np.cross(placed.position - np.array(geometry.hub), placed.unit_directions)[:, axes]
    beside = np.abs(arms).max(axis=1) > POSITION_TOLERANCE
    return tuple(name for name, is_beside in zip(placed.names, beside, strict=True) if is_beside)


def load_point_faults(run: Run, geometry: Geometry) -> Iterator[UserError]:
    """Faults of the points of a run against those that the geometry declares under the same names."""
    points = None if run.additions is None else run.additions.load_points
    if points is None:
        return
    known = geometry.load_points or {}
    for index, name in enumerate(points.names):
        file, place = run.file, f"load_points, {name}"
        point = known.get(name)
        if points.are_named_only and (point is None or point.direction is None):
            lacking = "is not declared" if point is None else "has no `direction`"
            fault = f"has neither position nor direction, and {lacking} in the geometry"
            yield UserError(fault, file, place, "Add it to `load_points` of the geometry, or to the run file")
        elif point is not None and not points.are_named_only:
            fault = _difference(points, index, point)
            if fault:
                remedy = "Correct the geometry or the run file, or give the point another name"
                yield UserError(fault, file, place, remedy)


def _difference(points: LoadPoints, index: int, declared: DeclaredLoadPoint) -> str:
    """What of a point is not as declared; empty where all is."""
    if points.position is not None:
        distance = float(np.linalg.norm(points.position[index] - np.array(declared.position)))
        if distance > POSITION_TOLERANCE:
            return f"lies {distance:.3g} m from the point that the geometry declares under this name"
    if declared.direction is not None:
        axis = np.array(declared.direction) / np.linalg.norm(declared.direction)
        if float(points.unit_directions[index] @ axis) < LEAST_COSINE:
            return "has another direction than the point that the geometry declares under this name"
    return ""
