"""Results as tables: long (a row a value) and wide (a row a run), with as many digits as their sigma deserves."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from balance_cli.io.errors import UserError
from balance_cli.io.formula_cells import text_cell
from balance_cli.io.result_view import ResultView
from balance_cli.reduction.polar import polar_sigma
from balance_cli.reduction.result import HubLoads, load_table

if TYPE_CHECKING:
    import pandas as pd

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
    """Return a result as a table with a row for each value.

    Loads have the columns of a load table, then `sigma_amplitude`, `sigma_phase_deg`, `method` and `response`.
    """
    if not isinstance(content, HubLoads):
        return content.to_frame()
    table = load_table(content)
    value = table["cosine"].to_numpy() - 1j * table["sine"].to_numpy()
    sigma, sigma_phase = polar_sigma(value, table["sigma_cosine"].to_numpy(), table["sigma_sine"].to_numpy())
    table["sigma_amplitude"], table["sigma_phase_deg"] = sigma, sigma_phase
    return table.assign(method=content.method, response=content.response)


def wide_table(content: ResultView) -> pd.DataFrame:
    """Return loads as a table with a row for each run and a column for each quantity, as `Fz_4_amplitude`.

    The mean of a component is `Fz_mean`. Sigma of a quantity has the same name with `_sigma`; `flags` are those of all
    rows. Raises UserError for a result that is not loads.
    """
    if not isinstance(content, HubLoads):
        raise UserError("only loads have a table with a row for each run", place="--wide", remedy="Leave --wide out")
    import pandas as pd

    rows: list[dict[str, Any]] = []
    for name, part in long_table(content).groupby("run", sort=False):
        run = content.runs[str(name)]
        row: dict[str, Any] = {"run": name, "kind": run.kind, "trim": run.trim, "rotor_hz": run.frequency_hz[1]}
        for item in part.itertuples():
            row |= _quantities(item)
        rows.append({**row, "flags": "; ".join(run.flag_counts)})
    return pd.DataFrame(rows)


def _quantities(item: Any) -> dict[str, float]:
    """Return the columns of one component and harmonic."""
    if item.harmonic == 0:
        return {f"{item.component}_mean": item.cosine, f"{item.component}_mean_sigma": item.sigma_cosine}
    names = {value: f"{item.component}_{item.harmonic}_{value}" for value in SIGMA_COLUMNS}
    values = {name: getattr(item, value) for value, name in names.items()}
    return values | {f"{name}_sigma": getattr(item, SIGMA_COLUMNS[value]) for value, name in names.items()}


def csv_text(table: pd.DataFrame) -> str:
    """Return a table as CSV, each value with the digits that its sigma deserves."""
    shown = table.copy()
    if "run" in shown:
        shown["run"] = shown["run"].map(lambda name: text_cell(str(name)))
    sigmas = {value: sigma for value, sigma in SIGMA_COLUMNS.items() if value in table and sigma in table}
    names = [str(name) for name in table.columns]
    sigmas |= {name: f"{name}_sigma" for name in names if f"{name}_sigma" in names}
    for name in map(str, table.select_dtypes("number").columns):
        if name in sigmas:
            pairs = zip(table[name], table[sigmas[name]], strict=True)
            shown[name] = [round_to_sigma(float(value), float(sigma)) for value, sigma in pairs]
        elif name in sigmas.values():
            shown[name] = [_significant(float(sigma), SIGMA_DIGITS) for sigma in table[name]]
        elif table[name].dtype.kind == "f":
            shown[name] = [_significant(float(value), OTHER_DIGITS) for value in table[name]]
    return str(shown.to_csv(index=False, lineterminator="\n"))


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
