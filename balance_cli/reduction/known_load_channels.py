"""What is wrong with the channels of a check run, by its known loads: a sign, a factor, two that are exchanged.

Reduced loads that differ from the known ones tell only that something is wrong. Where one channel or two, or all those
of one sensor or two, explain it, and all others read what the response makes of the known loads, the response is right.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.reduction.check_errors import FEWEST_HARMONICS, HARMONICS_COMPARED, SAME_PATTERN
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.reduction.suspect_channels import places_by_sensor
from balance_cli.signals.anti_alias import anti_alias_response

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

CHANNEL_MISFIT = 0.2
"""Of the rms of an average channel: what a channel may differ from its prediction that is as the response has it. Light
modes, a support or a hose change some harmonics by more, but not all channels but one by less."""
SMALLEST_FACTOR, LARGEST_FACTOR = 0.7, 1.4
"""Factors of a channel that are left to tolerances: an amplifier that is set to another step is out by 2."""
SIGN_TOLERANCE = 0.2
"""Departure of a factor from -1 that is still taken for a reversed sign."""
FEWEST_CHANNELS = 3
"""Channels that must read what is predicted, so that these are the rule and the others the exception."""


def describe_wrong_channels(
    record: RotorRecord, geometry: Geometry, source: ResponseSource, response: ComplexArray, applied: ComplexArray
) -> str | None:
    """Return in words what one or two channels, or sensors, have that all others have not; None where nothing does.

    `response` (n, rows, 6) at harmonics 1 to n, `applied` (n+1, m) the known loads without the anti-alias filter.
    """
    names = record.health.live
    frequency = record.spectra.frequency_hz[1:]
    combination = source.channel_combination(frequency, names)
    if not combination.rows_are_channels or len(applied) <= FEWEST_HARMONICS:
        return None
    last = min(HARMONICS_COMPARED, len(frequency))
    columns = [COMPONENTS.index(name) for name in record.components]
    T = response[:last, combination.rows][:, :, columns]
    predicted = np.einsum("hcm,hm->hc", T, applied[1 : last + 1])
    H = anti_alias_response(geometry.acquisition, frequency[:last])
    measured = record.spectra.amplitude[1 : last + 1, record.spectra.columns(names)] / H[:, None]
    # What the loads make at most: symmetry may keep it from a channel, but volts are then no measure of its errors.
    size = np.sqrt(np.mean(np.sum(np.abs(T) * np.abs(applied[1 : last + 1, None]), axis=2) ** 2, axis=0))
    if not np.all(size > 0):
        return None
    return next(_explanations(measured / size, predicted / size, size, names, places_by_sensor(names, geometry)), None)


def _explanations(
    measured: ComplexArray, predicted: ComplexArray, size: Array, names: tuple[str, ...], sensors: dict[str, list[int]]
) -> Iterator[str]:
    """Yield in words what explains the differences of channels (n, c), each divided by its own size (c,).

    `sensors` are the places of the channels of each sensor, of which a mistake may have all.
    """
    usual = float(np.sqrt(np.mean(np.abs(predicted) ** 2)))
    deviates = np.sqrt(np.mean(np.abs(measured - predicted) ** 2, axis=0)) > CHANNEL_MISFIT * usual
    deviating = [int(i) for i in np.flatnonzero(deviates)]
    if not deviating or len(names) - len(deviating) < FEWEST_CHANNELS:
        return
    groups = {f"the channels of {name}": at for name, at in sensors.items() if len(at) > 1}
    groups |= {names[i]: [i] for i in deviating}
    for name, at in groups.items():
        factor = _factor(measured[:, at], predicted[:, at]) if sorted(at) == deviating else None
        if factor is not None and not SMALLEST_FACTOR < factor < LARGEST_FACTOR:
            yield _factor_in_words(name, factor, len(at) > 1)
    for (first, one), (second, two) in combinations(groups.items(), 2):
        if len(one) != len(two) or sorted([*one, *two]) != deviating:
            continue
        to, taken = [*one, *two], [*two, *one]
        volts = measured[:, taken] * size[taken] / size[to]
        left = np.sqrt(np.mean(np.abs(volts - predicted[:, to]) ** 2, axis=0))
        if np.all(left < CHANNEL_MISFIT * usual):
            yield f"{first} and {second.replace('the channels', 'those')} are exchanged"


def _factor(measured: ComplexArray, predicted: ComplexArray) -> float | None:
    """Return by what factor readings (n, c) differ from their prediction; None where they have another pattern."""
    product, power = np.vdot(predicted, measured), float(np.vdot(predicted, predicted).real)
    norm = np.sqrt(power * float(np.vdot(measured, measured).real))
    return float(product.real) / power if norm > 0 and abs(product) > SAME_PATTERN * norm else None


def _factor_in_words(name: str, factor: float, is_plural: bool) -> str:
    read, is_reversed = ("read", "are reversed") if is_plural else ("reads", "is reversed")
    if factor > 0:
        return f"{name} {read} {factor:.4g} times what the known loads make"
    if abs(factor + 1.0) < SIGN_TOLERANCE:
        return f"{name} {is_reversed}"
    return f"{name} {is_reversed}, and {read} {abs(factor):.4g} times what the known loads make"
