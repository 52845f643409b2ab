"""Study of the static calibration with the schedules and the mistakes of laboratories.

Load series that open or close with their tare point, short series, single poses, few rows; zeros that shift,
hysteresis, weights that are not aligned, noise of readings and loads. In part of the calibrations two loads are
exchanged, one reading is wrong, or a sign is. The model is compared with plain least squares, linear and quadratic,
whose zeros are the tare points, by the errors of loads that neither has seen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.all_trims_result import AllTrimsCalibration
from balance_cli.calibration.check_loads import HeldOutRun
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.least_squares import CollinearError

Array = NDArray[np.float64]
Index = NDArray[np.intp]

COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
FULL_RANGE = np.array([800.0, 800.0, 3500.0, 400.0, 400.0, 450.0])
# Shares of the range.
READING_NOISE, LOAD_NOISE, ZERO_SHIFT, HYSTERESIS, MISALIGNMENT, CURVATURE = 3e-4, 1e-4, 5e-3, 2e-4, 5e-4, 1e-3
CONDITION = 10.0
CHECKS = 60
FAULTS = ("none", "exchanged", "digit", "sign")


@dataclass(frozen=True)
class Schedule:
    """Loads (m, k) over their range, load series (m,), and number of channels; `has_tares`: series have tare points."""

    x: Array
    series: Index
    channels: int
    has_tares: bool = True
    kind: str = "single"


def one_at_a_time(components: int, steps: int, tare: str, sides: tuple[int, ...] = (1,), channels: int = 0) -> Schedule:
    """Each component in turn, up and down, in one series for each side; tare `first`, `last`, `both` or `none`."""
    up = np.arange(1, steps + 1) / steps
    ramp = np.r_[up, up[-2::-1]]
    parts = []
    for j in range(components):
        for side in sides:
            values = np.r_[[0.0] * (tare in ("first", "both")), side * ramp, [0.0] * (tare in ("last", "both"))]
            parts.append(np.outer(values, np.eye(components)[j]))
    numbers = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    return Schedule(np.vstack(parts), numbers, channels or components, tare != "none")


def with_pairs(schedule: Schedule, tare: str = "first") -> Schedule:
    """Further series: each component beside another that hangs."""
    k = schedule.x.shape[1]
    values = np.array([0.25, 0.5, 0.75, 1.0])
    parts, numbers = [schedule.x], [schedule.series]
    for number, (i, j) in enumerate((i, (i + 1) % k) for i in range(k)):
        rows = np.outer(values, np.eye(k)[i]) + 0.6 * np.eye(k)[j]
        parts.append(np.vstack([np.zeros((1, k)), rows] if tare == "first" else [rows, np.zeros((1, k))]))
        numbers.append(np.full(len(parts[-1]), schedule.series[-1] + 1 + number))
    return Schedule(np.vstack(parts), np.concatenate(numbers), schedule.channels, kind="pairs")


def random_poses(rng: np.random.Generator, poses: int, components: int, channels: int) -> Schedule:
    """All loads at once, in no order, without tare points: one series."""
    return Schedule(rng.uniform(-1.0, 1.0, (poses, components)), np.zeros(poses, np.intp), channels, False)


SCHEDULES: dict[str, Callable[[np.random.Generator], Schedule]] = {
    "60 rows, tare first": lambda rng: one_at_a_time(6, 5, "first"),
    "60 rows, tare last": lambda rng: one_at_a_time(6, 5, "last"),
    "66 rows, both tares": lambda rng: one_at_a_time(6, 5, "both"),
    "54 rows, no tare": lambda rng: one_at_a_time(6, 5, "none"),
    "three axes, 15 rows": lambda rng: one_at_a_time(3, 2, "both"),
    "three axes, 24 rows": lambda rng: one_at_a_time(3, 2, "first", (1, -1)),
    "60 poses, 8 channels": lambda rng: random_poses(rng, 60, 6, 8),
    "150 rows with pairs": lambda rng: with_pairs(one_at_a_time(6, 5, "first", (1, -1))),
    "external, 96 rows": lambda rng: with_pairs(one_at_a_time(6, 6, "first"), "first"),
}


@dataclass(frozen=True)
class Balance:
    """Linear coefficients (k, c) of unit range, quadratic ones (pairs, c), and pairs (pairs, 2) of components."""

    linear: Array
    quadratic: Array
    pairs: Index

    def readings(self, x: Array) -> Array:
        """Readings (m, c) without zero and noise."""
        return np.asarray(x @ self.linear + (x[:, self.pairs[:, 0]] * x[:, self.pairs[:, 1]]) @ self.quadratic)


def draw_balance(rng: np.random.Generator, components: int, channels: int, curvature: float) -> Balance:
    """A balance by chance, with some of the products of loads in each channel."""
    linear = rng.standard_normal((components, channels))
    while np.linalg.cond(linear) > CONDITION:
        linear = rng.standard_normal((components, channels))
    pairs = np.array([(i, j) for i in range(components) for j in range(i, components)])
    present = rng.random((len(pairs), channels)) < 0.3
    return Balance(linear, curvature * present * rng.standard_normal((len(pairs), channels)), pairs)


@dataclass(frozen=True)
class Recorded:
    """What the file holds: loads x (m, k) over their range, readings (m, c); `spoiled` rows and the fault."""

    x: Array
    channels: Array
    spoiled: tuple[int, ...]
    fault: str


def record(
    balance: Balance, schedule: Schedule, fault: str, rng: np.random.Generator, systematic: float = 1.0
) -> Recorded:
    """Record the schedule, with a mistake; `systematic` scales hysteresis and misaligned weights."""
    x, series = schedule.x, schedule.series
    m, k = x.shape
    tilt = np.eye(k) + systematic * MISALIGNMENT * rng.standard_normal((series[-1] + 1, k, k))
    applied = np.einsum("mk,mkl->ml", x, tilt[series])
    direction = np.sign(np.diff(x, axis=0, prepend=x[:1]))
    zeros = ZERO_SHIFT * rng.standard_normal((series[-1] + 1, balance.linear.shape[1]))
    noise = READING_NOISE * rng.standard_normal((m, balance.linear.shape[1]))
    channels = balance.readings(applied) + systematic * HYSTERESIS * direction @ balance.linear + zeros[series] + noise
    loads = x + np.where(x != 0, LOAD_NOISE, 0.0) * rng.standard_normal(x.shape)
    spoiled: tuple[int, ...] = ()
    loaded = np.flatnonzero(np.any(np.abs(x) > 0.15, axis=1))
    if fault == "exchanged":
        i, j = rng.choice(loaded, 2, replace=False)
        while np.max(np.abs(x[i] - x[j])) < 0.2:
            i, j = rng.choice(loaded, 2, replace=False)
        loads[[i, j]] = loads[[j, i]]
        spoiled = tuple(sorted((int(i), int(j))))
    elif fault == "digit":
        row = int(rng.choice(loaded))
        channels[row, int(rng.integers(channels.shape[1]))] += rng.choice([-1.0, 1.0]) * rng.uniform(0.02, 0.1)
        spoiled = (row,)
    elif fault == "sign":
        row = int(rng.choice(loaded))
        loads[row] *= -1.0
        spoiled = (row,)
    return Recorded(loads, channels, spoiled, fault)


def calibration_points(recorded: Recorded) -> CalibrationPoints:
    """The points of one run."""
    m, k = recorded.x.shape
    used = np.max(np.abs(recorded.x), axis=0)
    return CalibrationPoints(
        channel_names=tuple(f"g{c + 1}" for c in range(recorded.channels.shape[1])),
        components=COMPONENTS[:k],
        run_names=("stand",),
        channels=recorded.channels,
        loads=recorded.x * FULL_RANGE[:k],
        run=np.zeros(m, np.intp),
        weight=np.ones(m),
        calibrated_range=used * FULL_RANGE[:k],
    )


def plain_errors(schedule: Schedule, recorded: Recorded, check: tuple[Array, Array], quadratic: bool) -> Array:
    """Rms errors (k,) of check loads by plain least squares, loads as functions of the readings less the tare points.

    Without tare points there is one constant. The mistakes are left out by hand.
    """
    good = np.setdiff1d(np.arange(len(recorded.x)), recorded.spoiled)
    readings = recorded.channels
    if schedule.has_tares:
        unloaded = np.all(schedule.x == 0, axis=1)
        tares = [
            recorded.channels[(schedule.series == number) & unloaded].mean(axis=0)
            for number in np.unique(schedule.series)
        ]
        readings = readings - np.array(tares)[schedule.series]
    X = _plain_columns(readings[good], quadratic, not schedule.has_tares)
    coefficients = np.linalg.lstsq(X, recorded.x[good], rcond=None)[0]
    x, channels = check
    change = channels[1:] - (channels[0] if schedule.has_tares else 0.0)
    computed = _plain_columns(change, quadratic, not schedule.has_tares) @ coefficients
    return np.asarray(np.sqrt(np.mean((computed - x[1:]) ** 2, axis=0)))


def _plain_columns(readings: Array, quadratic: bool, constant: bool) -> Array:
    columns = [readings]
    if quadratic:
        c = readings.shape[1]
        columns.append(np.stack([readings[:, i] * readings[:, j] for i in range(c) for j in range(i, c)], axis=1))
    if constant:
        columns.append(np.ones((len(readings), 1)))
    return np.hstack(columns)


def check_record(
    balance: Balance, schedule: Schedule, recorded: Recorded, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Check loads like those of the schedule in kind and size, and their readings; the first row is the tare point."""
    k = schedule.x.shape[1]
    largest = np.max(np.abs(schedule.x), axis=0)
    lowest = np.where(np.min(schedule.x, axis=0) < 0, -1.0, 0.0)
    # Only loads that were applied together: a schedule does not tell the products of others.
    together = int(np.median(np.count_nonzero(schedule.x[np.any(schedule.x != 0, axis=1)], axis=1)))
    x = rng.uniform(lowest * largest, largest, (CHECKS, k))
    if together < k:
        first = rng.integers(k, size=CHECKS)
        x = x * (np.eye(k)[first] + (np.eye(k)[(first + 1) % k] if "pairs" in schedule.kind else 0.0))
    x = np.vstack([np.zeros(k), x])
    c = recorded.channels.shape[1]
    shift = ZERO_SHIFT * rng.standard_normal(c) if schedule.has_tares else np.zeros(c)
    channels = balance.readings(x) + shift + READING_NOISE * rng.standard_normal((len(x), c))
    return x, channels


def schedules_chunk(seed: int) -> pd.DataFrame:
    """All schedules and faults once."""
    rows = []
    for number, (name, make) in enumerate(SCHEDULES.items()):
        for systematic in (0.0, 1.0):
            for fault in FAULTS:
                rng = np.random.default_rng([seed, number, FAULTS.index(fault), 91])
                result = _run_case(make(rng), fault, systematic, rng)
                rows.append({"seed": seed, "schedule": name, "systematic": systematic, "fault": fault, **result})
    return pd.DataFrame(rows)


def _run_case(schedule: Schedule, fault: str, systematic: float, rng: np.random.Generator) -> dict[str, float | str]:
    """One calibration by chance, with its check loads."""
    balance = draw_balance(rng, schedule.x.shape[1], schedule.channels, CURVATURE)
    recorded = record(balance, schedule, fault, rng, systematic)
    x, channels = check_record(balance, schedule, recorded, rng)
    if not schedule.has_tares and schedule.series[-1] == 0:
        # Poses without tare points: the zero of the calibration is that of the check loads.
        channels = channels + np.median(recorded.channels - balance.readings(schedule.x), axis=0)
    return _judge(schedule, recorded, (x, channels))


def _judge(schedule: Schedule, recorded: Recorded, check: tuple[Array, Array]) -> dict[str, float | str]:
    points = calibration_points(recorded)
    k = recorded.x.shape[1]
    x, channels = check
    try:
        whole = calibrate_all_trims(points, [HeldOutRun("check", channels, x * FULL_RANGE[:k])])
    except CollinearError:
        return {"refused": 1.0}
    held = whole.checks[0]
    good = held.is_valid & (np.arange(len(x)) > 0)
    errors = (held.computed - held.applied) / FULL_RANGE[:k]
    inside = np.abs(held.computed - held.applied) <= held.prediction_interval
    own = float(np.sqrt(np.mean(errors[good] ** 2)))
    each = (plain_errors(schedule, recorded, check, quadratic) for quadratic in (False, True))
    plain = [float(np.sqrt(np.mean(errors_of_model**2))) for errors_of_model in each]
    named = {outlier.row - 1 for outlier in whole.outliers}
    return {
        "refused": 0.0,
        "found": float(set(recorded.spoiled) <= named),
        "named": float(_is_named(whole, recorded)),
        "spurious_rows": float(len(named - set(recorded.spoiled))),
        "suspect_series": float(len(whole.suspect_series)),
        "terms": float(len(whole.model.terms) - k),
        "coverage": float(np.mean(inside[good])),
        "solved": float(np.mean(good[1:])),
        "error": own,
        "ratio": own / min(plain),
        "series_right": float(_same_partition(whole, schedule)),
    }


def _is_named(whole: AllTrimsCalibration, recorded: Recorded) -> bool:
    """Whether the mistake is named for what it is."""
    by_row = {outlier.row - 1: outlier for outlier in whole.outliers}
    if recorded.fault == "exchanged":
        i, j = recorded.spoiled
        return i in by_row and by_row[i].exchanged_with == j + 1
    return all(row in by_row and (recorded.fault != "sign" or by_row[row].cause) for row in recorded.spoiled)


def _same_partition(whole: AllTrimsCalibration, schedule: Schedule) -> bool:
    found = whole.load_series
    return found is not None and len(np.unique(found)) == len(
        {*zip(found.tolist(), schedule.series.tolist(), strict=True)}
    )


def schedules_table(cases: pd.DataFrame) -> pd.DataFrame:
    """Mean of each quantity by schedule and fault; coverage of calibrations whose only errors are noise."""
    keys = ["schedule", "fault"]
    noise_only = cases[cases["systematic"] == 0].groupby(keys, sort=False)["coverage"].mean().rename("coverage")
    table = cases.groupby(keys, sort=False).agg(
        cases=("seed", "size"),
        found=("found", "mean"),
        named=("named", "mean"),
        rows_excluded_wrongly=("spurious_rows", "mean"),
        series_right=("series_right", "mean"),
        median_ratio=("ratio", "median"),
    )
    return table.join(noise_only).reset_index()
