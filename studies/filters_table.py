"""The table of the study of filters, and its excerpt for the manual."""

from __future__ import annotations

import pandas as pd

MEASURES = ("history", "in_band", "harmonics")


def filters_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return median, least and largest error over the seeds, and mean coverage, by case and method."""
    grouped = rows.groupby(["case", "method"], sort=False)
    table = grouped[list(MEASURES)].agg(["median", "min", "max"])
    table.columns = [f"{name}_{statistic}" for name, statistic in table.columns]
    return table.assign(coverage=grouped["coverage"].mean(), seeds=grouped["seed"].nunique()).reset_index()


def page_table(table: pd.DataFrame) -> str:
    """Return median errors in percent as a Markdown table, one row per method and one column per case."""
    cases = list(dict.fromkeys(table["case"]))
    values = table.set_index(["method", "case"])["in_band_median"] * 100.0
    lines = [f"| method | {' | '.join(cases)} |", f"|---|{'---|' * len(cases)}"]
    for method in dict.fromkeys(table["method"]):
        lines.append(f"| {method} | {' | '.join(_percent(values[method, case]) for case in cases)} |")
    return "\n".join(lines)


def _percent(value: float) -> str:
    """Return the value with two significant figures."""
    return f"{value:.2f}" if value < 1 else f"{value:.1f}" if value < 10 else f"{value:.0f}"
