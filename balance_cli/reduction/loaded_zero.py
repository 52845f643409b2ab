"""Whether a record given as the zero was made under load: its channels then fluctuate as those of a wind run do.

A rotor under load leaves lines at its harmonics in all channels. Without load, a hub that turns leaves 1/rev
(unbalance), and whatever else is there without wind (noise, mains, fans, modes) is in a wind run as well.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from balance_cli.campaign.recording.run import Run, read_channels
from balance_cli.signals.amplitude_spectrum import fast_length

Array = NDArray[np.float64]

BANDS = 4
"""Bands for each multiple of the rotor speed: those about a harmonic hold it where the speed departs by 1 %."""
HARMONICS = 12
"""Highest harmonic that is looked at: the second blade harmonic of six blades."""
FEWEST_REVOLUTIONS = 2 * BANDS
"""Of a record, so that a band has two lines of its spectrum."""
MOST_SAMPLES = 2**18
"""Samples of a record that are transformed: a minute at 4 kHz."""
PROMINENCE = 4.0
"""Power over that of a wind run between its harmonics, from which it counts: the power of noise in a band of few lines
scatters by less, and a record with twice the noise is no loaded one."""
LOADED_SHARE = 0.04
"""Of the power at the harmonics of the wind run: a fifth of its amplitudes. With other phases of the same loads the
modes of five rigs leave 0.05 and more of the power (rig D 0.014); records without load had none."""


def describe_loaded_zero(zero: Run, record: Run) -> str:
    """Return how far the channels of a zero run fluctuate as in a wind or check `record`; empty where they do not.

    Compared is what each has beyond four times the power of the record between its harmonics, above 1.5/rev, with the
    power of the record at harmonics 2 to 12; the median over the channels decides in which the record has such lines.
    Empty as well where no channel has them, where the record tells no rotor speed, and for less than 8 revolutions.
    """
    speed = rotor_rate(record)
    rates = [run.sample_rate for run in (zero, record) if run.sample_rate]
    names = [name for name in zero.channel_names if name in record.channel_names]
    if speed <= 0.0 or len(rates) < 2 or not names:
        return ""
    harmonics = min(HARMONICS, int(0.5 * min(rates) / speed) - 1)
    used = [min(run.samples, MOST_SAMPLES) for run in (zero, record)]
    enough = all(n * speed >= FEWEST_REVOLUTIONS * rate for n, rate in zip(used, rates, strict=True))
    if harmonics < 2 or not enough:
        return ""
    quiet, loaded = (_band_powers(run, names, speed, harmonics) for run in (zero, record))
    at = BANDS * np.arange(2, harmonics + 1)
    beside = loaded.copy()
    beside[at] = 0.5 * (loaded[at - BANDS // 2] + loaded[at + BANDS // 2])
    lines = np.sum(loaded[at] - beside[at], axis=0)
    lowest = int(1.5 * BANDS * max(speed, rotor_rate(zero)) / speed)
    excess = np.sum(np.maximum(quiet - PROMINENCE * beside, 0.0)[lowest:], axis=0)
    telling = (lines > PROMINENCE * np.sum(beside[at], axis=0)) & np.isfinite(excess)
    share = float(np.median(excess[telling] / lines[telling])) if telling.any() else 0.0
    if share < LOADED_SHARE:
        return ""
    return f"its channels fluctuate as under load, with {np.sqrt(share):.2g} of the amplitudes of {record.name}"


def rotor_rate(run: Run) -> float:
    """Return the rotor speed [Hz] of a run by its pulses, or as stated where it has none; zero at rest."""
    if run.pulse_times is None or len(run.pulse_times) < 2:
        return run.rotor_speed
    period = float(np.median(np.diff(run.pulse_times)))
    return 1.0 / period if period > 0.0 else 0.0


def _band_powers(run: Run, names: Sequence[str], speed: float, harmonics: int) -> Array:
    """Return the power [V^2] of the channels (c,) of a run in bands (b, c) about multiples of a quarter of `speed`.

    Through a Hann window, without the mean.
    """
    n, rate = fast_length(min(run.samples, MOST_SAMPLES)), run.sample_rate or 0.0
    samples = read_channels(run, list(names), 0, n)
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(n) / n)
    power = np.abs(rfft((samples - samples.mean(axis=0)) * window[:, None], axis=0)) ** 2
    band = np.rint(BANDS * np.fft.rfftfreq(n, 1.0 / rate) / speed).astype(np.int64)
    first = np.searchsorted(band, np.arange(BANDS * (harmonics + 1)))
    return np.asarray(np.add.reduceat(power, first, axis=0)[:-1] * (2.0 / (n * np.sum(window**2))))
