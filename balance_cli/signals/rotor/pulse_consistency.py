"""Whether the 1/rev pulses of a record agree with its stated speed, its length and the lines of its channels."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len, rfft

from balance_cli.campaign.recording.attribute_checks import RPM_PER_HERTZ
from balance_cli.campaign.recording.run import Run, read_channel_rows
from balance_cli.io.errors import UserError
from balance_cli.signals.amplitude_spectrum import normalize_channels
from balance_cli.signals.rotor.pulse_repair import repair_pulses
from balance_cli.signals.rotor.spectral_floor import local_maxima, spectral_floor
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]

NOMINAL_TOLERANCE = 0.12
"""Share by which the pulse rate may depart from the nominal `rotor_speed` before it is examined."""
RATIO_TOLERANCE = 0.03
"""Share by which a ratio of speeds may miss a whole number and still be one (the rotor speed itself varies)."""
MAX_PULSES_PER_REVOLUTION = 1024
SPECTRUM_REVOLUTIONS = 200
"""Revolutions of the spectrum that shows the rotor's lines: they tell 1 % of speed from 1/rev on, and the speed hardly
moves within them."""
STRONGEST_LINES = 12
"""Lines of each spectrum that are compared with the pulses."""
LINE_TO_FLOOR = 300.0
"""Power of a line over the median around it from which it counts: noise reaches 20 in 10000 samples."""
SCALES = np.linspace(0.8, 1.25, 4501)
"""Ratios of the line spacing to the pulse rate that are tried: a sample rate off by up to 25 %."""
FEWEST_LINES = 5
"""Fewer lines may lie on the multiples of any spacing by accident."""
SHARE_ON_PULSES = 0.2
"""Share of the lines on multiples of the pulse rate below which the record may contradict its pulses."""
SHARE_ON_COMB = 0.8
"""Share of the lines that another spacing must explain before it does."""
SHARE_ON_ROTOR = 0.6
"""Share of the lines that a multiple of the pulse rate must explain where none lies between: mains have lines, too."""
LARGEST_PAIR = 0.7
"""Of the time to the next pair, within which two pulses are a pair: equal distances are those of twice the speed."""
UNCOVERED_SHARE = 0.2
"""Share of a record without pulses at either end that is examined: edges of a few revolutions are usual."""


def pulse_faults(run: Run, declared_speed: float | None = None) -> Iterator[UserError]:
    """Faults of the pulses against the nominal speed of the run and against the lines of its channels.

    `declared_speed` [Hz] is that of the rotor in the geometry. Speeds that differ are a fault, with the ratio named
    where it is a whole one. So are pulses that leave much of the record out, and channels whose lines form a comb of
    another spacing than the pulse rate. A record at rest, or without pulses, has none.
    """
    if run.pulse_times is None or len(run.pulse_times) < 3 or not run.rotor_speed:
        return
    rate = 1.0 / float(np.median(np.diff(run.pulse_times)))
    fault = paired_pulses(run.pulse_times, run.rotor_speed) or speed_fault(rate, run.rotor_speed)
    if fault:
        yield UserError(fault, run.file, "rotor/pulse_times", "Correct the pulses or `rotor_speed`")
        return
    contradiction = line_spacing(run)
    if contradiction is not None:
        rate, spacing = contradiction
        yield UserError(
            f"the channels have their lines at multiples of {spacing:.5g} Hz, the pulses come at {rate:.5g} Hz",
            run.file,
            "rotor/pulse_times",
            "Check `sample_rate`, and whether there is one pulse in each revolution",
        )
        return
    fault = miscounted_revolutions(run, rate, declared_speed) if declared_speed else ""
    if fault:
        remedy = "Give one pulse for each revolution, or the speed of this rotor as `rotor.speed` of the geometry"
        yield UserError(fault, run.file, "rotor/pulse_times", remedy)
        return
    fault = coverage_fault(run)
    if fault:
        yield UserError(fault, run.file, "rotor/pulse_times", "Check `sample_rate`, or cut the record")


def paired_pulses(times: Array, speed: float) -> str:
    """Return that pulses (n,) [s] come in pairs at a nominal speed [Hz]: a contact bounces; empty where they do not."""
    within, between = sorted((float(np.median(np.diff(times)[k::2])) for k in (0, 1)), key=abs)
    is_speed = abs((within + between) * speed - 1.0) <= NOMINAL_TOLERANCE
    if not is_speed or within > LARGEST_PAIR * between:
        return ""
    pairs = f"the pulses come in pairs {1e3 * within:.3g} ms apart, one in each revolution"
    return f"{pairs}: two marks, or a contact that bounces"


def speed_fault(rate: float, speed: float) -> str:
    """Return what is wrong between a pulse rate and a nominal speed, both [Hz]; empty where they agree."""
    ratio = rate / speed
    if abs(ratio - 1.0) <= NOMINAL_TOLERANCE:
        return ""
    if abs(ratio * RPM_PER_HERTZ - 1.0) <= NOMINAL_TOLERANCE:
        return f"`rotor_speed` is {speed:g} Hz, the pulses come at {rate:.4g} Hz: a speed in 1/min was given as Hz"
    per_revolution, per_pulse = round(ratio), round(1.0 / ratio)
    if 2 <= per_revolution <= MAX_PULSES_PER_REVOLUTION and abs(ratio / per_revolution - 1.0) <= RATIO_TOLERANCE:
        return f"the pulses come at {rate:.4g} Hz, {per_revolution} times in each revolution of {speed:g} Hz"
    if per_pulse >= 2 and abs(ratio * per_pulse - 1.0) <= RATIO_TOLERANCE:
        return f"the pulses come at {rate:.4g} Hz, once in {per_pulse} revolutions of {speed:g} Hz"
    return f"the pulses come at {rate:.4g} Hz, `rotor_speed` is {speed:g} Hz"


def miscounted_revolutions(run: Run, rate: float, declared_speed: float) -> str:
    """Return why pulses at a rate [Hz], which the file calls the rotor speed, are not one in each revolution.

    Both must say so: the speed that the geometry declares, and the lines of the channels. Where pulses are too few, no
    line lies between the multiples of the declared speed; every rotor has a line at its own. Where they are too many,
    most lines lie between the multiples of their rate. Empty where the pulses are in order.
    """
    assert run.pulse_times is not None
    ratio = declared_speed / rate
    factors = _whole_factors(ratio)
    if not factors:
        return ""
    pulses = _middle_pulses(run.pulse_times, max(1.0, 1.0 / ratio))
    lines, weight, resolution = _strongest_lines(run, float(pulses[0]), float(pulses[-1]))
    rate, spread = (len(pulses) - 1) / float(pulses[-1] - pulses[0]), _speed_spread(pulses)
    if len(lines) < FEWEST_LINES or min(factors[0], 1.0) * rate < 8.0 * resolution:
        return ""
    shares = [_share_on_comb(lines, weight, factor * rate, resolution, spread) for factor in factors]
    factor, of_rotor = factors[int(np.argmax(shares))], max(shares)
    of_pulses = _share_on_comb(lines, weight, rate, resolution, spread)
    rotor, declared = f"{factor * rate:.4g} Hz", f"of the rotor, whose declared speed is {declared_speed:g} Hz"
    if factor > 1.0 and of_rotor >= max(SHARE_ON_ROTOR, of_pulses):
        what = f"have lines at multiples of {rotor}, not between: once in {factor:.0f} revolutions {declared}"
    elif factor < 1.0 and of_rotor >= SHARE_ON_COMB and of_pulses < SHARE_ON_ROTOR:
        what = f"have lines between, at multiples of {rotor}: {1.0 / factor:.0f} times in each revolution {declared}"
    else:
        return ""
    return f"the pulses come at {rate:.4g} Hz, and the channels {what}"


def _whole_factors(ratio: float) -> list[float]:
    """Whole numbers from two on, or one over such, in rising order, that a ratio to a nominal speed may be."""
    if ratio > 1.0:
        nearest = round(ratio)
        return [float(nearest)] if nearest > 1 and abs(ratio / nearest - 1.0) <= NOMINAL_TOLERANCE else []
    least = math.ceil(1.0 / (ratio * (1.0 + NOMINAL_TOLERANCE)))
    most = math.floor(1.0 / (ratio * (1.0 - NOMINAL_TOLERANCE)))
    return [1.0 / count for count in range(max(2, least), min(most, MAX_PULSES_PER_REVOLUTION) + 1)][::-1]


def _middle_pulses(pulses: Array, pulses_per_revolution: float = 1.0) -> Array:
    """Return the pulses in the middle of a record."""
    middle, half = len(pulses) // 2, int(SPECTRUM_REVOLUTIONS * pulses_per_revolution) // 2
    return pulses[max(0, middle - half) : middle + half + 1]


def _with_missing_pulses(pulses: Array) -> Array:
    """Return the pulses with a time for each that is missing; as they are where they cannot be repaired."""
    try:
        repaired = repair_pulses(pulses)
    except UserError:
        return pulses
    return np.interp(np.arange(repaired.revolutions[-1] + 1), repaired.revolutions, repaired.times)


def coverage_fault(run: Run) -> str:
    """Return what is wrong between the times of the pulses and the length of the record; empty where nothing is."""
    assert run.pulse_times is not None
    duration = run.samples / sample_rate(run)
    first, last = float(run.pulse_times[0]), float(run.pulse_times[-1])
    longest_interval = float(np.diff(run.pulse_times).max())
    # The revolutions at either end are not whole: of a record of few of them they are a large share.
    usual = max(UNCOVERED_SHARE * duration, longest_interval)
    covered = first <= usual and duration - last <= usual
    if covered and last - duration <= longest_interval:
        return ""
    return f"the pulses cover {first:.4g} to {last:.4g} s of a record of {duration:.4g} s at {sample_rate(run):g} Hz"


def line_spacing(run: Run) -> tuple[float, float] | None:
    """Return the pulse rate and the spacing of the lines of the channels [Hz] where they contradict, else None.

    Both are taken in the middle of the pulses; those that are missing count.
    """
    assert run.pulse_times is not None
    pulses = _with_missing_pulses(_middle_pulses(run.pulse_times))
    rate = (len(pulses) - 1) / float(pulses[-1] - pulses[0])
    spread = _speed_spread(pulses)
    lines, weight, resolution = _strongest_lines(run, float(pulses[0]), float(pulses[-1]))
    if len(lines) < FEWEST_LINES or rate < 8.0 * resolution:
        return None
    if _share_on_comb(lines, weight, rate, resolution, spread) > SHARE_ON_PULSES:
        return None
    shares = np.array([_share_on_comb(lines, weight, scale * rate, resolution, spread) for scale in SCALES])
    best = int(np.argmax(shares))
    return (rate, float(SCALES[best] * rate)) if shares[best] >= SHARE_ON_COMB else None


def _speed_spread(pulses: Array) -> float:
    """Return half of the range of the speed over the pulses, relative to the speed, jitter of the pulses averaged."""
    width = max(1, len(pulses) // 10)
    speed = width / (pulses[width:] - pulses[:-width])
    return float((speed.max() - speed.min()) / (speed.max() + speed.min()))


def _share_on_comb(lines: Array, weight: Array, spacing: float, resolution: float, spread: float) -> float:
    """Return the share of the lines, by weight, that lie within the resolution of a multiple of the spacing.

    A line may be off by the relative `spread` of the speed, too.
    """
    order = np.round(lines / spacing)
    on_comb = (order > 0) & (np.abs(lines - order * spacing) <= 1.25 * resolution + spread * lines)
    return float(weight[on_comb].sum() / weight.sum())


def _strongest_lines(run: Run, start: float, stop: float) -> tuple[Array, Array, float]:
    """Return the frequencies [Hz] of the strongest lines of all channels, their weight, and the resolution [Hz].

    Samples from `start` to `stop` [s]. The weight is the logarithm of the power over the floor, so that no single line
    decides.
    """
    first, last = int(start * sample_rate(run)), min(int(stop * sample_rate(run)), run.samples)
    samples = last - first
    if samples < 64:
        return np.zeros(0), np.zeros(0), 1.0
    values = read_channel_rows(run, run.channel_names, first, last)
    if not np.isfinite(values).all():
        values = np.where(np.isfinite(values), values, 0.0)
    windowed, _ = normalize_channels(values)
    windowed *= np.hanning(samples).astype(np.float32)
    padded = next_fast_len(samples, real=True)  # a large prime factor takes five times as long
    spectrum = rfft(windowed, padded, axis=1, overwrite_x=True)
    power = spectrum.real**2 + spectrum.imag**2
    relative = np.max(power / np.maximum(spectral_floor(power), np.finfo(np.float32).tiny), axis=0)
    relative[:3] = 0.0
    peak = local_maxima(relative) & (relative > LINE_TO_FLOOR)
    index = np.flatnonzero(peak)
    index = index[np.argsort(-relative[index])][:STRONGEST_LINES]
    frequency, resolution = index * (sample_rate(run) / padded), sample_rate(run) / samples
    return np.asarray(frequency), np.asarray(np.log(relative[index])), float(resolution)
