"""Whether the level of random loads within a band stays the same throughout a record.

Spectra are means over windows that are as long as the modes demand, and which weigh the ends of the record less than
its middle: of loads that change their level within the record they are neither the spectra before nor those after. The
loads of short windows have the powers p_1 to p_w, of which the logarithms scatter alike whatever the level: they are
tested as the amplitudes of harmonics are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run, read_channels
from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.signals.rotor.steadiness import FEWEST_WINDOWS, MATERIAL_CHANGE, TARGET_WINDOWS, unsteady
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

INDEPENDENT_BINS = 20.0
"""Width of the loads within a band times the length of a window: the power of a window scatters by 30 % then, and its
logarithm is nearly normal."""
WINDOW_DECAYS = 1.5
"""Time constants of the slowest mode in a window, where the record has room for enough of them: of what it still rings
with from the window before, a fifth of the power is left on average."""
FEWEST_BINS = 8.0
"""The same, below which a component is not examined: loads of a narrow band rise and fall by themselves."""
BURST = 6.0
"""Logarithm of the power of a window over the median, in standard deviations of random loads, from which it is a burst,
which is too short to shift the level before it from that after it."""
TAPERED_BINS = 1.94
"""Statistical bandwidth of a window tapered by a raised cosine, in bins (Bendat and Piersol, Random Data, 11.5)."""
MATERIAL_LEVEL = 1.25
"""Factor of rms between two parts of a record from which it has no one level: turbulence of a steady wind in parts of
some seconds repeats to a few per cent."""


@dataclass(frozen=True)
class BandSteadiness:
    """The components that change their level within a record, and in words when that of the clearest does."""

    unsteady: tuple[str, ...] = ()
    note: str = ""


def band_steadiness(
    run: Run,
    live: tuple[str, ...],
    components: tuple[str, ...],
    first: int,
    band: tuple[float, float],
    width: Array,
    decay: float,
    inverse: Callable[[Array], ComplexArray],
) -> BandSteadiness:
    """Examine the loads of the channels `live` (c,) from sample `first` on within a band [Hz].

    `width` (m,) [Hz] are the statistical bandwidths of the loads, `decay` [s] is that of the slowest mode within the
    band; `inverse` gives the matrices (k, m, c) from channels to loads at frequencies (k,).
    """
    rate, samples = sample_rate(run), run.samples - first
    seconds = samples / rate
    most = max(seconds / (WINDOW_DECAYS * decay), FEWEST_WINDOWS) if decay > 0 else TARGET_WINDOWS
    count = int(min(TARGET_WINDOWS, most, seconds * float(np.median(width)) / INDEPENDENT_BINS))
    if count < FEWEST_WINDOWS:
        return BandSteadiness()
    length = samples // count
    every = np.asarray(np.fft.rfftfreq(length, 1.0 / rate), np.float64)
    bins = (every >= band[0]) & (every <= band[1])
    G = inverse(every[bins])
    power = np.array([_power(run, live, first + i * length, length, bins, G) for i in range(count)])
    correlation = float(np.exp(-length / rate / decay)) if decay > 0 else 0.0
    least = np.full(len(components), 2.0 * np.log(MATERIAL_LEVEL) / MATERIAL_CHANGE)
    level = np.log(np.maximum(power, np.finfo(float).tiny))
    bins_of_window = width * length / rate
    changed = unsteady(level.astype(complex), least, correlation) | _has_burst(power, bins_of_window)
    changed &= bins_of_window >= FEWEST_BINS
    if not changed.any():
        return BandSteadiness()
    names = tuple(name for name, bad in zip(components, changed, strict=True) if bad)
    return BandSteadiness(names, _describe(np.sqrt(power), level, changed, components, first / rate, length / rate))


def _has_burst(power: Array, bins: Array) -> NDArray[np.bool_]:
    """Return in which components (m,) a few windows of power (w, m) raise the rms of all beyond chance."""
    usual = np.maximum(np.median(power, axis=0), np.finfo(float).tiny)
    scatter = np.sqrt(TAPERED_BINS / np.maximum(bins, 1.0))
    rises = np.log(power.max(axis=0) / usual) > BURST * scatter
    return np.asarray(rises & (power.mean(axis=0) > MATERIAL_LEVEL**2 * usual))


def statistical_width(power: Array, frequency: Array) -> Array:
    """Return the bandwidths [Hz] (m,) of white loads whose power over a record scatters as that of densities (k, m)."""
    square = np.maximum(np.sum(power**2, axis=0), np.finfo(float).tiny)
    return np.asarray(np.sum(power, axis=0) ** 2 / square * float(np.mean(np.diff(frequency))))


def _power(
    run: Run, names: tuple[str, ...], start: int, length: int, bins: NDArray[np.bool_], G: ComplexArray
) -> Array:
    """Return the mean squares (m,) of the loads of a window, tapered by a raised cosine, within the bins."""
    taper = 1.0 - np.cos(2.0 * np.pi / length * np.arange(length))
    volts = read_channels(run, names, start, start + length)
    spectrum = np.fft.rfft((volts - volts.mean(axis=0)) * taper[:, None], axis=0)[bins]
    loads = np.einsum("kmc,kc->km", G, spectrum)
    return np.asarray(2.0 * np.sum(np.abs(loads) ** 2, axis=0) / (length * np.sum(taper**2)))


def _describe(
    rms: Array, level: Array, changed: NDArray[np.bool_], components: tuple[str, ...], start: float, duration: float
) -> str:
    """Say when the level of the component that changes most does so, for rms (w, m) of windows of a `duration` [s]."""
    wander = np.abs(np.cumsum(level - level.mean(axis=0), axis=0))
    j = int(np.argmax(np.where(changed, wander.max(axis=0), -1.0)))
    at = 1 + int(np.argmax(wander[:-1, j]))
    before, after = (float(np.sqrt(np.mean(part**2))) for part in np.split(rms[:, j], [at]))
    low, high = int(np.argmin(rms[:, j])), int(np.argmax(rms[:, j]))
    unit = UNIT_OF[components[j]]
    times = [f"{start + (i + 0.5) * duration:.3g} s" for i in (low, high)]
    factor, windows = f"{after / before:.3g} times the rms", f"windows of {duration:.2g} s"
    least, most = (f"{rms[i, j]:.3g} {unit} (at {time})" for i, time in zip((low, high), times, strict=True))
    since = f"from {start + at * duration:.3g} s on {components[j]} has {factor}"
    return f"the loads are not steady: {since}, which in {windows} goes from {least} to {most}"
