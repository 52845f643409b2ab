"""Mean loads where the channels depend on temperature: readings are referred to the temperature of the calibration.

The apparent strain acts by the difference between the record and its zero, the drift of the sensitivity by that between
the record and the calibration, in proportion to the loads, so that loads and correction are iterated. Where a
temperature is not known, sigma contains what those of the calibration would do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration
from balance_cli.calibration.temperature_terms import UNKNOWN_EFFECT, TemperatureTerms
from balance_cli.campaign.recording.temperature import mean_temperature
from balance_cli.reduction.flags import EXTRAPOLATED, NO_TEMPERATURE, join_flags
from balance_cli.reduction.mean_loads import MeanLoads
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.reduction.wind_off import ZeroRecord
from balance_cli.signals.rotor.harmonics import Harmonics

Array = NDArray[np.float64]

ITERATIONS = 4
"""Each reduces the error of the correction by the relative drift of the sensitivity, a few per cent at the most."""

Solver = Callable[[Harmonics, ZeroRecord | None], MeanLoads]


def mean_loads_at_temperature(
    record: RotorRecord, calibration: Calibration, zero: ZeroRecord | None, solve: Solver
) -> MeanLoads:
    """Compute mean loads from a record with the effects of temperature taken out; `solve` computes them otherwise.

    Where the calibration did not determine these effects, loads far from its temperature or from that of the zero are
    flagged as extrapolated.
    """
    assert record.run.sample_rate is not None
    start, stop = (int(time * record.run.sample_rate) for time in record.spectra.interval)
    own, terms = mean_temperature(record.run, start, stop), calibration.temperature
    if terms is not None:
        return _with_terms(record, terms, own, zero, solve)
    loads, note = solve(record.spectra, zero), _other_temperature(own, zero, calibration.stated_temperatures)
    if not note:
        return loads
    flags = tuple(join_flags((flag, EXTRAPOLATED)) for flag in loads.flags)
    return replace(loads, flags=flags, note="; ".join(filter(None, [loads.note, note])))


def _other_temperature(own: float | None, zero: ZeroRecord | None, calibrated: tuple[float, float] | None) -> str:
    """What is said of a record at `own` [degC], far from its zero or from the temperatures of the calibration."""
    if own is None:
        return ""
    lowest, highest = calibrated or (own, own)
    at_zero = own if zero is None or zero.temperature is None else zero.temperature
    others = []
    if not lowest - UNKNOWN_EFFECT < own < highest + UNKNOWN_EFFECT:
        limits = dict.fromkeys(f"{limit:.1f}" for limit in (lowest, highest))
        others += [f"the calibration at {' to '.join(limits)}"]
    if abs(own - at_zero) > UNKNOWN_EFFECT:
        others += [f"its zero at {at_zero:.1f}"]
    if not others:
        return ""
    return f"recorded at {own:.1f} degC, {' and '.join(others)} degC: what temperature does was not determined"


def _with_terms(
    record: RotorRecord, terms: TemperatureTerms, own: float | None, zero: ZeroRecord | None, solve: Solver
) -> MeanLoads:
    """Compute mean loads from a record at `own` [degC] with the known effects of temperature taken out."""
    reference = terms.reference if zero is None else zero.temperature
    difference = 0.0 if own is None else own - terms.reference
    # A zero whose temperature is not known was most probably recorded at that of the run, or at the mean one.
    zero_difference = difference if reference is None else reference - terms.reference
    zero = _shift_zero(zero, terms, zero_difference)
    loads = np.zeros(len(terms.components))
    for _ in range(ITERATIONS):
        result = solve(_corrected(record.spectra, terms, difference, loads), zero)
        loads = np.array([dict(zip(result.components, result.loads, strict=True))[name] for name in terms.components])
    unknown_zero = own is None or reference is None
    covariance = np.diag(terms.error_variance(difference - zero_difference, difference, loads))
    if unknown_zero:
        shift = terms.slopes(np.zeros((1, len(loads))))[0]
        # Where both are unknown, record and zero differ by two temperatures.
        both = 2.0 if own is None and zero is not None and zero.temperature is None else 1.0
        covariance = covariance + both * terms.spread**2 * np.outer(shift, shift)
    if own is None:
        drift = terms.slopes(loads, shift=0.0)[0]
        covariance = covariance + terms.spread**2 * np.outer(drift, drift)
    result = solve(_corrected(record.spectra, terms, difference, loads, covariance), zero)
    outside = own is not None and terms.is_outside(own)
    words = (NO_TEMPERATURE if unknown_zero else "", EXTRAPOLATED if outside else "")
    note = "; ".join(filter(None, [result.note, _describe(terms, own, reference, outside)]))
    return replace(result, flags=tuple(join_flags((flag, *words)) for flag in result.flags), note=note)


def _shift_zero(zero: ZeroRecord | None, terms: TemperatureTerms, difference: float) -> ZeroRecord | None:
    """The zero record as it would read at the reference temperature."""
    if zero is None:
        return None
    shift = dict(zip(terms.channel_names, (difference * terms.coefficients[0]).tolist(), strict=True))
    return replace(zero, mean=zero.mean - np.array([shift.get(name, 0.0) for name in zero.channel_names]))


def _corrected(
    spectra: Harmonics, terms: TemperatureTerms, difference: float, loads: Array, covariance: Array | None = None
) -> Harmonics:
    """The spectra with the mean readings at the reference temperature, and the covariance (c, c) of the correction."""
    here = [place for place, name in enumerate(terms.channel_names) if name in spectra.names]
    at = spectra.columns([terms.channel_names[place] for place in here])
    amplitude, total = spectra.amplitude.copy(), spectra.covariance.copy()
    amplitude[0, at] -= difference * terms.slopes(loads)[0, here]
    if covariance is not None:
        total[0][np.ix_(at, at)] += covariance[np.ix_(here, here)]
    return replace(spectra, amplitude=amplitude, covariance=total)


def _describe(terms: TemperatureTerms, own: float | None, reference: float | None, outside: bool) -> str:
    limits = f"{terms.lowest:.1f} to {terms.highest:.1f} degC"
    if own is None:
        return (
            "the channels depend on temperature, and the run states none: sigma of the mean loads covers the "
            f"temperatures of the calibration, {limits}"
        )
    if reference is None:
        return (
            "the channels depend on temperature, and the zero run states none: sigma of the mean loads covers a zero "
            f"within the temperatures of the calibration, {limits}"
        )
    return f"mean temperature {own:.1f} degC is outside those of the calibration, {limits}" if outside else ""
