"""Scaled spectrum of a whole record, as the local models use it, and tests of its loads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.signals.covariance_pooling import window_sums
from balance_cli.signals.impact import IMPACT, WindowedForces, has_short_hits, is_mostly_hits, window_forces
from balance_cli.signals.run_samples import load_columns, measured_components, read_samples, run_error, sample_rate

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

RATIONAL_LINES = 81
"""Least lines in a window of a rational model: several for each of its coefficients."""
LEAST_POWER_SHARE = 1e-4
"""Power of a load, over that where it is strong, from which a line counts as excited (-40 dB)."""
END_SHARE = 0.0185
"""Of the record, at either end, within which a load excites no line: its spectrum turns so slowly from line to line
that a transient numerator of degree d describes it up to (d + 1) / (pi M) of the record, 2 % with d = 4, M = 81 lines,
some of which the half sine takes. The response to such a load passes for the transient of the start or end."""
IMPACT_POWER_SHARE = 1e-3
"""The same of a hammer (-30 dB): the spectrum of a hit falls off, and beyond its first zero the noise decides."""
LEAST_INDEPENDENCE = 1e-6
"""Smallest eigenvalue of the coherence matrix of the loads; with less they differ by 0.1 % of their amplitude."""


@dataclass(frozen=True)
class WindowNoise:
    """Noise of loads within a force window: its `variance` (u,) at each line, in scaled units.

    It is a smooth error of as many lines as the window is shorter than the record, `correlated_lines`; no line shows it
    on its own.
    """

    variance: Array
    correlated_lines: float


@dataclass(frozen=True)
class ScaledSpectrum:
    """Spectrum of a whole record at K neighboring lines of `frequency` (K,) [Hz].

    The amplitudes `channels` (K, c) and `loads` (K, u) are divided by `channel_scale` (c,) and `load_scale` (u,), which
    makes their sizes comparable. `excited` (K,) says where some load has power. `window_noise` is that of a hammer
    within its force window.
    """

    run: Run
    channel_names: tuple[str, ...]
    components: tuple[str, ...]
    frequency: Array
    channels: ComplexArray
    loads: ComplexArray
    channel_scale: Array
    load_scale: Array
    excited: NDArray[np.bool_]
    window_noise: WindowNoise | None = None


def record_spectrum(run: Run, channel_names: Sequence[str], band: tuple[float, float]) -> ScaledSpectrum:
    """Transform the whole record, and return the lines of the excited part of `band` [Hz], without zero frequency.

    Raises UserError where the record is too short, or loads are proportional to each other.
    """
    channels, loads = read_samples(run, channel_names)
    components = measured_components(run, loads)
    _require_declared_impact(run, loads[:, load_columns(run.excited or components)])
    applied, windowed = loads[:, load_columns(components)], None
    if run.excitation == IMPACT:
        windowed = window_forces(applied)
        applied = windowed.loads
    z = np.hstack([channels, applied])
    Z = np.fft.rfft(z, axis=0)[1 : (run.samples + 1) // 2] * (2.0 / run.samples)
    frequency = np.arange(1, len(Z) + 1) * sample_rate(run) / run.samples
    c = len(channel_names)
    inside = (frequency >= band[0]) & (frequency <= band[1])
    is_hammer = run.excitation == IMPACT
    covered = inside & (has_power(Z[:, c:], IMPACT_POWER_SHARE) if is_hammer else is_within_power(applied))
    excited = covered if is_hammer else covered & is_within_power(applied, END_SHARE)
    if np.count_nonzero(excited) < RATIONAL_LINES:
        raise run_error(run, "the record is too short, or its loads too narrow in frequency", "Record for longer")
    if np.median(load_independence(local_power(Z[excited, c:]))) < LEAST_INDEPENDENCE:
        raise run_error(
            run, "the loads excited at once are proportional to each other", "Excite with different phases", "loads"
        )
    margin = RATIONAL_LINES // 2
    selection = slice(max(int(np.argmax(covered)) - margin, 0), len(Z) - int(np.argmax(covered[::-1])) + margin)
    channel_scale = _nonzero_rms(Z[selection, :c])
    load_scale = _nonzero_rms(Z[selection, c:])
    return ScaledSpectrum(
        run=run,
        channel_names=tuple(channel_names),
        components=components,
        frequency=frequency[selection],
        channels=Z[selection, :c] / channel_scale,
        loads=Z[selection, c:] / load_scale,
        channel_scale=channel_scale,
        load_scale=load_scale,
        excited=excited[selection],
        window_noise=None if windowed is None else _window_noise(windowed, load_scale),
    )


def _window_noise(windowed: WindowedForces, load_scale: Array) -> WindowNoise | None:
    """Return the noise within the window at a line of the spectrum; None where there is no window."""
    samples, noise_samples = len(windowed.loads), windowed.samples
    if not noise_samples:
        return None
    return WindowNoise(windowed.noise**2 * 4.0 * noise_samples / samples**2 / load_scale**2, samples / noise_samples)


def _require_declared_impact(run: Run, loads: Array) -> None:
    """Raise UserError where the loads are short hits and hardly else, and the excitation is declared as something else.

    A hammer excites only up to some frequency, and lines beyond it would pass as measured.
    """
    if run.excitation == IMPACT or not loads.shape[1]:
        return
    if all(has_short_hits(column) or is_mostly_hits(column) for column in loads.T):
        fault = f"the load is zero but for short hits, which is no `{run.excitation}` excitation"
        raise run_error(run, fault, "Declare `excitation = impact`", "attribute excitation")


def has_power(loads: ComplexArray, share: float = LEAST_POWER_SHARE) -> NDArray[np.bool_]:
    """Return whether (K,) some load has power around a line, `share` of that where the load is strong."""
    width = min(RATIONAL_LINES // 2, len(loads))
    power = window_sums(np.abs(loads) ** 2, width)
    strong = np.quantile(power, 0.95, axis=0)
    return np.asarray(np.any(power > share * np.maximum(strong, 1e-300), axis=1))


def is_within_power(samples: Array, end_share: float = 0.0) -> NDArray[np.bool_]:
    """Return whether (K,) some load (n, u) has power on both sides of each line of its record but frequency zero.

    Power within the share `end_share` of the record at either end does not count.

    Each within half a window: a response is interpolated there. Beyond the band of the loads it would be extrapolated,
    and the lines of a record that does not repeat do not show where that ends, because they leak. Those of the record
    under half a sine do not, and even the first and last thousandths of a sweep are seen in them.
    """
    n = len(samples)
    position = ((np.arange(n) + 0.5) / n - end_share) / (1.0 - 2.0 * end_share)
    taper = np.sin(np.pi * np.clip(position, 0.0, 1.0))
    power = np.abs(np.fft.rfft(samples * taper[:, None], axis=0)[1 : (n + 1) // 2]) ** 2
    width = min(RATIONAL_LINES // 2, len(power))
    total = np.concatenate([np.zeros((1, power.shape[1])), np.cumsum(power, axis=0)])
    line = np.arange(len(power))
    below = total[line + 1] - total[np.maximum(line + 1 - width, 0)]
    above = total[np.minimum(line + width, len(power))] - total[line]
    strong = np.maximum(np.quantile(window_sums(power, width), 0.95, axis=0), 1e-300)
    return np.asarray(np.any(np.minimum(below, above) > LEAST_POWER_SHARE * strong, axis=1))


def local_power(loads: ComplexArray) -> ComplexArray:
    """Return the spectral matrix (K, u, u) of the loads (K, u), averaged over the lines of a window."""
    outer = loads[:, :, None] * loads[:, None, :].conj()
    width = min(RATIONAL_LINES, len(loads))
    return np.asarray(window_sums(outer, width) / width)


def load_independence(power: ComplexArray) -> Array:
    """Return the smallest eigenvalue (K,) of the coherence matrix of the loads; it is 0 where they are proportional."""
    size = np.sqrt(np.maximum(np.diagonal(power, axis1=1, axis2=2).real, 1e-300))
    return np.asarray(np.linalg.eigvalsh(power / (size[:, :, None] * size[:, None, :]))[:, 0])


def _nonzero_rms(values: ComplexArray) -> Array:
    rms = np.sqrt(np.mean(np.abs(values) ** 2, axis=0))
    return np.asarray(np.where(rms > 0, rms, 1.0))
