"""A gain or a delay that drifts in the course of a record, by the residual of its local models.

A drift adds to a channel y(t) a part s(t) (g y - tau y'), where s rises from -1/2 to 1/2 over the record. In the
spectrum that is (g - j w tau) S(w), with the transform S of s y. Neighboring lines of S differ as those of the loads
do, so that no response and no transient describes it: with the projection P of a window on what its local model leaves,

    P Y = (g - j w tau) P S + noise

by least squares (Frisch and Waugh, Econometrica 1 (1933) 387). The noise is that of the lines as they scatter about it
(White, Econometrica 48 (1980) 817), since a drift is in the measured noise too; beside it stands what the models leave
of a response that does not drift.

P leaves hardly anything of S where the signal has one frequency after the other: a swept sine that drifts is one
whose response is another. Then P S is the noise of the channel times the ramp, and tells nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.local.models import LocalModels
from balance_cli.signals.run_spectrum import RecordDrift

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MODEL_ERROR = 1.5e-4
"""Share of a channel's signal by which the models let it seem to drift: of 60 stepped records of five sound rigs those
with errors of 4e-5 to 2e-4 by their noise scatter by up to 1.6e-4 more. A bridge that drifts does so by 1e-3."""

RAMP_POWER = 1.0 / 12.0
"""Mean square of the ramp: noise times the ramp has this share of the power of the noise."""
LEAST_RAMP = 10.0
"""Power of what is left of a signal times the ramp over that of noise, below which noise would be a tenth of it, and
drifts as much too small. Of random records 20 to 3e5 is left."""
MOST_OF_RAMP = 0.1
"""Share of the power of a signal times the ramp from which on it is left: of random records 0.25 to 0.9."""
LEAST_SMALL_RAMP = 100.0
"""The same where little is left, 1e-6 to 1e-4 of swept sines: the loads turn from line to line in one direction there,
so that the noise and the noise times the ramp are alike. Sound sweeps had 11 sigma at 1, 4.4 at 16 and 1.6 at 1000."""


def record_drift(models: LocalModels) -> RecordDrift:
    """Estimate the drift of each channel over the record of fitted local models, against its loads."""
    s, lines = models.spectrum, models.spectrum.excited
    drifting = _project(models, ramp_spectrum(s.channels))[lines]
    residual = _project(models, s.channels)[lines]
    weight = 1.0 / _noise_power(models)[lines]
    omega = 2.0 * np.pi * s.frequency[lines, None]
    power = np.mean(weight * np.abs(s.channels[lines]) ** 2, axis=0)
    ramp = np.mean(weight * np.abs(drifting) ** 2, axis=0) / RAMP_POWER
    # Of a gain and of a delay, which are at right angles at every line.
    part = np.stack([drifting, -1j * omega * drifting])
    size = np.sum(weight * np.abs(part) ** 2, axis=1)
    value = np.sum(weight * (part.conj() * residual).real, axis=1) / size
    left = residual - np.sum(value[:, None] * part, axis=0)
    score = weight * (part.conj() * left).real / size[:, None]
    # A delay turns the signal by its mean angular frequency: the same share of it.
    model_error = MODEL_ERROR**2 * size[:1] / size
    return RecordDrift(
        change=value / 2.0,
        covariance=score.swapaxes(1, 2) @ score / 4.0 + model_error[:, :, None] * np.eye(size.shape[1]),
        signal_to_noise=np.where(
            ramp > np.where(ramp > MOST_OF_RAMP * power, LEAST_RAMP, LEAST_SMALL_RAMP), power, 0.0
        ),
        dof=float(len(residual)),
    )


def _noise_power(models: LocalModels) -> Array:
    """Variances (K, c) of the residuals at each line, by the noise of channels and loads."""
    of_loads = np.sum((models.response @ models.noise.loads) * models.response.conj(), axis=2).real
    return np.asarray(np.diagonal(models.noise.channels, axis1=1, axis2=2).real + of_loads)


def ramp_spectrum(lines: ComplexArray) -> ComplexArray:
    """Return the lines (K, c) of a signal times a ramp that rises from -1/2 to 1/2 over its record."""
    count = 2 * len(lines)
    time = (np.arange(count) + 0.5) / count - 0.5
    signal = np.fft.ifft(lines, count, axis=0)
    return np.asarray(np.fft.fft(signal * time[:, None], axis=0)[: len(lines)])


def _project(models: LocalModels, lines: ComplexArray) -> ComplexArray:
    """What the local models, with their poles as they are, leave of the lines (K, c) of some outputs."""
    left = np.zeros_like(lines)
    for fit, first, (start, stop) in zip(models.fit, models.first, models.assigned_lines, strict=True):
        coefficients = fit.pseudoinverse @ lines[first : first + len(fit.r)]
        left[start:stop] = lines[start:stop] - fit.regressors[start - first : stop - first] @ coefficients
    return left
