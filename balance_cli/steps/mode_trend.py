"""Eigenfrequencies over a campaign: those of each run beside the model's, and whether they drift."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run, hold_samples
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.reduction.operational_modes import OperationalModes, operational_modes
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.rotor_record import rotor_record
from balance_cli.steps.rank_trend import rank_trend
from balance_cli.steps.trend import SIGNIFICANCE
from balance_cli.steps.trend_points import TrendPoint

Array = NDArray[np.float64]

SAME_RECORDING = 1e-3
"""Relative difference of the mean speed from which a record is not that of the loads of its name."""


@dataclass(frozen=True)
class ModeTrend:
    """Course of an eigenfrequency over the runs, relative to that of the model at the speed of each run.

    `mode` counts from 1; `frequency_hz` is the model's, the mean over the runs; `departure` the weighted mean of
    measured over model minus one, with its sigma; `first` and `last` are the medians over the first and the last third
    of the runs, NaN as the p-values where fewer than eight runs show the mode. The p-values are corrected for the
    number of modes.
    """

    mode: int
    frequency_hz: float
    runs: int
    departure: float
    sigma_departure: float
    first: float
    last: float
    change: float
    tau: float
    bonferroni_p_value: float
    bonferroni_p_value_given: float

    @property
    def is_significant(self) -> bool:
        """Whether there is a drift that the attribute does not explain."""
        return max(self.bonferroni_p_value, self.bonferroni_p_value_given) < SIGNIFICANCE


def run_modes(run: Run, point: TrendPoint, geometry: Geometry, source: ResponseSource) -> OperationalModes:
    """Return the eigenfrequencies of a run near those of the model.

    Raises UserError where the run cannot be reduced, or is not the one whose loads the point has.
    """
    assert source.system is not None
    rotor = point.loads.rotor or 1
    record = rotor_record(hold_samples(run), geometry, source, 1, rotor)
    if abs(record.azimuth.mean_rate / point.speed - 1.0) > SAME_RECORDING:
        fault = f"turns at {record.azimuth.mean_rate:.5g} Hz, the loads of `{run.name}` are at {point.speed:.5g} Hz"
        raise UserError(fault, run.file, "rotor/pulse_times", "Give the record of these loads")
    azimuths = (record.azimuth, *record.other_rotors)
    return operational_modes(record, source.system, geometry.acquisition, azimuths)


def mode_trends(
    points: Sequence[TrendPoint], modes: Mapping[str, OperationalModes], place: Array, attribute: Array
) -> tuple[ModeTrend, ...]:
    """Return the trend of each mode over `place` (n,), with and without what the attribute (n,) explains.

    `modes` are those of the runs by name, of one model; runs without are left out.
    """
    rows = [index for index, point in enumerate(points) if point.run in modes]
    if not rows:
        return ()
    each = [modes[points[index].run] for index in rows]
    predicted, frequency, sigma = (np.array([getattr(item, key) for item in each]) for key in _COLUMNS)
    shown = np.isfinite(frequency)
    count = max(1, int(np.count_nonzero(shown.any(axis=0))))
    return tuple(
        _mode_trend(k, predicted[:, k], frequency[:, k], sigma[:, k], place[rows], attribute[rows], count)
        for k in range(predicted.shape[1])
    )


_COLUMNS = ("predicted", "frequency", "sigma")


def _mode_trend(
    k: int, predicted: Array, frequency: Array, sigma: Array, place: Array, attribute: Array, count: int
) -> ModeTrend:
    departure = frequency / predicted - 1.0
    mean, sigma_mean = _weighted_mean(departure, sigma / predicted)
    trend = rank_trend(departure, place, attribute)
    p_values = (np.nan, np.nan) if trend is None else (trend.p_value, trend.p_value_given)
    corrected = [p if np.isnan(p) else min(1.0, count * p) for p in p_values]
    return ModeTrend(
        mode=k + 1,
        frequency_hz=float(np.mean(predicted)),
        runs=int(np.count_nonzero(np.isfinite(departure))),
        departure=mean,
        sigma_departure=sigma_mean,
        first=np.nan if trend is None else trend.first,
        last=np.nan if trend is None else trend.last,
        change=np.nan if trend is None else trend.change,
        tau=np.nan if trend is None else trend.tau,
        bonferroni_p_value=corrected[0],
        bonferroni_p_value_given=corrected[1],
    )


def _weighted_mean(values: Array, sigma: Array) -> tuple[float, float]:
    """Return the mean of finite values and its sigma, by the stated ones or the scatter, whichever says more."""
    known = np.isfinite(values)
    if not known.any():
        return float("nan"), float("nan")
    x, weight = values[known], 1.0 / sigma[known] ** 2
    mean = float(np.sum(weight * x) / np.sum(weight))
    excess = np.sum(weight * (x - mean) ** 2) / max(len(x) - 1, 1)
    return mean, float(np.sqrt(max(1.0, excess) / np.sum(weight)))
