"""Harmonic 0: mean hub loads from strain and torque channels through the static calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from balance_cli.calibrated import Calibration, TrimCalibration
from balance_cli.channel_health import ChannelHealth
from balance_cli.errors import UserError
from balance_cli.estimation.hub_loads import SURPLUS_PROBABILITY
from balance_cli.runs import Run, read_channels
from balance_cli.signals.harmonics import Harmonics

Array = NDArray[np.float64]

# Stretches into which a zero record is cut; the scatter of their means is the error of the whole mean.
STRETCHES = 16
NO_ZERO = "no zero"
REDUNDANCY = "redundancy"


@dataclass(frozen=True)
class ZeroRecord:
    """Reading of the unloaded rig: means (c,) [V] of the named channels and their variance."""

    run: str
    channel_names: tuple[str, ...]
    mean: Array
    variance: Array


def zero_record(run: Run, channel_names: Sequence[str]) -> ZeroRecord:
    """Means of a wind-off record, with the error that the scatter of its stretches shows."""
    names = tuple(name for name in channel_names if name in run.channel_names)
    values = read_channels(run, names)
    means = np.array([part.mean(axis=0) for part in np.array_split(values, STRETCHES)])
    return ZeroRecord(run.name, names, values.mean(axis=0), means.var(axis=0, ddof=1) / STRETCHES)


@dataclass(frozen=True)
class SteadyLoads:
    """Mean loads (m,) of the named components with sigma (m,), the trim that was used, and the surplus chi-square."""

    components: tuple[str, ...]
    loads: Array
    sigma: Array
    trim: str
    flag: str
    redundancy: float
    redundancy_limit: float
    condition: float


@dataclass(frozen=True)
class _Reading:
    """Mean readings (c,) of the live channels of a trim, counted from the unloaded rig, with covariance (c, c)."""

    rows: list[int]
    change: Array
    covariance: Array


def steady_loads(
    spectra: Harmonics, calibration: Calibration, health: ChannelHealth, zero: ZeroRecord | None
) -> SteadyLoads:
    """Loads through T0 of the trim nearest in mean load, found by going through the trims once.

    Where channels were left out, the weighted inverse of what remains of C0 takes the place of T0. Raises UserError
    where that does not determine the loads.
    """
    first = next(iter(calibration.trims.values()))
    guess = _through(first, spectra, health, zero)
    trim = calibration.nearest(_named(guess))
    return guess if trim is first else _through(trim, spectra, health, zero)


def _named(loads: SteadyLoads) -> Mapping[str, float]:
    return dict(zip(loads.components, loads.loads.tolist(), strict=True))


def _through(trim: TrimCalibration, spectra: Harmonics, health: ChannelHealth, zero: ZeroRecord | None) -> SteadyLoads:
    reading = _reading(trim, spectra, health, zero)
    C0 = trim.C0[reading.rows]
    _check_determined(C0, trim, health, spectra.run)
    W = np.linalg.inv(trim.noise_covariance[np.ix_(reading.rows, reading.rows)])
    whole = len(reading.rows) == len(trim.channel_names)
    T0 = trim.T0 if whole else np.linalg.inv(C0.T @ W @ C0) @ C0.T @ W
    change = T0 @ reading.change
    covariance = reading.covariance + _matrix_error(trim, reading.rows, change)
    redundancy, limit = _surplus(reading.change - C0 @ change, C0, covariance)
    variance = np.diag(T0 @ covariance @ T0.T) * (redundancy if redundancy > limit else 1.0)
    flags = ([NO_ZERO] if zero is None else []) + ([REDUNDANCY] if redundancy > limit else [])
    return SteadyLoads(
        components=trim.components,
        loads=trim.mean_load + change,
        sigma=np.sqrt(variance),
        trim=trim.trim,
        flag="; ".join(flags),
        redundancy=redundancy,
        redundancy_limit=limit,
        condition=trim.condition,
    )


def _matrix_error(trim: TrimCalibration, rows: list[int], change: Array) -> Array:
    """Covariance (c, c) of C0 f for the load change (m,), and of what the straight line leaves beyond noise."""
    spread = np.einsum("ijkl,j,l->ik", trim.C0_covariance, change, change)
    # Noise averages out over a record; curvature and hysteresis do not.
    lasting = max(0.0, 1.0 - 1.0 / trim.lack_of_fit)
    return np.asarray((spread + lasting * trim.residual_covariance)[np.ix_(rows, rows)])


def _reading(trim: TrimCalibration, spectra: Harmonics, health: ChannelHealth, zero: ZeroRecord | None) -> _Reading:
    """What the channels read more than in the middle of the calibration, zero shift taken off."""
    usable = set(health.live) & set(trim.channel_names)
    if zero is not None:
        usable &= set(zero.channel_names)
    rows = [i for i, name in enumerate(trim.channel_names) if name in usable]
    names = [trim.channel_names[i] for i in rows]
    mine = spectra.columns(names)
    change = spectra.amplitude[0, mine].real - trim.mean_channels[rows]
    covariance = np.real(spectra.covariance[0][np.ix_(mine, mine)])
    if zero is not None:
        at = [zero.channel_names.index(name) for name in names]
        change = change - (zero.mean[at] - trim.offsets.mean(axis=0)[rows])
        covariance = covariance + np.diag(zero.variance[at])
    return _Reading(rows, change, covariance)


def _check_determined(C0: Array, trim: TrimCalibration, health: ChannelHealth, run: str) -> None:
    scaled = C0 * trim.full_range
    if len(C0) >= C0.shape[1] and np.linalg.cond(scaled) < 1e8:
        return
    names = "; ".join(f"{name}: {reason}" for name, reason in health.left_out.items()) or "none"
    raise UserError(
        f"the remaining strain and torque channels do not determine the mean loads (left out: {names})",
        run,
        "channels",
        "Mend the channels, or leave the run out with --skip-bad",
    )


def _surplus(residual: Array, C0: Array, covariance: Array) -> tuple[float, float]:
    """Chi-square per degree of freedom of the surplus channels, and its 99.9 % point."""
    degrees = len(C0) - C0.shape[1]
    if degrees <= 0:
        return float("nan"), float("inf")
    weight = np.linalg.inv(covariance)
    inverse = np.linalg.inv(C0.T @ weight @ C0)
    projected = residual - C0 @ (inverse @ C0.T @ weight @ residual)
    chi2 = float(projected @ weight @ projected)
    return chi2 / degrees, float(stats.chi2.ppf(SURPLUS_PROBABILITY, degrees)) / degrees
