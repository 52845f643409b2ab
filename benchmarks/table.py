"""The table of benchmarks in the README, written from the stored results."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path

from benchmarks.comparison import Comparison

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
RESULTS = ROOT / "benchmarks" / "results.json"
BLOCK = re.compile(r"(?<=<!-- benchmarks -->\n).*?(?=<!-- end of benchmarks -->)", re.DOTALL)
HEAD = "| task | here | beside | ratio | what |\n|---|---|---|---|---|\n"
DIGITS = 4
"""Digits of a stored time."""


def store_results(benchmark: str, row: Comparison) -> None:
    """Keep a row of a benchmark in place of an older one of the same task."""
    rows = [item for item in stored_results() if item["task"] != row.task]
    values = asdict(row) | {"benchmark": benchmark}
    values |= {key: float(f"{values[key]:.{DIGITS}g}") for key in ("seconds", "other_seconds")}
    rows.append(values)
    rows.sort(key=lambda item: (item["benchmark"], item["task"]))
    RESULTS.write_text(json.dumps(rows, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def stored_results() -> list[dict[str, str | float]]:
    """Return the rows that were measured last."""
    return json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else []


def table() -> str:
    """Return the table: one row for each task."""
    rows = []
    for item in stored_results():
        row = Comparison(**{key: value for key, value in item.items() if key != "benchmark"})  # type: ignore[arg-type]
        beside = f"{_time(row.other_seconds)}, {row.program}"
        rows.append(
            f"| {row.task} | {_time(row.seconds)} per {row.unit} | {beside} | {_ratio(row.ratio)} | {row.note} |\n"
        )
    return HEAD + "".join(rows)


def write_table() -> None:
    """Write the table between the marks of the README."""
    text = README.read_text(encoding="utf-8")
    README.write_text(BLOCK.sub(lambda _: table(), text), encoding="utf-8")


def _time(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-9:.3g} ns"


def _ratio(ratio: float) -> str:
    """Return how many times as quick the task is here: a number, or one over it where it is slower."""
    return f"{ratio:.3g}" if ratio >= 1.0 else f"1/{1.0 / ratio:.3g}"
