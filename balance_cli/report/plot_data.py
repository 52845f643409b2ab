"""Charts as the data of the page's script: compact JSON, long arrays in base64, equal arrays once."""

from __future__ import annotations

import base64
import json
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from balance_cli.report.blocks import Chart
from balance_cli.report.plots import Plot, Trace

Array = NDArray[np.float64]

LEVELS = 65534
"""Levels of a compact array; one more stands for a missing value."""
MISSING_LEVEL = 65535
LARGEST_RATIO = 1e12
"""Ratio of largest to smallest up to which a compact array is logarithmic: 12 decades in LEVELS are 4e-4 a level."""
UNIFORM_TOLERANCE = 1e-9
"""Relative deviation from equal spacing below which x is sent as start, stop and count."""


class _ArrayTable:
    """The arrays of one chart, each once."""

    def __init__(self) -> None:
        self.entries: list[dict[str, Any]] = []
        self._index: dict[str, int] = {}

    def add(self, values: Array, compact: bool, log: bool) -> int:
        entry = _encode(np.asarray(values, float), compact, log)
        key = json.dumps(entry)
        if key not in self._index:
            self._index[key] = len(self.entries)
            self.entries.append(entry)
        return self._index[key]


def chart_json(chart: Chart) -> str:
    """Return the data of a chart as JSON that can stand inside a script element."""
    table = _ArrayTable()
    groups = [{"label": group.label, "plots": [_plot(plot, table) for plot in group.plots]} for group in chart.groups]
    data = {"link": chart.link, "groups": groups, "arrays": table.entries}
    return script_json(json.dumps(data, separators=(",", ":"), ensure_ascii=False, allow_nan=False))


def script_json(text: str) -> str:
    """Return JSON in a form that can stand inside a script element."""
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _plot(plot: Plot, table: _ArrayTable) -> dict[str, Any]:
    return {
        "title": plot.title,
        "x": table.add(plot.x, False, False),
        "xl": plot.x_label,
        "yl": plot.y_label,
        "log": plot.log_y,
        "lim": plot.limits,
        "h": plot.height,
        "marks": [[round(marker.x, 6), marker.label] for marker in plot.markers],
        "traces": [_trace(trace, table, plot.log_y) for trace in plot.traces],
    }


def _trace(trace: Trace, table: _ArrayTable, log: bool) -> dict[str, Any]:
    item: dict[str, Any] = {"l": trace.label, "c": trace.color, "w": trace.width}
    item["y"] = table.add(trace.y, trace.compact, log)
    if trace.dashes:
        item["d"] = trace.dashes
    if trace.points:
        item["p"] = 1
    if trace.band is not None:
        item["b"] = [table.add(edge, trace.compact, log) for edge in trace.band]
    return item


def _encode(values: Array, compact: bool, log: bool) -> dict[str, Any]:
    """Encode an array: `u` [start, stop, count], `q` 16-bit levels of step s from a (`g`: logarithmic), `f` float32."""
    known = values[np.isfinite(values)]
    if len(values) > 2 and len(known) == len(values):
        straight = np.linspace(values[0], values[-1], len(values))
        if np.max(np.abs(values - straight)) <= UNIFORM_TOLERANCE * max(abs(values[-1]), abs(values[0])):
            return {"u": [float(values[0]), float(values[-1]), len(values)]}
    if compact and len(known):
        return _encode_levels(values, log)
    with np.errstate(over="ignore"):
        return {"f": base64.b64encode(values.astype("<f4").tobytes()).decode("ascii")}


def _encode_levels(values: Array, log: bool) -> dict[str, Any]:
    positive = values[np.isfinite(values) & (values > 0)]
    if log and len(positive):
        largest = float(positive.max())
        smallest = max(float(positive.min()), largest / LARGEST_RATIO)
        with np.errstate(invalid="ignore", divide="ignore"):
            scaled = np.log(np.where(values > 0, np.maximum(values, smallest), np.nan))
        low, high = math.log(smallest), math.log(largest)
    else:
        log, scaled = False, values
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
    step = (high - low) / LEVELS or 1.0
    levels = np.where(np.isfinite(scaled), np.round((np.nan_to_num(scaled) - low) / step), MISSING_LEVEL)
    entry: dict[str, Any] = {"q": base64.b64encode(levels.astype("<u2").tobytes()).decode("ascii"), "a": low, "s": step}
    if log:
        entry["g"] = 1
    return entry
