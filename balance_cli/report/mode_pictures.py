"""Section of the shapes of the modes: the rig in motion, and how well the shapes of two models agree."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.kinematics import motion_at
from balance_cli.estimation.identified_model import IdentifiedModel, identified_system
from balance_cli.report.blocks import PageBlock, Picture, Row, Section, Table, TableCell
from balance_cli.report.campbell import campbell_blocks
from balance_cli.report.frequencies import has_shapes, modal_assurance, reference_model
from balance_cli.report.load_figures import wind_runs
from balance_cli.report.number_format import format_fixed
from balance_cli.report.rig_drawing import PROJECTION, RigDrawing, draw_rig, rig_picture
from balance_cli.report.source_roles import SourceRole
from balance_cli.report.sources import Source, Sources

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FRAMES = 12
"""Frames of one period of the animation; between them the browser interpolates."""
PERIOD = 1.6
"""Seconds of one period on the screen."""
SIZE, MARGIN = 170.0, 26.0
LARGEST_MOTION = 0.18
"""Largest displacement in the picture, as a share of the rig's extent."""
SMALLEST_MOTION = 1e-6
"""Displacement [m], for a largest coordinate of 1, below which the plate is at rest: in the mode of the shaft."""
MOST_SPEEDS = 40
"""Speeds of runs that are drawn in the Campbell diagram."""
HIGH_ASSURANCE = 0.9
"""Modal assurance from which two shapes count as one mode (Ewins, Modal Testing, 2000)."""


@dataclass(frozen=True)
class PointShapes:
    """Displacements of each mode: (m, p, 3) of the points of the metric side, (m, c, 3) of those of the other side."""

    points: ComplexArray
    ground: ComplexArray


def point_shapes(model: IdentifiedModel) -> PointShapes | None:
    """Return the displacements of the points of `draw_rig` in each mode; None without shapes of a physical model."""
    if not has_shapes(model.modes) or model.paper is not None:
        return None
    equations = identified_system(model).equations
    if model.modes.coordinates != equations.coordinates:
        return None
    drawing = draw_rig(model.geometry)
    metric = np.array([equations.motion(point).value for point in drawing.points])
    ground = motion_at(drawing.ground) @ equations.non_metric_motion.value
    points, others = (np.einsum("pin,mn->mpi", motion, model.modes.shape) for motion in (metric, ground))
    return PointShapes(np.asarray(points, complex), np.asarray(others, complex))


def shape_picture(source: Source[IdentifiedModel]) -> Picture | None:
    """Return the animated picture of all modes of a model; None where its shapes are not known."""
    shapes = point_shapes(source.content)
    if shapes is None:
        return None
    modes = source.content.modes
    drawing = draw_rig(source.content.geometry)
    markup = "".join(
        _mode_svg(
            f"{frequency:.2f} Hz, damping {100 * ratio:.2f} %",
            drawing,
            np.concatenate([shapes.points[m], shapes.ground[m]]),
        )
        for m, (frequency, ratio) in enumerate(zip(modes.frequency, modes.damping_ratio, strict=True))
        if np.abs(shapes.points[m]).max() > SMALLEST_MOTION
    )
    caption = (
        f"Shapes of the modes of {source.label}: plate, cells and hub, and the side on which the cells stand where it "
        "moves; gray: at rest. Displacements are enlarged, the largest of each mode equally. The mode of the shaft "
        "alone is left out."
    )
    return Picture("mode-shapes", caption, f'<div class="shapes">{markup}</div>')


def _mode_svg(title: str, drawing: RigDrawing, shape: ComplexArray) -> str:
    places = drawing.all_points
    extent = float(np.ptp(places, axis=0).max()) or 1.0
    largest = float(np.abs(shape).max()) or 1.0
    scaled = shape * (LARGEST_MOTION * extent / largest)
    flat = places @ PROJECTION.T
    low, scale = flat.min(axis=0), (SIZE - 2 * MARGIN) / max(float(np.ptp(flat, axis=0).max()), 1e-12)
    count = len(drawing.points)

    def lines(moved: Array) -> str:
        at = (moved @ PROJECTION.T - low) * scale + MARGIN
        support = drawing.ground_lines(at[count:]) if np.abs(shape[count:]).max(initial=0.0) > SMALLEST_MOTION else ""
        return drawing.lines(at[:count], at[count:]) + support

    frames = [lines(places + np.real(scaled * np.exp(2j * np.pi * step / FRAMES))) for step in range(FRAMES + 1)]
    labels = "".join(
        f'<text x="{x + 3:.1f}" y="{y - 3:.1f}" font-size="8">{escape(name)}</text>'
        for name, (x, y) in zip(drawing.labels, ((flat - low) * scale + MARGIN)[:count], strict=True)
    )
    return (
        f'<svg class="plot" viewBox="0 0 {SIZE:g} {SIZE + 12:g}" role="img" aria-label="Mode at {escape(title)}" '
        f'xmlns="http://www.w3.org/2000/svg" font-family="sans-serif" font-size="9">'
        f'<text x="4" y="10" font-weight="600">{escape(title)}</text><g transform="translate(0 12)">'
        f'<path class="axis" fill="none" stroke-dasharray="3 2" d="{lines(places)}"/>{labels}'
        f'<path fill="none" stroke="#0072b2" stroke-width="1.6" d="{frames[0]}"><animate attributeName="d" '
        f'dur="{PERIOD:g}s" repeatCount="indefinite" values="{";".join(frames)}"/></path></g></svg>'
    )


def assurance_table(rows: Source[IdentifiedModel], columns: Source[IdentifiedModel]) -> Table | None:
    """Return the modal assurance of two models' shapes, as displacements of the points; None without such shapes.

    None, too, where the models are of rigs with other points.
    """
    if draw_rig(rows.content.geometry).names != draw_rig(columns.content.geometry).names:
        return None
    shapes_of_rows, shapes_of_columns = point_shapes(rows.content), point_shapes(columns.content)
    if shapes_of_rows is None or shapes_of_columns is None:
        return None
    first, second = shapes_of_rows.points, shapes_of_columns.points
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


def section(sources: Sources) -> Section | None:
    """Return the shapes of the best model, and their assurance with those computed; None without shapes."""
    best = reference_model(sources.models) or next(iter(sources.models), None)
    picture = shape_picture(best) if best is not None else None
    if best is None or picture is None:
        return None
    blocks: list[PageBlock] = [rig_picture(best.content.geometry), picture]
    computed = next((source for source in sources.models if source.role is SourceRole.COMPUTED), None)
    table = assurance_table(computed, best) if computed is not None and computed is not best else None
    if table is not None:
        blocks.append(table)
    blocks += campbell_blocks(best, _speeds(sources))
    return Section("shapes", "Mode shapes and rotor speed", tuple(blocks))


def _speeds(sources: Sources) -> tuple[float, ...]:
    """The mean speeds [Hz] of the wind-on runs, each once."""
    runs = [run for source in sources.loads for run in wind_runs(source.content).values()]
    by_harmonics = [run for run in runs if run.in_time is None and len(run.frequency_hz) > 1]
    return tuple(sorted({round(float(run.frequency_hz[1]), 2) for run in by_harmonics}))[:MOST_SPEEDS]
