"""Which channels contradict the others: what is left when one or two of them are not used."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.reduction.check_errors import SAME_PATTERN
from balance_cli.reduction.harmonic_loads import harmonic_loads, harmonic_response
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.reduction.weighted_least_squares import SolvedLoads
from balance_cli.signals.anti_alias import anti_alias_response

ComplexArray = NDArray[np.complex128]

REJECTED_SHARE = 0.5
"""Share of rejected harmonics from which a channel is looked for: a fault of a channel shows in all of them."""
EXPLAINED_SHARE = 0.2
"""Share of the rejected harmonics that may remain without the channel that is to blame."""
PAIR_CANDIDATES = 6
"""Channels whose pairs are tried: those without which the least contradiction remains."""
FACTOR_TOLERANCE = 0.2
"""Departure of a factor from -1 or 1 that is still taken for a sign or an exchange."""


def describe_suspect_channels(
    record: RotorRecord, geometry: Geometry, source: ResponseSource, solution: SolvedLoads
) -> str:
    """Return the one or two channels without which the residual test is passed, and what is wrong with them, in words.

    Empty where the test is passed with all of them, where no channel or pair explains it, and where several do; and
    where the response is known to miss its own data, because then it is to blame.
    """
    if np.mean(solution.misfit) < REJECTED_SHARE or source.response_error is not None or source.is_contradicted:
        return ""
    left = {name: _rejection(record, geometry, source, (name,)) for name in record.health.live}
    passed: list[tuple[str, ...]] = [(name,) for name, (share, _) in left.items() if share <= EXPLAINED_SHARE]
    if not passed:
        pairs = combinations(sorted(left, key=lambda name: left[name])[:PAIR_CANDIDATES], 2)
        passed = [pair for pair in pairs if _rejection(record, geometry, source, pair)[0] <= EXPLAINED_SHARE]
    return _describe(record, geometry, source, passed[0]) if len(passed) == 1 else ""


def _without(record: RotorRecord, names: tuple[str, ...]) -> RotorRecord:
    live = tuple(name for name in record.health.live if name not in names)
    return replace(record, health=replace(record.health, live=live))


def _rejection(
    record: RotorRecord, geometry: Geometry, source: ResponseSource, names: tuple[str, ...]
) -> tuple[float, float]:
    """Return the share of harmonics rejected without these channels, and the mean redundancy left; inf if untested."""
    try:
        solution = harmonic_loads(_without(record, names), geometry, source)
    except UserError:
        return np.inf, np.inf
    if not np.all(solution.degrees > 0):
        return np.inf, np.inf
    return float(np.mean(solution.misfit)), float(np.mean(solution.redundancy_chi2))


def _describe(record: RotorRecord, geometry: Geometry, source: ResponseSource, names: tuple[str, ...]) -> str:
    measured, predicted = _readings(record, geometry, source, names)
    test = f"; without {'it' if len(names) == 1 else 'them'} the residual test is passed"
    if len(names) == 2 and all(_factor(measured[:, i], predicted[:, 1 - i], 1.0) for i in (0, 1)):
        return f"{names[0]} and {names[1]} are exchanged{test}"
    if len(names) == 1:
        ratio = float(np.vdot(predicted[:, 0], measured[:, 0]).real / np.vdot(predicted[:, 0], predicted[:, 0]).real)
        if _factor(measured[:, 0], predicted[:, 0], -1.0):
            return f"{names[0]} is reversed{test}"
        if _factor(measured[:, 0], predicted[:, 0], ratio):
            return f"{names[0]} reads {ratio:.4g} times what the other channels say{test}"
    return f"{' and '.join(names)} contradict the other channels{test}"


def _factor(measured: ComplexArray, predicted: ComplexArray, factor: float) -> bool:
    """Return whether readings (n,) are a factor times the prediction."""
    product, power = np.vdot(predicted, measured), float(np.vdot(predicted, predicted).real)
    pattern = abs(product) / np.sqrt(power * float(np.vdot(measured, measured).real))
    return bool(pattern > SAME_PATTERN and abs(product.real / power - factor) <= FACTOR_TOLERANCE * abs(factor))


def _readings(
    record: RotorRecord, geometry: Geometry, source: ResponseSource, names: tuple[str, ...]
) -> tuple[ComplexArray, ComplexArray]:
    """Return measured and predicted amplitudes (n, k) [V] of the channels, by the loads from all other channels."""
    frequency = record.spectra.frequency_hz[1:]
    loads = harmonic_loads(_without(record, names), geometry, source).loads
    rows = source.channel_combination(frequency, record.health.live).rows
    columns = [COMPONENTS.index(name) for name in record.components]
    at = [record.health.live.index(name) for name in names]
    T = harmonic_response(record, geometry, source)[:, [rows[i] for i in at]][:, :, columns]
    H = anti_alias_response(geometry.acquisition, frequency)
    measured = record.spectra.amplitude[1:, record.spectra.columns(names)] / H[:, None]
    return measured, np.einsum("hkm,hm->hk", T, loads)
