"""The rig as lines: the plate on its cells, the hub above it, and the side on which the cells stand."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.report.blocks import Picture

Array = NDArray[np.float64]
Index = NDArray[np.intp]

PROJECTION = np.array([[0.87, -0.5, 0.0], [0.25, 0.43, -0.87]])
"""View from the front, the right and above; z goes up, so it is negative in the picture."""
CELL_LENGTH = 0.22
"""Length of a cell in the picture, as a share of the rig's extent: its own length is not declared."""
RIG_SIZE, RIG_MARGIN, AXES_LENGTH = 460.0, 46.0, 34.0
"""Width of the picture, its margin, which holds the labels, and length of the axes beside it [px]."""


@dataclass(frozen=True)
class RigDrawing:
    """Points (p, 3) [m] of the metric side, the cells first and the hub last, and those (c, 3) on which cells stand.

    `outline`: indices of the cells around the plate.
    """

    names: tuple[str, ...]
    points: Array
    ground: Array
    outline: Index

    @property
    def labels(self) -> tuple[str, ...]:
        """A text for each point of the metric side: cells that share a point are named at the first of them."""
        texts = [""] * len(self.names)
        for i, place in enumerate(self.points):
            first = next(j for j in range(i + 1) if np.allclose(self.points[j], place))
            texts[first] += f", {self.names[i]}" if texts[first] else self.names[i]
        return tuple(texts)

    @property
    def all_points(self) -> Array:
        """All points (p + c, 3)."""
        return np.concatenate([self.points, self.ground])

    def lines(self, points: Array, ground: Array) -> str:
        """Return the path of plate, mast and cells through points (p, 2) and (c, 2) of the picture."""
        plate = points[self.outline]
        around = "M" + "L".join(_at(place) for place in plate) + "Z" if len(plate) > 2 else ""
        middle = points[:-1].mean(axis=0)
        # A plate of one or two points is drawn as lines to its middle.
        spokes = "" if around else "".join(f"M{_at(middle)}L{_at(place)}" for place in points[:-1])
        cells = "".join(f"M{_at(a)}L{_at(b)}" for a, b in zip(points[:-1], ground, strict=True))
        return f"{around}{spokes}M{_at(middle)}L{_at(points[-1])}{cells}"

    def ground_lines(self, ground: Array) -> str:
        """Return the path that joins the points (c, 2) on which the cells stand."""
        outline = ground[self.outline]
        return "M" + "L".join(_at(place) for place in outline) + "Z" if len(outline) > 2 else ""


def _at(place: Array) -> str:
    return f"{place[0]:.1f} {place[1]:.1f}"


def draw_rig(geometry: Geometry) -> RigDrawing:
    """Return the drawing of a geometry."""
    positions = np.array([cell.position for cell in geometry.cells], float).reshape(-1, 3)
    points = np.concatenate([positions, np.array([geometry.hub], float)])
    extent = float(np.ptp(points, axis=0).max()) or 1.0
    axes = np.array([cell.axis for cell in geometry.cells], float).reshape(-1, 3)
    length = np.linalg.norm(axes, axis=1, keepdims=True)
    ground = positions - CELL_LENGTH * extent * axes / np.where(length > 0, length, 1.0)
    return RigDrawing((*geometry.cell_names, "hub"), points, ground, _outline(positions[:, :2]))


def _outline(places: Array) -> Index:
    """Indices of the convex hull of points (c, 2) in the plane, in their order around it (Andrew's monotone chain)."""
    order = sorted(range(len(places)), key=lambda i: tuple(places[i]))

    def chain(indices: list[int]) -> list[int]:
        hull: list[int] = []
        for i in indices:
            while len(hull) > 1 and _orientation(places[hull[-2]], places[hull[-1]], places[i]) <= 0:
                hull.pop()
            hull.append(i)
        return hull[:-1]

    return np.array(chain(order) + chain(order[::-1]), np.intp)


def _orientation(a: Array, b: Array, c: Array) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def rig_picture(geometry: Geometry) -> Picture:
    """Return the picture of the rig at rest, with the names of its cells and the rig's axes."""
    drawing = draw_rig(geometry)
    flat = drawing.all_points @ PROJECTION.T
    low = flat.min(axis=0)
    scale = (RIG_SIZE - 2 * RIG_MARGIN) / max(float(np.ptp(flat, axis=0).max()), 1e-12)
    places = (flat - low) * scale + RIG_MARGIN
    height = float(places[:, 1].max()) + RIG_MARGIN
    points, ground = places[: len(drawing.points)], places[len(drawing.points) :]
    feet = "".join(f'<path class="axis" d="M{x - 5:.1f} {y:.1f}h10" stroke-width="2"/>' for x, y in ground)
    labels = "".join(_label(name, *place) for name, place in zip(drawing.labels, points, strict=True) if name)
    markup = (
        f'<svg class="plot rig" viewBox="0 0 {RIG_SIZE:g} {height:.0f}" role="img" aria-label="The rig" '
        f'xmlns="http://www.w3.org/2000/svg" font-family="sans-serif" font-size="11">'
        f'<path class="axis" fill="none" stroke-dasharray="3 3" d="{drawing.ground_lines(ground)}"/>{feet}'
        f'<path fill="none" stroke="#0072b2" stroke-width="2" d="{drawing.lines(points, ground)}"/>{labels}'
        f"{''.join(_axes_cross(height))}</svg>"
    )
    caption = (
        f"The rig {geometry.rig}, geometry {geometry.name}, from the front, the right and above: plate through the "
        "points of the cells, cells along their axes (their length is not declared), hub. Dashed: the side on which "
        "the cells stand."
    )
    return Picture("rig", caption, markup)


def _label(name: str, x: float, y: float) -> str:
    dot = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="#0072b2"/>'
    return f'{dot}<text x="{x + 6:.1f}" y="{y - 5:.1f}">{escape(name)}</text>'


def _axes_cross(height: float) -> Iterator[str]:
    """The directions of the rig's axes in the lower left corner."""
    start = np.array([RIG_MARGIN, height - RIG_MARGIN * 0.7])
    for name, direction in zip("xyz", AXES_LENGTH * PROJECTION.T, strict=True):
        end = start + direction
        yield f'<path class="axis" d="M{_at(start)}L{_at(end)}"/>'
        yield f'<text x="{end[0] + 3:.1f}" y="{end[1] + 3:.1f}">{name}</text>'
