"""The rig with the shapes of its modes, animated, and the modal assurance of two models' shapes."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.kinematics import motion_at
from balance_cli.estimation.identified_model import IdentifiedModel, identified_system
from balance_cli.report.blocks import Picture, Row, Table, TableCell
from balance_cli.report.frequencies import has_shapes, modal_assurance
from balance_cli.report.number_format import format_fixed
from balance_cli.report.sources import Source

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FREEDOMS = 6
"""The first coordinates of a shape: the motion of the center of gravity of the metric side, and its rotation."""
FRAMES = 12
"""Frames of one period of the animation; between them the browser interpolates."""
PERIOD = 1.6
"""Seconds of one period on the screen."""
SIZE, MARGIN = 170.0, 26.0
LARGEST_MOTION = 0.18
"""Largest displacement in the picture, as a share of the rig's extent."""
PROJECTION = np.array([[0.87, -0.5, 0.0], [0.25, 0.43, -0.87]])
"""View from the front, the right and above; z goes up, so it is negative in the picture."""
SMALLEST_MOTION = 1e-6
"""Displacement [m], for a largest coordinate of 1, below which the plate is at rest: in the mode of the shaft."""
HIGH_ASSURANCE = 0.9
"""Modal assurance from which two shapes count as one mode (Ewins, Modal Testing, 2000)."""


def rig_points(geometry: Geometry) -> tuple[tuple[str, ...], Array]:
    """Return names and positions (p, 3) [m] of the points that are drawn: the cells, then the hub."""
    positions = [*(cell.position for cell in geometry.cells), geometry.hub]
    return (*geometry.cell_names, "hub"), np.array(positions, float)


def point_shapes(model: IdentifiedModel) -> ComplexArray | None:
    """Return displacements (m, p, 3) of the points for each mode; None without the six motions of the plate."""
    names = ("x", "y", "z", "psi", "theta", "phi")
    if not has_shapes(model.modes) or model.modes.coordinates[:FREEDOMS] != names:
        return None
    center = np.asarray(identified_system(model).equations.center.value, float)
    motion = motion_at(rig_points(model.geometry)[1] - center)
    return np.asarray(np.einsum("pij,mj->mpi", motion, model.modes.shape[:, :FREEDOMS]), complex)


def shape_picture(source: Source[IdentifiedModel]) -> Picture | None:
    """Return the animated picture of all modes of a model; None where its shapes are not those of a plate."""
    shapes = point_shapes(source.content)
    if shapes is None:
        return None
    modes = source.content.modes
    titles = [
        f"{frequency:.2f} Hz, damping {100 * ratio:.2f} %"
        for frequency, ratio in zip(modes.frequency, modes.damping_ratio, strict=True)
    ]
    names, points = rig_points(source.content.geometry)
    drawn = "".join(
        _mode_svg(title, names, points, shape)
        for title, shape in zip(titles, shapes, strict=True)
        if np.abs(shape).max() > SMALLEST_MOTION
    )
    caption = (
        f"Shapes of the modes of {source.label}: points of the cells and the hub on the metric side, joined to their "
        "middle; gray: at rest. Displacements are enlarged, the largest of each mode equally. Of modes in which the "
        "ground side moves too only the plate is shown; that of the shaft alone is left out."
    )
    return Picture("mode-shapes", caption, f'<div class="shapes">{drawn}</div>')


def _mode_svg(title: str, names: Sequence[str], points: Array, shape: ComplexArray) -> str:
    extent = float(np.ptp(points, axis=0).max()) or 1.0
    largest = float(np.abs(shape).max()) or 1.0
    scaled = shape * (LARGEST_MOTION * extent / largest)
    flat = points @ PROJECTION.T
    low, scale = flat.min(axis=0), (SIZE - 2 * MARGIN) / max(float(np.ptp(flat, axis=0).max()), 1e-12)
    frames = []
    for step in range(FRAMES + 1):
        moved = points + np.real(scaled * np.exp(2j * np.pi * step / FRAMES))
        frames.append(_lines((moved @ PROJECTION.T - low) * scale + MARGIN))
    at_rest = (flat - low) * scale + MARGIN
    labels = "".join(
        f'<text x="{x + 3:.1f}" y="{y - 3:.1f}" font-size="8">{escape(name)}</text>'
        for name, (x, y) in zip(names, at_rest, strict=True)
    )
    return (
        f'<svg class="plot" viewBox="0 0 {SIZE:g} {SIZE + 12:g}" role="img" aria-label="Mode at {escape(title)}" '
        f'xmlns="http://www.w3.org/2000/svg" font-family="sans-serif" font-size="9">'
        f'<text x="4" y="10" font-weight="600">{escape(title)}</text><g transform="translate(0 12)">'
        f'<path class="axis" fill="none" stroke-dasharray="3 2" d="{_lines(at_rest)}"/>{labels}'
        f'<path fill="none" stroke="#0072b2" stroke-width="2" d="{frames[0]}"><animate attributeName="d" '
        f'dur="{PERIOD:g}s" repeatCount="indefinite" values="{";".join(frames)}"/></path></g></svg>'
    )


def _lines(places: Array) -> str:
    """Join every point to the middle of all."""
    middle = places.mean(axis=0)
    return "".join(f"M{middle[0]:.1f} {middle[1]:.1f}L{x:.1f} {y:.1f}" for x, y in places)


def assurance_table(rows: Source[IdentifiedModel], columns: Source[IdentifiedModel]) -> Table | None:
    """Return the modal assurance of two models' shapes, as displacements of the points; None without such shapes."""
    first, second = point_shapes(rows.content), point_shapes(columns.content)
    if first is None or second is None:
        return None
    assurance = modal_assurance(first.reshape(len(first), -1), second.reshape(len(second), -1))
    head = (TableCell("Hz"), *(TableCell(f"{value:.2f}") for value in columns.content.modes.frequency))
    moving = np.outer(*(np.abs(shapes).max(axis=(1, 2)) > SMALLEST_MOTION for shapes in (first, second)))
    body: list[Row] = []
    for value, line in zip(rows.content.modes.frequency, np.where(moving, assurance, np.nan), strict=True):
        cells = (TableCell(format_fixed(float(mac), 2), mark="good" if mac > HIGH_ASSURANCE else "") for mac in line)
        body.append((TableCell(f"{value:.2f}", mark="name"), *cells))
    caption = (
        f"Modal assurance (MAC) of the shapes, {rows.label} down, {columns.label} across, from the displacements of "
        f"the cells and the hub. Shaded: above {HIGH_ASSURANCE:g}."
    )
    return Table(caption, (head,), tuple(body))
