"""Figures as markup: one style, colors for color-blind readers, and the same bytes for the same data."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from balance_cli.report.inline_svg import inline_svg

# Colors of Okabe and Ito (Color Universal Design, 2008); EXTRA_COLORS are from Tol's muted scheme.
BLACK, GRAY, ORANGE, SKY, GREEN = "#222222", "#8a8a8a", "#e69f00", "#56b4e9", "#009e73"
BLUE, VERMILION, PURPLE = "#0072b2", "#d55e00", "#cc79a7"
EXTRA_COLORS = ("#882255", "#999933", "#44aa99", "#332288", "#aa4499")
SCREEN_PIXELS = 130
"""Resolution of rasterized curves [1/inch]: between one and two times that of a screen."""

PICTURE_PIXELS = 180
"""Resolution of a picture in its own file [1/inch]: fits the width of a page at screen size."""

RC_PARAMS: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 4.0,
    "axes.titley": 1.0,
    "axes.labelsize": 8.0,
    "axes.linewidth": 0.6,
    "axes.edgecolor": "#666666",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.1,
    "lines.markersize": 4.0,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.minor.size": 0.0,
    "ytick.minor.size": 0.0,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "hatch.linewidth": 0.6,
    "svg.fonttype": "none",
    "axes.unicode_minus": True,
    "text.parse_math": False,  # names of channels and runs may contain `$`
}


@dataclass(frozen=True)
class PlotStyle:
    """Color, line dashes and marker of one model or method in all figures."""

    color: str
    dashes: tuple[float, ...] = ()
    marker: str = "o"

    @property
    def line_kwargs(self) -> dict[str, Any]:
        """Keyword arguments of `Axes.plot`."""
        return {"color": self.color, "linestyle": (0, self.dashes) if self.dashes else "-"}


DATA_STYLE = PlotStyle(BLACK)


@contextmanager
def figure_style(name: str) -> Iterator[None]:
    """Apply the style of the page; identifiers inside the figure are derived from `name`."""
    with matplotlib.rc_context({**RC_PARAMS, "svg.hashsalt": name}):
        yield


def svg(name: str, description: str, draw: Callable[[], Figure]) -> str:
    """The figure that `draw` returns, as inline SVG; `description` is the text for screen readers."""
    with figure_style(name):
        figure = draw()
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", dpi=SCREEN_PIXELS, metadata=dict.fromkeys(("Date", "Creator", "Format")))
    return inline_svg(buffer.getvalue(), name, description)


def save_picture(path: Path, name: str, draw: Callable[[], Figure], file_format: str) -> None:
    """Save the figure that `draw` returns to a file (`png`, `svg` or `pdf`)."""
    date_field = {"png": "Software", "pdf": "CreationDate"}.get(file_format, "Date")
    with figure_style(name):
        draw().savefig(path, format=file_format, dpi=PICTURE_PIXELS, metadata={date_field: None}, facecolor="white")


def new_figure(width: float, height: float) -> Figure:
    """An empty figure, size in inches; the page is 12 inches wide."""
    return Figure(figsize=(width, height))


def _tick_label(value: float, _: object) -> str:
    """The number at a tick, with an exponent where it would be long."""
    if 1e-4 <= abs(value) < 1e5:
        return f"{value:g}"
    mantissa, exponent = f"{value:.0e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def set_log_axis(axes: Axes, limits: tuple[float, float]) -> None:
    """Set a logarithmic y-axis with plain numbers: decades, or 1, 2 and 5 where it spans less than two decades."""
    axes.set_yscale("log")
    axes.set_ylim(*limits)
    few_decades = np.log10(limits[1] / limits[0]) < 1.7
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few_decades else (1.0,), numticks=20))
    axes.yaxis.set_major_formatter(FuncFormatter(_tick_label))
    axes.yaxis.set_minor_locator(NullLocator())


def log_limits(
    values: Sequence[float] | np.ndarray[Any, Any], min_decades: float, margin: float
) -> tuple[float, float]:
    """Limits of a logarithmic axis around the positive values, at least `min_decades` wide."""
    finite = np.asarray(values, float)
    finite = finite[np.isfinite(finite) & (finite > 0)]
    if not len(finite):
        return 0.1, 0.1 * 10.0**min_decades
    low, high = float(finite.min()) / margin, float(finite.max()) * margin
    missing = min_decades - np.log10(high / low)
    if missing > 0:
        low, high = low * 10 ** (-missing / 2), high * 10 ** (missing / 2)
    return low, high
