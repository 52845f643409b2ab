"""Results as tables: long (a row a value) and wide (a row a run), with as many digits as their sigma deserves."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np

from balance_cli.io.errors import UserError
from balance_cli.io.formula_cells import text_cell
from balance_cli.io.result_view import ResultView
from balance_cli.reduction.polar import polar_sigma
from balance_cli.reduction.result import LOAD_TABLE_COLUMNS, HubLoads, load_rows

if TYPE_CHECKING:
    import pandas as pd

Columns = dict[str, list[Any]]
"""The values of each column. Of loads they are made without pandas, whose import takes longer than all else here."""
SIGMA_COLUMNS = {
    "cosine": "sigma_cosine",
    "sine": "sigma_sine",
    "amplitude": "sigma_amplitude",
    "phase_deg": "sigma_phase_deg",
}
"""Column of the sigma that belongs to each column of values of a table of loads."""
SIGMA_DIGITS = 3
"""Significant digits of sigma, and the digits of its value: one beyond those that are significant, for arithmetic."""
OTHER_DIGITS = 9
"""Significant digits of numbers without sigma, frequencies among them: more than any clock of an acquisition has."""


def long_table(content: ResultView) -> pd.DataFrame:
    """Return a result as a table with a row for each value."""
    if not isinstance(content, HubLoads):
        return content.to_frame()
    import pandas as pd

    return pd.DataFrame(long_columns(content))


def long_columns(content: ResultView) -> Columns:
    """Return the columns of a result with a row for each value.

    Loads have the columns of a load table, then `sigma_amplitude`, `sigma_phase_deg`, `method` and `response`.
    """
    if not isinstance(content, HubLoads):
        return {str(name): values for name, values in content.to_frame().to_dict("list").items()}
    rows = [row for run in content.runs.values() for row in load_rows(run)]
    columns: Columns = {name: [row[i] for row in rows] for i, name in enumerate(LOAD_TABLE_COLUMNS)}
    cosine, sine, sigma_cosine, sigma_sine = (
        np.array(columns[name], dtype=float) for name in ("cosine", "sine", "sigma_cosine", "sigma_sine")
    )
    sigma, sigma_phase = polar_sigma(cosine - 1j * sine, sigma_cosine, sigma_sine)
    columns |= {"sigma_amplitude": sigma.tolist(), "sigma_phase_deg": sigma_phase.tolist()}
    return columns | {"method": [content.method] * len(rows), "response": [content.response] * len(rows)}


def wide_columns(content: ResultView) -> Columns:
    """Return the columns of loads with a row for each run and a column for each quantity, as `Fz_4_amplitude`.

    The mean of a component is `Fz_mean`. Sigma of a quantity has the same name with `_sigma`; `flags` are those of all
    rows. Raises UserError for a result that is not loads.
    """
    if not isinstance(content, HubLoads):
        raise UserError("only loads have a table with a row for each run", place="--wide", remedy="Leave --wide out")
    rows: dict[str, dict[str, Any]] = {}
    columns = long_columns(content)
    for values in zip(*columns.values(), strict=True):
        item = dict(zip(columns, values, strict=True))
        run = content.runs[item["run"]]
        start = {"run": run.run, "kind": run.kind, "trim": run.trim, "rotor_hz": run.frequency_hz[1]}
        rows.setdefault(run.run, start).update(_quantities(item))
    for name, row in rows.items():
        row["flags"] = "; ".join(content.runs[name].flag_counts)
    names = dict.fromkeys(name for row in rows.values() for name in row)
    return {name: [row.get(name, math.nan) for row in rows.values()] for name in names}


def _quantities(item: Mapping[str, Any]) -> dict[str, float]:
    """Return the columns of one component and harmonic."""
    start = f"{item['component']}_{item['harmonic']}"
    if item["harmonic"] == 0:
        start = f"{item['component']}_mean"
        return {start: item["cosine"], f"{start}_sigma": item["sigma_cosine"]}
    values = {f"{start}_{value}": item[value] for value in SIGMA_COLUMNS}
    return values | {f"{start}_{value}_sigma": item[sigma] for value, sigma in SIGMA_COLUMNS.items()}


def csv_text(columns: Columns) -> str:
    """Return a table as CSV, each value with the digits that its sigma deserves."""
    if "run" in columns:
        columns = {**columns, "run": [text_cell(str(name)) for name in columns["run"]]}
    shown = dict(columns)
    sigmas = {value: sigma for value, sigma in SIGMA_COLUMNS.items() if value in columns and sigma in columns}
    sigmas |= {name: f"{name}_sigma" for name in columns if f"{name}_sigma" in columns}
    for name, values in columns.items():
        if not all(isinstance(value, float | int) for value in values):
            shown[name] = ["" if value != value else value for value in values]
            continue
        if name in sigmas:
            pairs = zip(values, columns[sigmas[name]], strict=True)
            shown[name] = [round_to_sigma(float(value), float(sigma)) for value, sigma in pairs]
        elif name in sigmas.values():
            shown[name] = [_significant(float(sigma), SIGMA_DIGITS) for sigma in values]
        elif any(isinstance(value, float) for value in values):
            shown[name] = [_significant(float(value), OTHER_DIGITS) for value in values]
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(shown)
    writer.writerows(zip(*shown.values(), strict=True))
    return text.getvalue()


def round_to_sigma(value: float, sigma: float) -> str:
    """Return a value to the decimal of the last significant digit of its sigma; without sigma, to OTHER_DIGITS."""
    if not math.isfinite(value):
        return ""
    if not (math.isfinite(sigma) and sigma > 0.0):
        return _significant(value, OTHER_DIGITS)
    last = math.floor(math.log10(float(f"{sigma:.{SIGMA_DIGITS - 1}e}"))) - SIGMA_DIGITS + 1
    first = math.floor(math.log10(abs(value))) if value else last
    return _significant(value, max(first - last + 1, 1)) if first >= last else "0"


def _significant(value: float, digits: int) -> str:
    return repr(float(f"{value:.{min(digits, 17) - 1}e}")) if math.isfinite(value) else ""
