"""Polar plots of the 1/rev and blade harmonic of each component: cosine to the right, sine down, a point a run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from itertools import takewhile

import numpy as np

from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.reduction.result import RunLoads
from balance_cli.report.blocks import Picture
from balance_cli.report.load_figures import RUN_COLORS
from balance_cli.report.number_format import format_fixed, value_and_sigma_text

SIZE, RADIUS = 170.0, 62.0
MOST_NAMES = 4
"""Runs that the legend has room for; the pointer names the others."""
DOT = 2.6
"""Radius of a point [px]."""
LETTER = 4.9
"""Mean width of a letter of the legend [px at a font of 9 px], digits and hyphens included."""
LEGEND_LINE = 11.0
"""Height of a line of the legend [px]."""
MOST_LETTERS = 30
"""Letters of a name that fit a line of the legend."""


def polar_picture(runs: dict[str, RunLoads], blades: int, label: str) -> Picture:
    """Return the plots of all components, at 1/rev and at the blade harmonic where it was reduced."""
    last = min(len(run.frequency_hz) for run in runs.values()) - 1
    orders = tuple(dict.fromkeys(n for n in (1, blades) if 1 <= n <= last))
    markup = "".join(
        _polar_svg(f"{name} {n}/rev", UNIT_OF[name], list(_points(runs, name, n)))
        for n in orders
        for name in COMPONENTS
        if any(name in run.components for run in runs.values())
    )
    caption = (
        f"Harmonics by {label} as vectors A exp(j phase), load = A cos(n azimuth + phase): phase counts from the "
        "right, anticlockwise. A shaded disk has the radius of one sigma, where that exceeds the point."
    )
    return Picture("polar", caption, f'<div class="shapes">{markup}</div>')


def _points(runs: dict[str, RunLoads], name: str, n: int) -> Iterator[tuple[str, str, complex, float]]:
    """Yield name and color of each run, its harmonic, and the larger sigma of cosine and sine."""
    for i, (run_name, run) in enumerate(runs.items()):
        if name in run.components:
            m = run.components.index(name)
            sigma = max(float(run.sigma_cosine[n, m]), float(run.sigma_sine[n, m]))
            yield run_name, RUN_COLORS[i % len(RUN_COLORS)], complex(run.amplitude[n, m]), sigma


def _polar_svg(title: str, unit: str, points: list[tuple[str, str, complex, float]]) -> str:
    reaches = (abs(value) + np.nan_to_num(sigma) for _, _, value, sigma in points if np.isfinite(value))
    largest = max(reaches, default=0.0) or 1.0
    scale, middle = RADIUS / largest, SIZE / 2
    parts = [
        f'<circle class="grid" fill="none" cx="{middle:g}" cy="{middle:g}" r="{share * RADIUS:g}"/>'
        for share in (0.5, 1.0)
    ]
    start, length = middle - RADIUS, 2 * RADIUS
    parts.append(f'<path class="grid" d="M{start:g} {middle:g}h{length:g}M{middle:g} {start:g}v{length:g}"/>')
    for run, color, value, sigma in points:
        if not np.isfinite(value):
            continue
        x, y = middle + scale * value.real, middle - scale * value.imag
        size, spread = value_and_sigma_text(abs(value), sigma)
        phase = format_fixed(float(np.degrees(np.angle(value))), 1)
        words = f"{run}: {size} \N{PLUS-MINUS SIGN} {spread} {unit}, {phase}°"
        parts.append(
            f'<g stroke="{color}" fill="{color}">{_sigma_disk(x, y, scale * sigma)}'
            f'<path d="M{middle:g} {middle:g}L{x:.1f} {y:.1f}"/>'
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{DOT:g}"><title>{escape(words)}</title></circle></g>'
        )
    finite = [(run, color) for run, color, value, _ in points if np.isfinite(value)]
    legend, lines = _legend(finite[:MOST_NAMES])
    height = SIZE + 1.0 + LEGEND_LINE * lines
    return (
        f'<svg class="plot" viewBox="0 0 {SIZE:g} {height:g}" role="img" aria-label="Polar plot of {escape(title)}" '
        f'xmlns="http://www.w3.org/2000/svg" font-family="sans-serif" font-size="9">'
        f'<text x="4" y="10" font-weight="600">{escape(title)}, radius {largest:.4g} {escape(unit)}</text>'
        f"{''.join(parts)}{legend}</svg>"
    )


def _sigma_disk(x: float, y: float, radius: float) -> str:
    """Return a shaded disk of one sigma about a point, empty where the point covers it or sigma is not known."""
    if not (np.isfinite(radius) and radius > DOT):
        return ""
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" stroke="none" fill-opacity="0.18"/>'


def _legend(entries: Sequence[tuple[str, str]]) -> tuple[str, int]:
    """Return names beside their colors, in as many lines as they need, and the number of lines."""
    names, x, line, parts = shorten_names([run for run, _ in entries]), 4.0, 0, []
    for name, (_, color) in zip(names, entries, strict=True):
        width = 12.0 + LETTER * len(name)
        if x > 4.0 and x + width > SIZE:
            x, line = 4.0, line + 1
        y = SIZE + 8.0 + LEGEND_LINE * line
        square = f'<rect x="{x:.4g}" y="{y - 6:g}" width="5" height="5" fill="{color}"/>'
        parts.append(f'{square}<text x="{x + 7:.4g}" y="{y:g}">{escape(name)}</text>')
        x += width
    return "".join(parts), line + 1


def shorten_names(names: Sequence[str]) -> list[str]:
    """Return the names whole, or of long ones the part after what all begin with, and of that the ends."""
    # Between the first and the last in the order of letters lie all others: what these two share, all do.
    pairs = zip(min(names, default=""), max(names, default=""), strict=False)
    shared = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs)) if len(names) > 1 else 0
    shortened = []
    for name in names:
        rest = name if len(name) <= MOST_LETTERS else "\N{HORIZONTAL ELLIPSIS}" + name[shared:]
        if len(rest) > MOST_LETTERS:
            head = (MOST_LETTERS - 1) // 2
            rest = f"{rest[:head]}\N{HORIZONTAL ELLIPSIS}{rest[head + 1 - MOST_LETTERS :]}"
        shortened.append(rest)
    return shortened
