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

from balance_cli.calibration.temperature_terms import TemperatureTerms
from balance_cli.campaign.recording.temperature import mean_temperature
from balance_cli.reduction.flags import EXTRAPOLATED, NO_TEMPERATURE, join_flags
from balance_cli.reduction.mean_loads import MeanLoads, ZeroRecord
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.signals.rotor.harmonics import Harmonics

Array = NDArray[np.float64]

ITERATIONS = 4
"""Each reduces the error of the correction by the relative drift of the sensitivity, a few per cent at the most."""

Solver = Callable[[Harmonics, ZeroRecord | None], MeanLoads]


def mean_loads_at_temperature(
    record: RotorRecord, terms: TemperatureTerms, zero: ZeroRecord | None, solve: Solver
) -> MeanLoads:
    """Compute mean loads from a record with the effects of temperature taken out; `solve` computes them otherwise."""
    assert record.run.sample_rate is not None
    start, stop = (int(time * record.run.sample_rate) for time in record.spectra.interval)
    own = mean_temperature(record.run, start, stop)
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
