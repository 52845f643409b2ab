"""A task done here and by another program, side by side in one process: a row of the table of the README."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version


@dataclass(frozen=True)
class Comparison:
    """Processor time [s] of a task here and elsewhere, for one of `unit`; `note` says what each includes."""

    task: str
    unit: str
    seconds: float
    program: str
    other_seconds: float
    note: str

    @property
    def ratio(self) -> float:
        """How many times as long the other program takes."""
        return self.other_seconds / self.seconds


def program_with_version(package: str, what: str) -> str:
    """Return the name of an installed package with its version, and what of it is called."""
    try:
        return f"{package} {version(package)}{what and f', {what}'}"
    except PackageNotFoundError:
        raise SystemExit(f"{package} is not installed: pip install '.[bench]'") from None


def alternate(first: Callable[[], object], second: Callable[[], object], times: int) -> tuple[float, float]:
    """Return the shortest processor time [s] of each call of two that take turns, after one call of each."""
    best = [float("inf")] * 2
    for round_number in range(times + 1):
        for index, call in enumerate((first, second)):
            begin = time.process_time()
            call()
            if round_number:
                best[index] = min(best[index], time.process_time() - begin)
    return best[0], best[1]
