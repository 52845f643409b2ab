"""Static pictures of plots as inline SVG: for print, for pages without scripts, and for files of their own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from balance_cli.report.axis_ticks import Scale, make_scale, tick_text
from balance_cli.report.blocks import Chart, Picture
from balance_cli.report.plots import Plot, Trace, envelope

Array = NDArray[np.float64]

WIDTH, HEIGHT = 380.0, 200.0
LEFT, RIGHT, TOP, BOTTOM = 54.0, 8.0, 20.0, 34.0
STATIC_BINS = 120
"""Bins of a static curve: with minimum and maximum of each, a point for every 1.5 px of the plot."""
BAND_POINTS = 60
"""Points of a band: it is drawn pale behind its curve."""
LETTER = 5.2
"""Mean width of a letter of the legend [px at a font of 10 px]."""


def plot_svg(plot: Plot) -> str:
    """Return one plot as an `svg` element with axes, markers, bands, curves and a legend."""
    box = (LEFT, TOP, WIDTH - RIGHT, HEIGHT - BOTTOM)
    x_scale = make_scale([plot.x], box[0], box[2])
    y_scale = make_scale(_visible_values(plot), box[3], box[1], plot.log_y, plot.limits, margin=0.05)
    parts = [
        *_grid(plot, x_scale, y_scale, box),
        *_markers(plot, x_scale, box),
        *(part for trace in plot.traces for part in _trace(trace, plot.x, x_scale, y_scale)),
        *_legend(plot.traces),
    ]
    label = escape(f"{plot.title}: {plot.y_label} over {plot.x_label}", quote=True)
    return (
        f'<svg class="plot" viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="{label}" '
        f'xmlns="http://www.w3.org/2000/svg" font-family="sans-serif" font-size="10">'
        f'<text x="{box[0]:g}" y="12" font-weight="600">{escape(plot.title)}</text>{"".join(parts)}</svg>'
    )


def plots_svg(plots: Sequence[Plot]) -> str:
    """Return several plots, two in a row, as one SVG file on a white ground."""
    columns = min(2, len(plots))
    rows = -(-len(plots) // columns)
    parts = [
        f'<svg x="{i % columns * WIDTH:g}" y="{i // columns * HEIGHT:g}" width="{WIDTH:g}" height="{HEIGHT:g}" '
        + plot_svg(plot)[len("<svg ") :]
        for i, plot in enumerate(plots)
    ]
    size = f"{columns * WIDTH:g} {rows * HEIGHT:g}"
    ground = '<rect width="100%" height="100%" fill="white"/>'
    style = "<style>.grid{stroke:#e4e4e4}.axis{stroke:#666}.mark{stroke:#999}.grid,.axis,.mark{stroke-width:.6}</style>"
    return f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size}">{style}{ground}{"".join(parts)}</svg>\n'


def _visible_values(plot: Plot) -> list[Array]:
    values = [trace.y for trace in plot.traces]
    return values + [edge for trace in plot.traces if trace.band is not None and not plot.log_y for edge in trace.band]


def _grid(plot: Plot, x: Scale, y: Scale, box: tuple[float, float, float, float]) -> Iterator[str]:
    left, top, right, bottom = box
    for value in y.ticks:
        place = y.at(value)
        yield f'<path class="grid" d="M{left:g} {place:.1f}H{right:g}"/>'
        yield f'<text x="{left - 4:g}" y="{place + 3:.1f}" text-anchor="end">{tick_text(value, y)}</text>'
    for value in x.ticks:
        place = x.at(value)
        yield f'<path class="grid" d="M{place:.1f} {top:g}V{bottom:g}"/>'
        yield f'<text x="{place:.1f}" y="{bottom + 11:g}" text-anchor="middle">{tick_text(value, x)}</text>'
    yield f'<path class="axis" fill="none" d="M{left:g} {top:g}V{bottom:g}H{right:g}"/>'
    yield f'<text x="{right:g}" y="{bottom + 21:g}" text-anchor="end">{escape(plot.x_label)}</text>'
    middle = 0.5 * (top + bottom)
    yield (f'<text transform="translate(10 {middle:g}) rotate(-90)" text-anchor="middle">{escape(plot.y_label)}</text>')


def _markers(plot: Plot, x: Scale, box: tuple[float, float, float, float]) -> Iterator[str]:
    free = 0.0
    for marker in plot.markers:
        if x.low <= marker.x <= x.high:
            place = x.at(marker.x)
            yield f'<path class="mark" stroke-dasharray="3 3" d="M{place:.1f} {box[1]:g}V{box[3]:g}"/>'
            if marker.label and place >= free:
                free = place + 4 + LETTER * len(marker.label)
                yield f'<text x="{place + 2:.1f}" y="{box[1] + 8:g}" font-size="8">{escape(marker.label)}</text>'


def _trace(trace: Trace, x: Array, x_scale: Scale, y_scale: Scale) -> Iterator[str]:
    if trace.band is not None:
        yield _band(trace, x, x_scale, y_scale)
    xs, ys = (x, trace.y) if trace.points else envelope(x, trace.y, STATIC_BINS)
    points = [(x_scale.at(a), y_scale.at(b)) if np.isfinite(b) else None for a, b in zip(xs, ys, strict=True)]
    if trace.points:
        circles = "".join(f'<circle cx="{p[0]:.1f}" cy="{p[1]:.1f}" r="2.4"/>' for p in points if p is not None)
        yield f'<g fill="{trace.color}">{circles}</g>'
        return
    dashes = f' stroke-dasharray="{" ".join(f"{d:g}" for d in trace.dashes)}"' if trace.dashes else ""
    yield (
        f'<path fill="none" stroke="{trace.color}" stroke-width="{trace.width:g}"{dashes} '
        f'stroke-linejoin="round" d="{_path(points)}"/>'
    )


def _band(trace: Trace, x: Array, x_scale: Scale, y_scale: Scale) -> str:
    assert trace.band is not None
    low, high = trace.band
    step = max(1, len(x) // BAND_POINTS)
    index = [i for i in range(0, len(x), step) if np.isfinite(low[i]) and np.isfinite(high[i])]
    edge = [(x_scale.at(x[i]), y_scale.at(high[i])) for i in index]
    edge += [(x_scale.at(x[i]), y_scale.at(low[i])) for i in reversed(index)]
    return f'<path fill="{trace.color}" fill-opacity=".22" d="{_path(list(edge))}Z"/>' if edge else ""


def _path(points: Sequence[tuple[float, float] | None]) -> str:
    """Join points by lines; None interrupts the curve."""
    words, command = [], "M"
    for point in points:
        if point is None:
            command = "M"
            continue
        words.append(f"{command}{point[0]:.1f} {point[1]:.1f}")
        command = "L"
    return "".join(words)


def _legend(traces: Sequence[Trace]) -> Iterator[str]:
    if len(traces) < 2:
        return
    place, y = LEFT, HEIGHT - 4.0
    for trace in traces:
        needed = 18.0 + LETTER * len(trace.label)
        if place + needed > WIDTH:
            return
        yield f'<path stroke="{trace.color}" stroke-width="2" d="M{place:g} {y - 3:g}h12"/>'
        yield f'<text x="{place + 15:.1f}" y="{y:g}" font-size="9">{escape(trace.label)}</text>'
        place += needed


def picture_svg(block: Picture | Chart) -> str:
    """Return a picture of the page as an SVG document; of a chart, its static picture."""
    if isinstance(block, Picture):
        return block.markup + "\n"
    return block.static_markup + "\n" if block.static_markup else plots_svg(block.groups[0].plots)
