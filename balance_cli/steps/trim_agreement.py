"""Whether the trims of a calibration were recorded through the same amplifiers: C0 of one trim against that of another.

A nonlinear rig has another C0 in each trim, but not by one factor in most of its channels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration, TrimCalibration
from balance_cli.diagnosis.consistency.findings import STATIC_RESPONSE, WARNING, ConsistencyFinding
from balance_cli.diagnosis.consistency.units import FORCE_UNITS, suggest_units

Array = NDArray[np.float64]

LEAST_CHANGE = 0.01
"""Departure of the common factor from one that is named: supplies and amplifiers of one day hold a tenth of it."""
LARGEST_SIGMAS = 5.0
"""One in two million by chance; a balance has few pairs of trims."""
SAME_FACTOR = 0.005
"""Departure of the factor of a channel from the common one, relative to it, by which it still is that factor."""
FEWEST_CHANNELS = 3
"""Channels with one factor; two may share it by accident."""
MOST_SHARE = 0.6
"""Of the channels that must have the factor: a torque meter has an amplifier of its own."""


def trim_findings(calibration: Calibration | None) -> tuple[ConsistencyFinding, ...]:
    """Return a warning for each trim whose channels mostly read one factor times what they read in the first trim.

    The same loads are compared. Nothing without a calibration, with one trim, or without standard errors.
    """
    if calibration is None or len(calibration.trims) < 2 or not calibration.errors_known:
        return ()
    first, *others = calibration.trims.values()
    findings = []
    for other in others:
        common = _common_factor(first, other)
        if common is None:
            continue
        factor, channels = common
        hint = suggest_units(1.0 / factor, FORCE_UNITS)
        channel_text = "all channels" if set(channels) >= set(other.channel_names) else ", ".join(channels)
        text = (
            f"{channel_text} of trim `{other.trim}` read {factor:.4g} times what they read in trim `{first.trim}` "
            "for the same loads (another amplifier or supply, or loads in another unit?"
            f"{f' {hint}' if hint else ''})"
        )
        findings.append(
            ConsistencyFinding(
                kind=STATIC_RESPONSE,
                severity=WARNING,
                text=text,
                runs=(*first.runs, *other.runs),
                channels=channels,
                factor=factor,
                trims=(first.trim, other.trim),
            )
        )
    return tuple(findings)


def _common_factor(first: TrimCalibration, other: TrimCalibration) -> tuple[float, tuple[str, ...]] | None:
    """Return C0 of one trim over that of another, and the channels, where most have one factor that is not one."""
    channels = [name for name in first.channel_names if name in other.channel_names]
    components = [name for name in first.components if name in other.components]
    before, after = _readings(first, channels, components), _readings(other, channels, components)
    variance = before[1] ** 2 + after[1] ** 2
    if not channels or not np.all(np.isfinite(variance)) or np.any(variance <= 0.0):
        return None
    power = (before[0] ** 2 / variance).sum(axis=1)
    factors = (before[0] * after[0] / variance).sum(axis=1) / np.where(power > 0.0, power, np.inf)
    limits = LARGEST_SIGMAS / np.sqrt(np.where(power > 0.0, power, np.finfo(float).tiny))
    common = float(np.median(factors))
    is_alike = np.abs(factors - common) < np.maximum(SAME_FACTOR * abs(common), limits)
    is_common = is_alike & (np.abs(factors - 1.0) > limits)
    if abs(common - 1.0) < LEAST_CHANGE or is_common.sum() < max(FEWEST_CHANNELS, MOST_SHARE * len(channels)):
        return None
    return common, tuple(name for name, same in zip(channels, is_common, strict=True) if same)


def _readings(trim: TrimCalibration, channels: list[str], components: list[str]) -> tuple[Array, Array]:
    """Return C0 and its standard errors (c, k) [V] for the largest loads that were applied."""
    rows = [trim.channel_names.index(name) for name in channels]
    columns = [trim.components.index(name) for name in components]
    place = np.ix_(rows, columns)
    return trim.C0[place] * trim.calibrated_range[columns], trim.C0_sigma[place] * trim.calibrated_range[columns]
