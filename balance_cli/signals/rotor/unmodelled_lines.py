"""Lines of a record beside its reduced harmonics: higher harmonics of the rotor, and tones that do not turn with it.

Two spectra show them. Over azimuth a harmonic of the rotor is one line, however its speed varies; over time a tone of
constant frequency (mains, a pump, another rotor) is one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.record_spectrum import RecordSpectrum, line_powers
from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.signals.rotor.spectral_floor import block_size, local_maxima, spectral_floor

Array = NDArray[np.float64]
Singles = NDArray[np.float32]

FEWEST_SAMPLES = 256
"""With fewer samples a line does not stand out of a floor that is the median of neighboring bins."""
LINE_TO_FLOOR = 1000.0
"""Power of a line over the median around it: noise of a million independent lines reaches 40, resonances do not rise
so far within the width of the median."""
MATERIAL_SHARE = 0.05
"""Amplitude of a line, relative to the largest harmonic of the same channel, from which it is reported."""
SIDEBAND_BINS = 3.5
"""Bins beside a harmonic, beyond the range of its frequency, within which a line over time belongs to it: the lobe of
the window ends at three."""
MOST_LINES = 6
"""Lines that are named, the strongest first."""
BELOW_NYQUIST = 0.9
TINY = float(np.finfo(np.float32).tiny)
"""Least divisor: a channel without a signal has no lines."""
RESONANCE_GRID = 33
"""Frequencies across the width of the median at which the response is compared with itself at a line."""


@dataclass(frozen=True)
class UnmodelledLine:
    """A line at `frequency` [Hz], `order` times the rotor speed, strongest in `channel` with `amplitude` [V].

    `turns_with_rotor`: a harmonic of the rotor beyond those that were reduced.
    """

    frequency: float
    order: float
    channel: str
    amplitude: float
    turns_with_rotor: bool

    @property
    def description(self) -> str:
        """The line in words."""
        where = f"{self.order:.0f}/rev" if self.turns_with_rotor else f"{self.order:.2f} per revolution"
        return f"line at {self.frequency:.2f} Hz ({where}), strongest in {self.channel}"

    def explain(self, n: int, regressed: int) -> str:
        """Return the line in words, and what it does to harmonics 1 to `n` of a regression of `regressed` harmonics."""
        if not self.turns_with_rotor:
            return f"{self.description}: no harmonic describes it, it may leak into the harmonics beside it"
        if self.order > regressed:
            return f"{self.description}: the regression ends at {regressed}/rev, it may leak"
        return f"{self.description}: it is in the regression, harmonics 1 to {n} are free of it"


PowerGain = Callable[[Array], Array]


def unmodelled_lines(
    spectrum: RecordSpectrum,
    azimuth: Azimuth,
    n: int,
    power_gain: PowerGain | None = None,
    other_rotors: Sequence[Azimuth] = (),
    over_time: RecordSpectrum | None = None,
) -> tuple[UnmodelledLine, ...]:
    """Return the lines in the spectrum of a record between its pulses that harmonics 0 to `n` do not contain.

    `power_gain` returns |T|^2 (k, c, m) of the channels at frequencies (k,) [Hz]: a light mode that gusts excite is as
    narrow as a line in a record of a few of its time constants, and is not one as far as the response explains it.
    `other_rotors` are those whose lines were taken out of the run: what is left beside their harmonics is known.
    `over_time` is the spectrum of the same samples that is searched for tones, by default `spectrum`: of what the
    harmonics leave where the speed varies, which makes bands of them.
    """
    samples, rate = spectrum.rows.shape[1], spectrum.sample_rate
    if samples < FEWEST_SAMPLES:
        return ()
    turns = azimuth.of_samples(rate, spectrum.first, spectrum.first + samples)[0] / (2 * np.pi)
    per_turn = (samples - 1) / float(turns[-1] - turns[0])
    speed = rate / per_turn
    order, over_azimuth = line_powers(_resample_evenly(turns, spectrum.rows), per_turn)
    tones = spectrum if over_time is None else over_time
    spectra = _Spectra(spectrum.names, order * speed, over_azimuth, tones.frequency, tones.power)
    largest = _largest_harmonic(order, over_azimuth, n)
    time = (spectrum.first + np.array([0.0, samples - 1.0])) / rate
    ranges = [_speed_range(item, time) for item in (azimuth, *other_rotors)]
    highest = BELOW_NYQUIST * 0.5 * per_turn
    names, scale = spectrum.names, spectrum.scale
    rotor_lines = [
        UnmodelledLine(o * speed, round(o), names[c], a * scale[c], True)
        for o, c, a in _peaks(order, over_azimuth, largest)
        if n + 0.5 < o < highest and abs(o - round(o)) < 0.05
    ]
    margin = SIDEBAND_BINS * spectrum.frequency[1]
    fixed_lines = [
        UnmodelledLine(f, f / speed, names[c], a * tones.scale[c], False)
        for f, c, a in _peaks(tones.frequency, tones.power, largest * np.square(scale / tones.scale, dtype=np.float32))
        if f < highest * speed and not any(_beside_harmonic(f, *span, margin) for span in ranges)
    ]
    found = sorted(rotor_lines + fixed_lines, key=lambda line: -line.amplitude)
    if power_gain is not None:
        found = [line for line in found if not _is_resonance(line, spectra, power_gain)]
    return tuple(found[:MOST_LINES])


@dataclass(frozen=True)
class _Spectra:
    """Powers (c, k) of lines of the named channels over azimuth, at `turning` [Hz] of the mean speed, and over time, at
    `fixed`, relative to the square of the largest value of each channel.
    """

    names: tuple[str, ...]
    turning: Array
    over_azimuth: Singles
    fixed: Array
    over_time: Singles


def _is_resonance(line: UnmodelledLine, spectra: _Spectra, power_gain: PowerGain) -> bool:
    """Whether the response explains how far a line stands out."""
    if line.turns_with_rotor:
        frequency, power = spectra.turning, spectra.over_azimuth
    else:
        frequency, power = spectra.fixed, spectra.over_time
    width = frequency[1] * block_size(len(frequency))
    clearance = _clearance(line, frequency, power[[spectra.names.index(line.channel)]])
    return clearance <= LINE_TO_FLOOR * _resonance(line, spectra.names, width, power_gain)


def _clearance(line: UnmodelledLine, frequency: Array, power: Singles) -> float:
    """Return the power of a line over the floor of its channel, whose spectrum is `power` (1, k)."""
    at = int(np.argmin(np.abs(frequency - line.frequency)))
    floor = float(spectral_floor(power, np.array([at]))[0, 0])
    return float(power[0, max(0, at - 1) : at + 2].max()) / max(floor, TINY)


def _resonance(line: UnmodelledLine, names: tuple[str, ...], width: float, power_gain: PowerGain) -> float:
    """Return by how much the response to the load that is amplified most exceeds its median across `width` [Hz]."""
    grid = np.abs(line.frequency + np.linspace(-width, width, RESONANCE_GRID))
    gain = power_gain(np.append(np.maximum(grid, 0.1 * line.frequency), line.frequency))[:, names.index(line.channel)]
    median = np.median(gain[:-1], axis=0)
    driven = median > 0
    return float(max(1.0, np.max(gain[-1, driven] / median[driven], initial=1.0)))


def _speed_range(azimuth: Azimuth, time: Array) -> tuple[float, float]:
    """Return the slowest and the fastest rotor speed [Hz] in the record."""
    first, last = max(time[0], azimuth.first), min(time[-1], azimuth.last)
    speed = azimuth.speed(np.linspace(first, last, 1024))
    return float(np.min(speed)), float(np.max(speed))


def _beside_harmonic(frequency: float, slowest: float, fastest: float, margin: float) -> bool:
    """Return whether some harmonic of the rotor passes within the margin [Hz] of a frequency [Hz]; so does the mean."""
    order = np.arange(0, int(frequency / slowest) + 2)
    return bool(np.any((order * slowest - margin < frequency) & (frequency < order * fastest + margin)))


def _resample_evenly(turns: Array, channels: Singles) -> Singles:
    """Return the channels (c, m) at as many even steps of azimuth, by linear interpolation."""
    last = len(turns) - 1
    position = np.interp(np.linspace(turns[0], turns[-1], last + 1), turns, np.arange(last + 1))
    index = np.minimum(position.astype(np.int64), last - 1)
    below = np.take(channels, index, axis=1, mode="clip")
    step = np.take(channels, index + 1, axis=1, mode="clip")
    step -= below
    step *= (position - index).astype(np.float32)
    step += below
    return np.asarray(step)


def _largest_harmonic(order: Array, power: Singles, n: int) -> Singles:
    """Return the power (c,) of the largest of harmonics 1 to n of each channel."""
    index = np.clip(np.round(np.arange(1, n + 1) / order[1]).astype(int), 0, len(order) - 1)
    return np.asarray(power[:, index].max(axis=1, initial=0.0))


def _peaks(frequency: Array, power: Singles, largest: Singles) -> list[tuple[float, int, float]]:
    """Return frequency, channel and amplitude of the lines that stand out of their surroundings and matter."""
    share = power * (1.0 / np.maximum(largest, TINY))[:, None]
    material = np.flatnonzero(share.max(axis=0, initial=0.0) > MATERIAL_SHARE**2)
    clear = power[:, material] > LINE_TO_FLOOR * np.maximum(spectral_floor(power, material), TINY)
    of_line = np.where(clear, share[:, material], 0.0)
    strongest = np.zeros(len(frequency))
    strongest[material] = of_line.max(axis=0, initial=0.0)
    top = local_maxima(strongest)[material] & (strongest[material] > MATERIAL_SHARE**2)
    return [
        (float(frequency[i]), int(np.argmax(shares)), float(np.sqrt(power[np.argmax(shares), i])))
        for i, shares in zip(material[top], of_line.T[top], strict=True)
    ]
