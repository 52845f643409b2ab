"""Pictures of measured and modeled responses: amplitude, phase and residual in small panels.

They are written as SVG directly: the sample campaign has 174 axes with 1400 curves, of which a plotting library makes
ten times the text in thirty times the time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.report.axis_ticks import Scale, make_scale, tick_text
from balance_cli.report.curve_path import area_path, curve_path
from balance_cli.report.figure_style import BLACK, PlotStyle
from balance_cli.report.force_responses import TORQUE_METER, Curve, quotient

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MOST_IN_FOUR_COLUMNS = 8
RESIDUAL_LIMITS = (0.1, 300.0)
"""Limits of the residual axis [%]."""
PHASE_LIMITS = (-190.0, 190.0)
MAX_AXIS_RATIO = 1e4
"""Largest ratio of the ends of the amplitude axis: more decades would flatten the curves."""
WIDTH = 2304
"""Width of a picture; two units are a pixel where the page is at its full width, so that all places are integers."""
LEFT, RIGHT, TOP, BOTTOM, GAP = 104, 10, 32, 44, 16
"""Space around the axes of a panel, and between its three axes."""
LINE, LETTER = 32, 10.6
"""Height of a line of the legend, and mean width of a letter at its font of 18 units."""
NOISE_COLOR, GRID_COLOR, AXIS_COLOR = "#d4d4d4", "#e4e4e4", "#666666"


@dataclass(frozen=True)
class Panel:
    """One sensor and component: the measured curve, and (label, plot style, value (k,)) of each model."""

    sensor: str
    component: str
    measured: Curve
    models: tuple[tuple[str, PlotStyle, ComplexArray], ...]

    @property
    def unit(self) -> str:
        """Unit of the response."""
        per = UNIT_OF[self.component]
        sensor_unit = "N m" if self.sensor.startswith(TORQUE_METER) else "N"
        if sensor_unit == per:
            return "1"
        return f"{sensor_unit}/({per})" if " " in per else f"{sensor_unit}/{per}"

    @property
    def is_zero_in_models(self) -> bool:
        """Whether there are models and the response is zero in all of them."""
        return bool(self.models) and not any(value.any() for _, _, value in self.models)


@dataclass(frozen=True)
class _Axes:
    """One pair of axes of a panel: its label, scales over its own width and height, and its place on the picture."""

    label: str
    x: Scale
    y: Scale
    left: int
    top: int
    width: int
    height: int


def component_svg(panels: Sequence[Panel], description: str) -> str:
    """Return all sensors of one component as an `svg` element, with common amplitude limits."""
    columns = min(len(panels), 4 if len(panels) <= MOST_IN_FOUR_COLUMNS else 5)
    return _grid_svg(panels, description, columns, (186, 98, 138), _amplitude_limits(panels))


def detail_svg(panels: Sequence[Panel], description: str) -> str:
    """Return a few pairs as an `svg` element in larger panels, each with its own amplitude limits."""
    return _grid_svg(panels, description, min(len(panels), 2), (262, 122, 174), None)


def _grid_svg(
    panels: Sequence[Panel],
    description: str,
    columns: int,
    heights: tuple[int, int, int],
    limits: tuple[float, float] | None,
) -> str:
    cell = (WIDTH // max(columns, 1), TOP + sum(heights) + 2 * GAP + BOTTOM)
    below = -(-len(panels) // columns) * cell[1] if panels else 0
    parts: list[str] = []
    for i, panel in enumerate(panels):
        corner = (i % columns * cell[0], i // columns * cell[1])
        parts += _panel(panel, corner, cell[0], heights, limits or _amplitude_limits([panel]))
    legend, bottom = _legend(panels, below + LINE)
    return (
        f'<svg viewBox="0 0 {WIDTH} {bottom}" style="width:{WIDTH // 2}px" role="img" '
        f'aria-label="{escape(description)}" xmlns="http://www.w3.org/2000/svg" font-family="sans-serif" '
        f'font-size="18">{"".join(parts)}{legend}</svg>'
    )


def _panel(
    panel: Panel, corner: tuple[int, int], width: int, heights: tuple[int, int, int], limits: tuple[float, float]
) -> Iterator[str]:
    left, top, inner = corner[0] + LEFT, corner[1] + TOP, width - LEFT - RIGHT
    last = float(panel.measured.frequency[-1])
    axes = []
    for label, height, ends, log in zip(
        ("amplitude", "phase [°]", "residual [%]"),
        heights,
        (limits, PHASE_LIMITS, RESIDUAL_LIMITS),
        (True, False, True),
        strict=True,
    ):
        x, y = make_scale([], 0, inner, limits=(0.0, last)), make_scale([], height, 0, log, ends)
        axes.append(_Axes(label, x, y, left, top, inner, height))
        top += height + GAP
    yield f'<text x="{left}" y="{corner[1] + 22}" font-weight="600">{escape(_title(panel))}</text>'
    for axis, curves in zip(axes, (_amplitude(panel), _phase(panel), _residual(panel)), strict=True):
        yield from _draw_axes(axis, axis is axes[-1])
        yield f'<svg x="{axis.left}" y="{axis.top}" width="{axis.width}" height="{axis.height}">'
        for style, width_of_line, values in curves:
            yield _curve(axis, panel.measured.frequency, values, style, width_of_line)
        yield "</svg>"
    if panel.is_zero_in_models:
        lowest = axes[-1]
        place = f'x="{lowest.left + inner // 2}" y="{lowest.top + lowest.height // 2}" text-anchor="middle"'
        yield f'<text {place} fill="{AXIS_COLOR}">no response in the models</text>'


def _title(panel: Panel) -> str:
    return f"{panel.sensor}/{panel.component} [{panel.unit}]"


StyledCurve = tuple[PlotStyle | None, float, Array]
"""Style (None: the area of the noise), width of the line, and values (k,) of a curve."""


def _amplitude(panel: Panel) -> Iterator[StyledCurve]:
    yield PlotStyle(BLACK), 4.0, np.abs(panel.measured.value)
    for _, style, value in panel.models:
        if value.any():
            yield style, 2.4, np.abs(value)


def _phase(panel: Panel) -> Iterator[StyledCurve]:
    if not panel.is_zero_in_models:
        yield PlotStyle(BLACK), 4.0, phase_with_gaps(panel.measured.value)
    for _, style, value in panel.models:
        if value.any():
            yield style, 2.4, phase_with_gaps(value)


def _residual(panel: Panel) -> Iterator[StyledCurve]:
    size = np.abs(panel.measured.value)
    yield None, 0.0, 100 * quotient(panel.measured.sigma, size)
    for _, style, value in panel.models:
        if value.any():
            yield style, 2.2, 100 * quotient(np.abs(value - panel.measured.value), size)


def _curve(axes: _Axes, frequency: Array, values: Array, style: PlotStyle | None, width: float) -> str:
    x, y = axes.x.places(frequency), axes.y.places(values)
    if style is None:
        return f'<path fill="{NOISE_COLOR}" d="{area_path(x, y, axes.height)}"/>'
    pale = ' stroke-opacity=".55"' if style.color == BLACK else ""
    line = f'stroke="{style.color}" stroke-width="{width:g}"{pale}{_dashes(style)}'
    return f'<path fill="none" {line} d="{curve_path(x, y)}"/>'


def _dashes(style: PlotStyle) -> str:
    return f' stroke-dasharray="{" ".join(f"{2.4 * d:g}" for d in style.dashes)}"' if style.dashes else ""


def _draw_axes(axes: _Axes, with_frequencies: bool) -> Iterator[str]:
    left, top, right, bottom = axes.left, axes.top, axes.left + axes.width, axes.top + axes.height
    y_ticks = (-180.0, 0.0, 180.0) if (axes.y.low, axes.y.high) == PHASE_LIMITS else axes.y.ticks
    grid = [f"M{left} {top + axes.y.at(value):.0f}h{axes.width}" for value in y_ticks]
    grid += [f"M{left + axes.x.at(value):.0f} {top}v{axes.height}" for value in axes.x.ticks]
    yield f'<path stroke="{GRID_COLOR}" d="{"".join(grid)}"/>'
    yield f'<path fill="none" stroke="{AXIS_COLOR}" d="M{left} {top}V{bottom}H{right}"/>'
    for value in y_ticks:
        place = f'x="{left - 6}" y="{top + axes.y.at(value) + 6:.0f}" text-anchor="end" font-size="15"'
        yield f"<text {place}>{tick_text(value, axes.y)}</text>"
    middle = top + axes.height // 2
    side = f'transform="translate({left - LEFT + 20} {middle}) rotate(-90)" text-anchor="middle"'
    yield f"<text {side}>{axes.label}</text>"
    if with_frequencies:
        for value in axes.x.ticks:
            place = f'x="{left + axes.x.at(value):.0f}" y="{bottom + 20}" text-anchor="middle" font-size="15"'
            yield f"<text {place}>{tick_text(value, axes.x)}</text>"
        yield f'<text x="{right}" y="{bottom + 40}" text-anchor="end">frequency [Hz]</text>'


def phase_with_gaps(value: ComplexArray) -> Array:
    """Phase [deg] within +-180, NaN at the first line after a jump so that no curve crosses the panel."""
    phase = np.degrees(np.angle(value))
    phase[1:][np.abs(np.diff(phase)) > 180.0] = np.nan
    return np.asarray(phase)


def _amplitude_limits(panels: Sequence[Panel]) -> tuple[float, float]:
    """Limits that contain every measured curve except the deepest notches."""
    sizes = [np.abs(panel.measured.value) for panel in panels]
    high = 1.6 * max(float(size.max()) for size in sizes)
    low = min(float(np.percentile(size, 1)) for size in sizes)
    return max(0.6 * low, high / MAX_AXIS_RATIO), high


def _legend(panels: Sequence[Panel], top: int) -> tuple[str, int]:
    """Return the legend of all models from `top` down, and the place where it ends."""
    styles = {label: style for panel in panels for label, style, _ in panel.models}
    entries: list[tuple[str, PlotStyle | None]] = [("measured", PlotStyle(BLACK)), *styles.items()]
    entries.append(("noise of the measurement (1 sigma)", None))
    parts, x, y = [], LEFT, top
    for label, style in entries:
        needed = 70 + round(LETTER * len(label))
        if x > LEFT and x + needed > WIDTH:
            x, y = LEFT, y + LINE
        color, width = (style.color, 4) if style is not None else (NOISE_COLOR, 16)
        dashes = _dashes(style) if style is not None else ""
        parts.append(f'<path stroke="{color}" stroke-width="{width}"{dashes} d="M{x} {y - 6}h40"/>')
        parts.append(f'<text x="{x + 50}" y="{y}">{escape(label)}</text>')
        x += needed
    return "".join(parts), y + LINE // 2
