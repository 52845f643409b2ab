"""What vibration adds to the mean readings of channels that are not linear.

A channel reads a function r(x) of the loads x that would cause its reading at rest. In a vibration x(t) varies by the
elastic forces on the cells; the inertia forces among these have no mean, so that the mean of x is that of the hub
loads. But the mean of r(x) is not r of the mean of x. With the calibration's terms N beyond the loads themselves,

    shift = mean N(x(t)) - N(mean x),        x(t) = mean x + W (r(t) - mean r)

where W is the weighted inverse of the Jacobian at the mean loads. The shift is taken off the mean readings. A square of
a load that oscillates by half of its range has an eighth of its full size as mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.math_model import CalibrationModel, weighted_inverse
from balance_cli.calibration.terms import term_values
from balance_cli.campaign.recording.run import read_channels
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MOST_SAMPLES = 16_384
"""Samples whose mean is taken, at random within equal intervals: it scatters by 1 / sqrt(n), less than 1 % of the rms
of the terms. At a constant distance they might all have the same azimuth."""
AT_ONCE = 2**16
"""Samples that are read at once: a record may last for minutes at 50 kHz."""
SHIFT_ERROR = 0.05
"""Share by which the shift is uncertain beside its coefficients: of vibrations that the inverse of the Jacobian
follows to first order alone, and that reach loads which were not applied together."""


@dataclass(frozen=True)
class VibrationShift:
    """What vibration adds to the mean `readings` (c,) [V] of some channels, and the rms `loads` (k,) [N, N m]."""

    readings: Array
    loads: Array


def read_deviations(record: RotorRecord, names: tuple[str, ...]) -> Array | None:
    """Return the readings (m, c) of channels about their mean over the revolutions of a record; zeros of absent ones.

    None where the response has taken nonlinear forces out of the record: they are what the calibration's terms show.
    """
    if record.recorded is not None and record.recorded is not record.run:
        return None
    run, rate = record.run, sample_rate(record.run)
    start, stop = (min(round(time * rate), run.samples) for time in record.spectra.interval)
    step = max(1, (stop - start) // MOST_SAMPLES)
    first = np.arange(start, stop - step + 1, step)
    index = first + np.random.default_rng(0).integers(0, step, len(first))
    parts = []
    for low in range(start, stop, AT_ONCE):
        here = index[(index >= low) & (index < low + AT_ONCE)] - low
        parts.append(read_channels(run, names, low, min(low + AT_ONCE, stop))[here])
    samples = np.concatenate(parts)
    known = np.isfinite(samples)
    mean = samples.sum(axis=0, where=known) / np.maximum(known.sum(axis=0), 1)
    return np.where(known, samples - mean, 0.0)


def vibration_shift(model: CalibrationModel, rows: Index, loads: Array, deviations: Array) -> VibrationShift:
    """Return what deviations (m, c) of the readings shift their means by, at mean loads (k,) [N, N m].

    `rows`: the usable ones of the model's channels.
    """
    W = weighted_inverse(model.jacobian(loads, rows)[0], model.weight_covariance(rows))
    mean = loads / model.calibrated_range
    x = mean + deviations[:, rows] @ W.T
    k = len(model.components)
    terms, coefficients = model.parsed_terms[k:], model.coefficients[k:, rows]
    shift = (term_values(terms, x).mean(axis=0) - term_values(terms, mean[None])[0]) @ coefficients
    rms = np.sqrt(np.mean(x**2, axis=0)) * np.where(mean < 0, -1.0, 1.0) * model.calibrated_range
    return VibrationShift(np.asarray(shift), np.asarray(rms))
