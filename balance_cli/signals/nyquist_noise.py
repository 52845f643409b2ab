"""Noise of the channels near half the sample rate: what gain and filter make of that of sensors and amplifiers.

No load is known wind-on. But the noise between the highest load and half the sample rate is the same in sound runs,
so that the level of runs with known loads tells whether that of a wind run is of the same settings.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run, pick_channels

Array = NDArray[np.float64]

KINDS_WITH_KNOWN_LOADS = ("sweep", "check")
MOST_SAMPLES = 2**12
"""Samples of a record that are transformed: 300 lines in the band, from which a level is known to 3 %. Of 15 channels
they take 0.6 ms, less than reading the samples."""
FEWEST_SAMPLES = 1024
"""With fewer the level of a channel is not known to a tenth."""
BAND = (0.8, 0.95)
"""Of half the sample rate: above what is excited, and below what the filters of converters remove."""
MAIN_LOBE = 3
"""Bins on either side of a harmonic that it reaches: two of the raised cosine, and one for the scatter of pulses."""
FEWEST_LINES = 50
"""Lines between harmonics, with fewer of which the level of a channel is not known to a tenth."""
EIGENVALUE_FACTOR = 1.5
"""Of the largest eigenvalue of the correlation of c channels at k lines, over the (1 + sqrt(c/k))^2 of independent
noise (Marchenko and Pastur, 1967): loads that reach the band drive all channels together."""
LARGEST_SPREAD = 1.5
"""Ratio of the levels of a channel in the runs with known loads. Where they differ by more, as where noise grows with
the signal, the level of a wind run tells nothing."""


@dataclass(frozen=True)
class RunNoise:
    """Noise of the channels (c,) of a run near half its sample rate [Hz]: root of the density [V/sqrt(Hz)].

    NaN for a channel without a level; `independent`: whether it is of the channels, and no load drives them together.
    """

    run: str
    kind: str
    sample_rate: float
    amplitude: Array
    independent: bool


@dataclass(frozen=True)
class UsualNoise:
    """Noise that runs with known loads at one sample rate [Hz] have in common: root of the density [V/sqrt(Hz)].

    `amplitude` (c,) is NaN for a channel without a common level, which may be all of them.
    """

    sample_rate: float
    channel_names: tuple[str, ...]
    amplitude: Array


def measure_nyquist_noise(run: Run, channel_names: tuple[str, ...]) -> RunNoise | None:
    """Return the noise of a run near half its sample rate, from its last samples; None for a static run."""
    if run.sample_rate is None:
        return None
    count = min(run.samples, MOST_SAMPLES)
    if count < FEWEST_SAMPLES:
        return RunNoise(run.name, run.kind, run.sample_rate, np.full(len(channel_names), np.nan), False)
    channels = pick_channels(run.read(run.samples - count).channels, run.channel_names, channel_names)
    window = np.hanning(count)
    spectrum = np.fft.rfft((channels - channels[0]) * window[:, None], axis=0)
    first, last = (int(share * (len(spectrum) - 1)) for share in BAND)
    lines = spectrum[first:last][_between_harmonics(run, count, np.arange(first, last))]
    if len(lines) < FEWEST_LINES:
        return RunNoise(run.name, run.kind, run.sample_rate, np.full(len(channel_names), np.nan), False)
    power = np.mean(np.abs(lines) ** 2, axis=0)
    usable = np.isfinite(power) & (power > 0)
    normed = lines[:, usable] / np.sqrt(power[usable])
    largest = float(np.linalg.eigvalsh(normed.conj().T @ normed)[-1] / len(lines)) if usable.any() else np.inf
    limit = EIGENVALUE_FACTOR * (1.0 + np.sqrt(usable.sum() / len(lines))) ** 2
    density = 2.0 * power / (run.sample_rate * np.sum(window**2))
    amplitude = np.sqrt(np.where(usable, density, np.nan))
    return RunNoise(run.name, run.kind, run.sample_rate, amplitude, bool(largest < limit))


def _between_harmonics(run: Run, count: int, bins: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which bins of a spectrum over the last samples of a run hold no harmonic of its rotor.

    Without a declared filter, or with a slow sample rate, the harmonics of the loads reach half the sample rate.
    """
    if run.pulse_times is None or run.sample_rate is None:
        return np.ones(len(bins), bool)
    start = (run.samples - count) / run.sample_rate
    turns = np.diff(run.pulse_times[run.pulse_times >= start])
    turns = turns[turns > 0]
    if not len(turns):
        return np.ones(len(bins), bool)
    resolution = run.sample_rate / count
    slow, fast = (float(np.percentile(1.0 / turns, share)) / resolution for share in (5.0, 95.0))
    # A bin is free where no multiple of a speed between these lies within the main lobe.
    return np.asarray(np.ceil((bins - MAIN_LOBE) / fast) > np.floor((bins + MAIN_LOBE) / slow))


def usual_noise(levels: Iterable[RunNoise | None], channel_names: tuple[str, ...]) -> tuple[UsualNoise, ...]:
    """Return the noise that the runs with known loads have in common, for each sample rate at which there are any."""
    by_rate: dict[float, list[Array]] = {}
    for level in levels:
        if level is not None and level.kind in KINDS_WITH_KNOWN_LOADS:
            independent = by_rate.setdefault(level.sample_rate, [])
            if level.independent:
                independent.append(level.amplitude)
    unknown = np.full(len(channel_names), np.nan)
    return tuple(
        UsualNoise(rate, channel_names, _common_level(amplitudes, unknown))
        for rate, amplitudes in sorted(by_rate.items())
    )


def measure_usual_noise(runs: Iterable[Run], channel_names: tuple[str, ...]) -> tuple[UsualNoise, ...]:
    """Return the noise that the sweeps among runs have in common, for each sample rate at which there are any."""
    return usual_noise(
        (measure_nyquist_noise(run, channel_names) for run in runs if run.kind == "sweep"), channel_names
    )


def _common_level(levels: Sequence[Array], unknown: Array) -> Array:
    """Return the level (c,) that several runs have in common; `unknown` where they have none."""
    if len(levels) < 2:
        return unknown
    amplitudes = np.array(levels)
    known = np.isfinite(amplitudes).all(axis=0)
    if not known.any() or np.any(amplitudes[:, known].max(axis=0) > LARGEST_SPREAD * amplitudes[:, known].min(axis=0)):
        return unknown
    return np.where(known, np.median(amplitudes, axis=0), np.nan)
