"""The figure of the study of filters: a maneuver in time, and errors by case and method."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from balance_cli.report.figure_style import BLACK, BLUE, GREEN, ORANGE, VERMILION, new_figure
from studies.filters import NOMINAL_HARMONICS, reduce_by_method, simulate_record
from studies.filters_rig import CASES, COLUMNS, MANEUVER

SHOWN_METHODS = {NOMINAL_HARMONICS: VERMILION, "harmonics, filter": BLUE, "harmonics, smoother": GREEN}
"""Methods whose histories are drawn."""
SPAN = (6.3, 7.2)
"""Times [s] between which the maneuver is drawn."""
METHOD_COLORS = {"T at": VERMILION, "harmonics": GREEN, "random": BLUE, "free": ORANGE}
MARKERS = {"in_band": "o", "harmonics": "|"}
LIMITS = (3e-4, 2e1)


def filters_picture(table: pd.DataFrame) -> Figure:
    """Draw load and errors in a maneuver above, and errors of all methods in each case below."""
    figure = new_figure(11.0, 8.2)
    above = figure.add_gridspec(1, 2, left=0.06, right=0.985, top=0.965, bottom=0.72, wspace=0.12)
    _draw_maneuver(figure.add_subplot(above[0, 0]), figure.add_subplot(above[0, 1]))
    below = figure.add_gridspec(2, 4, left=0.165, right=0.985, top=0.63, bottom=0.04, hspace=0.24, wspace=0.09)
    for i, case in enumerate(dict.fromkeys(table["case"])):
        _draw_errors(figure.add_subplot(below[i // 4, i % 4]), table[table["case"] == case], case, labeled=i % 4 == 0)
    _draw_key(figure.add_subplot(below[1, 3]))
    return figure


def _draw_maneuver(loads: Axes, errors: Axes) -> None:
    """Draw the true Fx, that of three methods, and their errors."""
    record = simulate_record(CASES[MANEUVER], 0)
    for method, color in SHOWN_METHODS.items():
        reduced = reduce_by_method(record, method)
        part = slice(reduced.first, reduced.first + len(reduced.loads))
        time, true = record.truth.time[part], record.truth.loads[part, COLUMNS[0]]
        loads.plot(time, reduced.loads[:, 0], color=color, label=method)
        errors.plot(time, reduced.loads[:, 0] - true, color=color)
    loads.plot(record.truth.time, record.truth.loads[:, COLUMNS[0]], color=BLACK, linestyle=(0, (4, 2)), label="true")
    loads.set_title("Fx [N] in a maneuver")
    errors.set_title("error of Fx [N]")
    for axes in (loads, errors):
        axes.set_xlim(SPAN)
        axes.set_xlabel("time [s]")
    low, high = loads.get_ylim()
    loads.set_ylim(low, high + 0.35 * (high - low))
    loads.legend(loc="upper left", ncols=2)


def _draw_errors(axes: Axes, rows: pd.DataFrame, case: str, labeled: bool) -> None:
    """Draw medians and ranges over the seeds, one row per method."""
    methods = list(rows["method"])[::-1]
    for _, row in rows.iterrows():
        place, color = methods.index(row["method"]), _method_color(row["method"])
        for name, marker in MARKERS.items():
            shift = 0.0 if name == "in_band" else -0.28
            axes.plot([row[f"{name}_min"], row[f"{name}_max"]], [place + shift] * 2, color=color, linewidth=0.9)
            axes.plot(row[f"{name}_median"], place + shift, marker, color=color, markersize=5 if marker == "o" else 7)
    axes.set_xscale("log")
    axes.set_xlim(LIMITS)
    axes.set_ylim(-0.7, len(methods) - 0.4)
    axes.set_yticks(range(len(methods)), methods if labeled else [""] * len(methods))
    axes.axvline(1.0, color=BLACK, linewidth=0.6)
    axes.set_title(case)


def _method_color(method: str) -> str:
    return next(color for start, color in METHOD_COLORS.items() if method.startswith(start))


def _draw_key(axes: Axes) -> None:
    """Write what the marks mean."""
    axes.axis("off")
    lines: Sequence[str] = (
        "Relative error, both loads together;",
        "lines: range over the seeds.",
        "dot: median error of the load in time,",
        "       below 150 Hz",
        "tick: median error of harmonics 1 to 8",
        "beyond the black line the mean load",
        "alone would err less",
    )
    axes.text(0.02, 0.95, "\n".join(lines), va="top", transform=axes.transAxes)
