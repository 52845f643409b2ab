"""Nyquist plots: for each mode, the response that shows it best, as a curve in the complex plane."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.report.axis_ticks import Scale, make_scale, tick_text
from balance_cli.report.blocks import Picture
from balance_cli.report.figure_style import PlotStyle
from balance_cli.report.force_responses import Curve
from balance_cli.report.response_figures import Panel
from balance_cli.report.sources import Source

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SIZE, MARGIN = 250.0, 40.0
BANDWIDTHS = 2.0
"""Half-power bandwidths on either side of a mode: the curve then goes around 304 degrees of the circle, and modes that
are well apart do not enter it."""
FEWEST_LINES = 4
"""Lines of the measurement without which nothing of a circle is seen."""
CURVE_POINTS = 81
"""Points of a model's curve: 4 degrees of the circle apart."""
MOST_MODELS = 2


CurveStyle = tuple[str, PlotStyle]
Evaluation = Callable[[str, Panel, Array], ComplexArray | None]
"""Response of a model, by its label, at the sensor and component of a panel and at frequencies (k,) [Hz]; None where
the model has no such sensor."""


@dataclass(frozen=True)
class Loop:
    """The part of a response around a mode: sensor and component in `panel`, and the lines (k,) that belong to it."""

    frequency: float
    panel: Panel
    lines: NDArray[np.intp]

    @property
    def measured(self) -> Curve:
        """The measured response of the lines."""
        curve = self.panel.measured
        return Curve(curve.frequency[self.lines], curve.value[self.lines], curve.sigma[self.lines])


def nyquist_picture(
    source: Source[IdentifiedModel], panels: Sequence[Panel], evaluate: Evaluation, curves: Sequence[CurveStyle]
) -> Picture | None:
    """Return the plots of the modes of a model within the measured band; None where there is none.

    `curves`: label and style of the models, that of `source` first; `evaluate` gives their responses.
    """
    loops = list(mode_loops(source.content, panels))
    if not loops:
        return None
    shown = list(curves)[:MOST_MODELS]
    markup = "".join(_loop_svg(loop, evaluate, shown) for loop in loops)
    legend = f" Curves: {', '.join(label for label, _ in shown)}." if shown else ""
    caption = (
        f"Nyquist plots of the modes of {source.label}, each by the cell and component that show it best, within "
        f"{BANDWIDTHS:g} bandwidths: measured lines with one sigma where it is large enough to be seen, the nearest to "
        f"the eigenfrequency filled.{legend} A single mode is a circle; the pointer names the frequencies."
    )
    return Picture("nyquist", caption, f'<div class="shapes nyquist">{markup}</div>')


def mode_loops(model: IdentifiedModel, panels: Sequence[Panel]) -> Iterator[Loop]:
    """Yield the best response of each mode that has enough measured lines around it."""
    for frequency, zeta in zip(model.modes.frequency, model.modes.damping_ratio, strict=True):
        loops = [loop for panel in panels if (loop := _loop(float(frequency), float(zeta), panel)) is not None]
        if loops:
            yield max(loops, key=_prominence)


def _loop(frequency: float, zeta: float, panel: Panel) -> Loop | None:
    lines = panel.measured.frequency
    half = 2.0 * BANDWIDTHS * max(zeta, 0.0) * frequency
    if not lines[0] <= frequency <= lines[-1]:
        return None
    near = np.flatnonzero(np.abs(lines - frequency) <= half)
    return Loop(frequency, panel, near) if len(near) >= FEWEST_LINES else None


def _prominence(loop: Loop) -> float:
    """Size of the loop over the noise and over its distance from zero: large for a clear circle."""
    curve = loop.measured
    spread = float(np.std(curve.value))
    noise = float(np.median(curve.sigma)) or float(np.finfo(float).tiny)
    return min(spread / noise, 1e3) * spread / (float(np.abs(curve.value).max()) or 1.0)


def _loop_svg(loop: Loop, evaluate: Evaluation, curves: Sequence[CurveStyle]) -> str:
    curve = loop.measured
    fine = np.linspace(curve.frequency[0], curve.frequency[-1], CURVE_POINTS)
    models = [
        (style, value) for label, style in curves for value in [evaluate(label, loop.panel, fine)] if value is not None
    ]
    # The axes hold the measurement and the best model; another model may lie far outside.
    inside = np.concatenate([curve.value, *(value for _, value in models[:1])])
    half = 0.55 * max(float(np.ptp(inside.real)), float(np.ptp(inside.imag)), 1e-300)
    middle = [0.5 * float(part.min() + part.max()) for part in (inside.real, inside.imag)]
    x = make_scale([], MARGIN, SIZE - 6.0, limits=(middle[0] - half, middle[0] + half))
    y = make_scale([], SIZE - MARGIN + 8.0, 14.0, limits=(middle[1] - half, middle[1] + half))
    pair = f"{loop.panel.sensor}/{loop.panel.component}"
    title = f"{loop.frequency:.2f} Hz, {pair}"
    parts = [*_axes(x, y, loop.panel.unit)]
    for style, value in models:
        parts.append(_curve(value, x, y, style))
    nearest = int(np.argmin(np.abs(curve.frequency - loop.frequency)))
    scale = abs(x.at(x.high) - x.at(x.low)) / (x.high - x.low)
    for i, (f, value, sigma) in enumerate(zip(curve.frequency, curve.value, curve.sigma, strict=True)):
        fill = "currentColor" if i == nearest else "none"
        radius = max(scale * float(sigma), 2.2) if np.isfinite(sigma) else 2.2
        parts.append(
            f'<circle cx="{x.at(value.real):.1f}" cy="{y.at(value.imag):.1f}" r="{radius:.1f}" fill="{fill}" '
            f'stroke="currentColor" stroke-width=".8"><title>{f:.4g} Hz</title></circle>'
        )
    return (
        f'<svg class="plot" viewBox="0 0 {SIZE:g} {SIZE:g}" role="img" aria-label="Nyquist plot of the mode at '
        f'{escape(title)}" xmlns="http://www.w3.org/2000/svg" font-family="sans-serif" font-size="9">'
        f'<text x="4" y="10" font-weight="600">{escape(title)}</text>{"".join(parts)}</svg>'
    )


def _axes(x: Scale, y: Scale, unit: str) -> Iterator[str]:
    bottom = max(y.start, y.stop)

    def word(value: float, scale: Scale, place: str) -> str:
        return f'<text {place} font-size="8">{tick_text(value, scale)}</text>'

    for value in x.ticks:
        yield f'<path class="grid" d="M{x.at(value):.1f} 14V{bottom:g}"/>'
        yield word(value, x, f'x="{x.at(value):.1f}" y="{bottom + 10:g}" text-anchor="middle"')
    for value in y.ticks:
        yield f'<path class="grid" d="M{MARGIN:g} {y.at(value):.1f}H{SIZE - 6:g}"/>'
        yield word(value, y, f'x="{MARGIN - 3:g}" y="{y.at(value) + 3:.1f}" text-anchor="end"')
    for at, path in ((x, f"M{x.at(0.0):.1f} 14V{bottom:g}"), (y, f"M{MARGIN:g} {y.at(0.0):.1f}H{SIZE - 6:g}")):
        if at.low <= 0.0 <= at.high:
            yield f'<path class="axis" d="{path}"/>'
    yield f'<text x="{SIZE - 6:g}" y="{bottom + 21:g}" text-anchor="end">real part [{escape(unit)}]</text>'
    side = f'transform="translate(9 {SIZE / 2:g}) rotate(-90)" text-anchor="middle"'
    yield f"<text {side}>imaginary part [{escape(unit)}]</text>"


def _curve(value: ComplexArray, x: Scale, y: Scale, style: PlotStyle) -> str:
    words, command = [], "M"
    for v in value:
        if not (x.low <= v.real <= x.high and y.low <= v.imag <= y.high):
            command = "M"
            continue
        words.append(f"{command}{x.at(v.real):.1f} {y.at(v.imag):.1f}")
        command = "L"
    dashes = f' stroke-dasharray="{" ".join(f"{2 * d:g}" for d in style.dashes)}"' if style.dashes else ""
    return f'<path fill="none" stroke="{style.color}" stroke-width="1.6"{dashes} d="{"".join(words)}"/>'
