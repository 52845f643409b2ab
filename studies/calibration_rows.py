"""Study of the prediction intervals of the static calibration, from 10 to 1000 rows and from 1 to 30 load series.

Each series has its own zero, told by one tare point, by two or by none; poses of all loads have one zero. Readings are
curved: linear, with squares and products, or with cubes. Only noise acts. New loads of the kind that was applied are
computed by the calibration model, by the non-iterative method and by `apply`; where there are several series, one is
left out of the calibration and computed, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.all_trims_result import AllTrimsCalibration, CheckLoads
from balance_cli.calibration.check_loads import HeldOutRun
from balance_cli.calibration.least_squares import CollinearError
from studies.calibration_schedules import (
    CURVATURE,
    FULL_RANGE,
    Balance,
    Recorded,
    Schedule,
    calibration_points,
    check_record,
    draw_balance,
    one_at_a_time,
    random_poses,
    record,
    with_pairs,
)

Array = NDArray[np.float64]

HANGING_LOAD = 0.6
"""Share of the range of the load that hangs beside the one that is varied."""
CUBE = 2e-3
"""Share of the range of a cubic term of a channel: that of a strut that stiffens."""
SHAPES = ("linear", "quadratic", "cubic")


@dataclass(frozen=True)
class CurvedBalance:
    """A balance with cubes (k, c) of the loads beside its linear and quadratic coefficients."""

    base: Balance
    cubic: Array
    linear: Array

    def readings(self, x: Array) -> Array:
        """Readings (m, c) without zero and noise."""
        return np.asarray(self.base.readings(x) + x**3 @ self.cubic)


def hanging(components: int, series: int, rows: int, tare: str) -> Schedule:
    """Series of so many rows: loads in turn, both directions, then beside another load that hangs."""
    parts = []
    for number in range(series):
        at, side = number % components, 1.0 if (number // components) % 2 == 0 else -1.0
        steps = rows - (tare != "none")
        x = np.outer(side * np.arange(1, steps + 1) / steps, np.eye(components)[at])
        if beside := number // (2 * components):
            x = x + HANGING_LOAD * np.eye(components)[(at + beside) % components]
        unloaded = np.zeros((1, components))
        parts.append(np.vstack({"first": [unloaded, x], "last": [x, unloaded], "none": [x]}[tare]))
    kind = "pairs" if series > 2 * components else "single"
    return Schedule(np.vstack(parts), np.repeat(np.arange(series), rows), components, tare != "none", kind)


SCHEDULES: dict[str, Callable[[np.random.Generator], Schedule]] = {
    "10 poses, 3 axes": lambda rng: random_poses(rng, 10, 3, 3),
    "20 poses, 3 axes, 5 channels": lambda rng: random_poses(rng, 20, 3, 5),
    "30 poses": lambda rng: random_poses(rng, 30, 6, 6),
    "60 poses, 8 channels": lambda rng: random_poses(rng, 60, 6, 8),
    "250 poses": lambda rng: random_poses(rng, 250, 6, 6),
    "1000 poses, 8 channels": lambda rng: random_poses(rng, 1000, 6, 8),
    "15 rows, 3 series, 3 axes, tare first": lambda _: hanging(3, 3, 5, "first"),
    "60 rows, 12 series, tare first": lambda _: hanging(6, 12, 5, "first"),
    "60 rows, 12 series, tare last": lambda _: hanging(6, 12, 5, "last"),
    "150 rows, 30 series, tare first": lambda _: hanging(6, 30, 5, "first"),
    "150 rows, 30 series, no tare": lambda _: hanging(6, 30, 5, "none"),
    "66 rows, 6 series, both tares": lambda _: one_at_a_time(6, 5, "both"),
    "54 rows, 6 series, no tare": lambda _: one_at_a_time(6, 5, "none"),
    "120 rows, 12 series, tare first": lambda _: one_at_a_time(6, 5, "first", (1, -1)),
    "270 rows, 18 series, tare first": lambda _: with_pairs(one_at_a_time(6, 10, "first", (1, -1))),
    "990 rows, 30 series, tare first": lambda _: hanging(6, 30, 33, "first"),
}


def rows_chunk(seed: int) -> pd.DataFrame:
    """All schedules and shapes of the readings once."""
    cases = []
    for number, (name, make) in enumerate(SCHEDULES.items()):
        for shape in SHAPES:
            rng = np.random.default_rng([seed, number, SHAPES.index(shape), 1993])
            cases.append({"seed": seed, "schedule": name, "shape": shape, **_run_case(make(rng), shape, rng)})
    return pd.DataFrame(cases)


def _run_case(schedule: Schedule, shape: str, rng: np.random.Generator) -> dict[str, float]:
    k = schedule.x.shape[1]
    base = draw_balance(rng, k, schedule.channels, 0.0 if shape == "linear" else CURVATURE)
    cubic = (CUBE if shape == "cubic" else 0.0) * rng.standard_normal((k, schedule.channels))
    # One of three loads: more cubes than a balance has would be a model that no schedule tells.
    balance = CurvedBalance(base, cubic * (rng.random(cubic.shape) < 1.0 / 3.0), base.linear)
    recorded = record(balance, schedule, "none", rng, systematic=0.0)
    x, channels = check_record(balance, schedule, recorded, rng)
    if not schedule.has_tares and schedule.series[-1] == 0:
        channels = channels + np.median(recorded.channels - balance.readings(schedule.x), axis=0)
    whole = _calibrate(recorded, HeldOutRun("check", channels, x * FULL_RANGE[:k]))
    if whole is None:
        return {"refused": 1.0}
    by_model, direct = whole.checks
    return {
        "refused": 0.0,
        "model": _coverage(by_model),
        "non_iterative": _coverage(direct),
        "left_out": _left_out_coverage(schedule, recorded, int(rng.integers(schedule.series[-1] + 1))),
    }


def _calibrate(recorded: Recorded, check: HeldOutRun) -> AllTrimsCalibration | None:
    try:
        return calibrate_all_trims(calibration_points(recorded), [check], non_iterative=True)
    except CollinearError:
        return None


def _coverage(check: CheckLoads) -> float:
    """Share of the check loads in their intervals, those of the first row, which told the zero, left out."""
    good = check.is_valid & (np.arange(len(check.applied)) > 0)
    inside = np.abs(check.computed - check.applied) <= check.prediction_interval
    return float(np.mean(inside[good])) if good.any() else float("nan")


def _left_out_coverage(schedule: Schedule, recorded: Recorded, number: int) -> float:
    """The same of one load series that is left out; NaN for a single one, or where the others do not tell its loads."""
    rows = schedule.series == number
    if schedule.series[-1] == 0:
        return float("nan")
    rest = replace(recorded, x=recorded.x[~rows], channels=recorded.channels[~rows])
    if np.any(np.max(np.abs(rest.x), axis=0) == 0.0):
        return float("nan")
    loads = recorded.x[rows] * FULL_RANGE[: recorded.x.shape[1]]
    order = np.argsort(np.any(schedule.x[rows] != 0.0, axis=1), kind="stable")
    whole = _calibrate(rest, HeldOutRun("left out", recorded.channels[rows][order], loads[order]))
    return float("nan") if whole is None else _coverage(whole.checks[0])


def rows_table(cases: pd.DataFrame) -> pd.DataFrame:
    """Coverage of the 95 % intervals by schedule and shape of the readings."""
    return (
        cases.groupby(["schedule", "shape"], sort=False)
        .agg(
            calibrations=("seed", "size"),
            refused=("refused", "mean"),
            model=("model", "mean"),
            non_iterative=("non_iterative", "mean"),
            left_out=("left_out", "mean"),
        )
        .reset_index()
    )
