"""`make bench`: every benchmark in turn, and the table of the README; `python -m benchmarks NAME...` takes some alone.

The measured figures are kept in `benchmarks/results.json`, from which the table is written.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

from benchmarks import batch, charts, filters, maximum_likelihood, regression, responses, score
from benchmarks.comparison import Comparison
from benchmarks.table import store_results, write_table

COMPARED: dict[str, Callable[[], list[Comparison]]] = {
    "batch": batch.compare,
    "filters": filters.compare,
    "maximum_likelihood": maximum_likelihood.compare,
    "regression": regression.compare,
    "responses": responses.compare,
}
"""Benchmarks of the table."""
FURTHER: dict[str, Callable[[], str]] = {
    "score": lambda: f"Score test against refit, sample campaign\n{score.run()}",
    "stages": lambda: f"Stages of a reduction by harmonics\n{batch.run()}",
    "charts": lambda: f"Charts of 10^6 points in a browser, beside plotly\n{charts.run()}",
    "time": lambda: f"Loads in time: filters, smoothers, and the whole reduction\n{filters.run()}",
}
"""Benchmarks that are printed alone."""


def main(names: list[str]) -> None:
    """Run the named benchmarks, by default all."""
    unknown = [name for name in names if name not in COMPARED and name not in FURTHER]
    if unknown:
        raise SystemExit(f"no benchmark {unknown[0]}: choose among {', '.join((*COMPARED, *FURTHER))}")
    for name, compare in COMPARED.items():
        if name in names or not names:
            for row in compare():
                store_results(name, row)
                sys.stdout.write(f"{row.task}: ratio {row.ratio:.3g} to {row.program}; {row.note}\n")
    write_table()
    for name, text in FURTHER.items():
        if name in names or not names:
            sys.stdout.write(f"{text()}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
