"""Noise of the channels near half the sample rate, of wind runs against runs with known loads.

Wind-on, no load is known: a factor in all channels, or another filter in all of them, makes loads that are possible.
But gain and filter also change the noise of sensors and amplifiers before them, which in sound runs is the same. Noise
that arises behind them shows neither.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run, pick_channels
from balance_cli.diagnosis.consistency.findings import NOISE_LEVEL, WARNING, ConsistencyFinding

Array = NDArray[np.float64]

MOST_SAMPLES = 2**14
"""Samples of a record that are transformed: some thousand lines in the band."""
FEWEST_SAMPLES = 1024
"""With fewer the level of a channel is not known to a tenth."""
BAND = (0.8, 0.95)
"""Of half the sample rate: above what is excited, and below what the filters of converters remove."""
EIGENVALUE_FACTOR = 1.5
"""Of the largest eigenvalue of the correlation of c channels at k lines, over the (1 + sqrt(c/k))^2 of independent
noise (Marchenko and Pastur, 1967): loads that reach the band drive all channels together."""
LARGEST_SPREAD = 1.5
"""Ratio of the levels of a channel in the runs with known loads. Where they differ by more, as where noise grows with
the signal, the level of a wind run tells nothing."""
SMALLEST_RATIO = 2.0
"""Of all channels at once: amplifiers repeat their noise to some tenths."""


@dataclass(frozen=True)
class _Level:
    """Root of the density (c,) in the band, up to a factor, NaN where there is none; whether it is of the channels."""

    run: Run
    amplitude: Array
    independent: bool


def noise_findings(runs: Sequence[Run], channel_names: tuple[str, ...]) -> list[ConsistencyFinding]:
    """Return a finding for the wind runs in which all channels have much less or more noise than in the other runs."""
    if not any(run.kind == "wind" for run in runs):
        return []
    findings = []
    for rate in sorted({run.sample_rate for run in runs if run.sample_rate}):
        levels = [_noise_level(run, channel_names) for run in runs if run.sample_rate == rate and run.kind != "zero"]
        known = [level for level in levels if level.run.kind in ("sweep", "check") and level.independent]
        usual = _common_level(known)
        if usual is not None:
            ratios = [(level, _common_ratio(level, usual)) for level in levels if level.run.kind == "wind"]
            findings += [_describe(level.run, ratio) for level, ratio in ratios if ratio is not None]
    return findings


def _noise_level(run: Run, channel_names: tuple[str, ...]) -> _Level:
    count = min(run.samples, MOST_SAMPLES)
    if count < FEWEST_SAMPLES:
        return _Level(run, np.full(len(channel_names), np.nan), False)
    channels = pick_channels(run.read(run.samples - count).channels, run.channel_names, channel_names)
    spectrum = np.fft.rfft((channels - channels[0]) * np.hanning(count)[:, None], axis=0)
    first, last = (int(share * (len(spectrum) - 1)) for share in BAND)
    lines = spectrum[first:last]
    amplitude = np.sqrt(np.mean(np.abs(lines) ** 2, axis=0) / count)
    usable = np.isfinite(amplitude) & (amplitude > 0)
    normed = lines[:, usable] / (amplitude[usable] * np.sqrt(count))
    correlation = (normed.conj().T @ normed) / len(lines)
    largest = float(np.linalg.eigvalsh(correlation)[-1]) if usable.any() else np.inf
    limit = EIGENVALUE_FACTOR * (1.0 + np.sqrt(usable.sum() / len(lines))) ** 2
    return _Level(run, np.where(usable, amplitude, np.nan), bool(largest < limit))


def _common_level(levels: Sequence[_Level]) -> Array | None:
    """Return the level (c,) that several runs have in common; None where they have none."""
    if len(levels) < 2:
        return None
    amplitudes = np.array([level.amplitude for level in levels])
    known = np.isfinite(amplitudes).all(axis=0)
    if not known.any() or np.any(amplitudes[:, known].max(axis=0) > LARGEST_SPREAD * amplitudes[:, known].min(axis=0)):
        return None
    return np.where(known, np.median(amplitudes, axis=0), np.nan)


def _common_ratio(level: _Level, usual: Array) -> float | None:
    """Return by what all channels have more or less noise than usual; None where not all of them do."""
    ratios = level.amplitude / usual
    ratios = ratios[np.isfinite(ratios)]
    if not len(ratios):
        return None
    less = ratios.max() < 1.0 / SMALLEST_RATIO
    more = ratios.min() > SMALLEST_RATIO and level.independent
    return float(np.median(ratios)) if less or more else None


def _describe(run: Run, ratio: float) -> ConsistencyFinding:
    text = f"all channels have {ratio:.3g} times the noise that they have in the runs with known loads"
    return ConsistencyFinding(
        NOISE_LEVEL, WARNING, f"{text}: another gain, unit or filter?", (run.name,), factor=float(f"{ratio:.3g}")
    )
