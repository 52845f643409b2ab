"""Table, summary and text of `balance apply`."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np

from balance_cli.io.errors import UserError
from balance_cli.io.units import FORCE, MOMENT, Unit, parse_unit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from balance_cli.calibration.result import Calibration
    from balance_cli.campaign.recording.load_table import LoadTable
    from balance_cli.steps.point_loads import PointLoads

DIGITS = 8
"""Significant digits of a load: two more than the best balances resolve."""


def output_units(calibration: Calibration, tables: Sequence[LoadTable], asked: str | None) -> dict[str, Unit]:
    """Unit in which each component is written: as asked, as in the first table that has loads, else SI."""
    from balance_cli.campaign.rig.load_components import load_components

    components = load_components(calibration.geometry)
    try:
        units = [parse_unit(text, FORCE, MOMENT) for text in (asked or "").split(",") if text.strip()]
    except UserError as error:
        raise error.with_location("--load-units") from None
    by_dimension = {unit.dimension: unit for unit in reversed(units)}
    in_table = next((table.load_units for table in tables if table.load_units), {})
    by_table = {unit.dimension: unit for unit in reversed(tuple(in_table.values()))}
    return {
        name: by_dimension.get(unit) or in_table.get(name) or by_table.get(unit) or parse_unit(unit)
        for name, unit in zip(components.names, components.units, strict=True)
    }


def loads_csv(tables: Sequence[LoadTable], loads: Sequence[PointLoads], units: Mapping[str, Unit]) -> str:
    """The table of loads: one row for each row of the inputs, in their order."""
    import csv

    from balance_cli.steps.point_readings import row_runs

    labels = [key for key in ("series", "point") if any(key in table.labels for table in tables)]
    with_applied = any(run.applied is not None for run in loads)
    kinds = ("", "sigma_", *(("applied_", "error_") if with_applied else ()))
    head = [f"{kind}{name} [{unit.symbol}]" for kind in kinds for name, unit in units.items()]
    stream = StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["run", "line", *labels, *head, "flag"])
    for table, run in zip(tables, loads, strict=True):
        names, columns = row_runs(table), _columns(run, units, with_applied)
        for i, line in enumerate(table.lines):
            own = [table.labels[key][i] if key in table.labels else "" for key in labels]
            writer.writerow([names[i], line, *own, *map(_number, columns[i]), run.flags[i]])
    return stream.getvalue()


def _columns(run: PointLoads, units: Mapping[str, Unit], with_applied: bool) -> NDArray[np.float64]:
    """Columns (n, q) of loads, sigma, and where loads are known those and the errors, in the units asked."""
    scale = np.array([units[name].factor for name in run.components])
    parts = [run.loads, run.sigma]
    if with_applied:
        applied = np.full(run.loads.shape, np.nan) if run.applied is None else run.applied
        parts += [applied, run.loads - applied]
    return np.hstack([part / scale for part in parts])


def _number(value: float) -> str:
    return f"{value:.{DIGITS}g}" if np.isfinite(value) else ""


def apply_summary(loads: Sequence[PointLoads]) -> dict[str, Any]:
    """The summary, for JSON."""
    return {"runs": {run.run: _run_summary(run) for run in loads}}


def _run_summary(run: PointLoads) -> dict[str, Any]:
    summary: dict[str, Any] = {
        "rows": len(run.loads),
        "method": run.method,
        "zero": run.zero,
        "flags": dict(_flag_counts(run)),
        "channels_left_out": run.left_out,
    }
    if run.applied is not None:
        summary["error"] = dict(zip(run.components, _rms_errors(run), strict=True))
        summary["within_interval"] = dict(zip(run.components, _coverage(run), strict=True))
    return summary


def apply_warnings(loads: Sequence[PointLoads], tables: Sequence[LoadTable], calibration: Calibration) -> Iterator[str]:
    """Warnings about absent channels, and about rows in attitudes in which the weight is not known, or none stated."""
    yield from _unstated_attitudes(tables, calibration)
    tares = None if calibration.all_trims is None else calibration.all_trims.tares
    for run in loads:
        yield from _attitude_warning(run) if tares is None else ()
        if run.left_out:
            yield f"{run.run}: channels absent: {', '.join(run.left_out)}; the others determine the loads"


def _unstated_attitudes(tables: Sequence[LoadTable], calibration: Calibration) -> Iterator[str]:
    """Tables without attitudes, where the calibration knows the weight of the metric part."""
    tares = None if calibration.all_trims is None else calibration.all_trims.tares
    for table in tables if tares is not None else ():
        assert tares is not None
        if table.attitude is None:
            change = math.radians(1.0) * tares.weight
            yield (
                f"{table.path.name} states no attitude and counts as level: the weight of the metric part, "
                f"{tares.weight:.4g} N, changes the forces by {change:.3g} N for each degree; state `pitch` and `roll`"
            )


def _attitude_warning(run: PointLoads) -> Iterator[str]:
    from balance_cli.reduction.flags import NO_WEIGHT

    count = sum(NO_WEIGHT in flags.split("; ") for flags in run.flags)
    if count:
        yield (
            f"{run.run}: {count} of {len(run.flags)} rows were read in another attitude than their zero: their loads "
            "contain the change of the weight of the metric part, which the calibration does not know; calibrate with "
            "load series in three attitudes or more, with columns `pitch` and `roll`"
        )


def _flag_counts(run: PointLoads) -> Counter[str]:
    """How many rows have each flag; the components of `extrapolated` are left out."""
    words = [word for flags in run.flags for word in flags.split("; ") if word]
    return Counter("extrapolated" if word.startswith("extrapolated") else word for word in words)


def _rms_errors(run: PointLoads) -> list[float]:
    """Rms error (k,) [N, N m] of the rows with loads; NaN without any."""
    assert run.applied is not None
    errors = (run.loads - run.applied)[np.isfinite(run.loads).all(axis=1)]
    return np.sqrt(np.mean(errors**2, axis=0)).tolist() if len(errors) else [float("nan")] * len(run.components)


def _coverage(run: PointLoads) -> list[float]:
    """Share (k,) of the rows with loads whose error is within the prediction interval; NaN where none is known."""
    assert run.applied is not None
    rows = np.isfinite(run.loads).all(axis=1)
    if not rows.any() or not np.isfinite(run.interval[rows]).all():
        return [float("nan")] * len(run.components)
    within = np.abs(run.loads - run.applied)[rows] <= run.interval[rows]
    return [float(share) for share in within.mean(axis=0)]


def apply_text(loads: Sequence[PointLoads], units: Mapping[str, Unit]) -> Iterator[str]:
    """Lines for the user: rows, method, zero, flags, and errors where loads are known."""
    for run in loads:
        yield f"{run.run}: {len(run.loads)} rows, {run.method} method, zero: {run.zero}"
        for flag, count in _flag_counts(run).items():
            yield f"  {count} of {len(run.loads)} rows: {flag}"
        if run.applied is None:
            continue
        yield "  component      rms error   within 95 % interval (without the error of the applied loads)"
        for name, error, share in zip(run.components, _rms_errors(run), _coverage(run), strict=True):
            unit = units[name]
            within = f"{100 * share:6.1f} %" if np.isfinite(share) else "not known"
            yield f"  {name:9s} {error / unit.factor:12.5g} {unit.symbol:7s} {within}"
