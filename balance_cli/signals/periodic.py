"""Lines of periodic records: whole steady periods, no taper, noise from the scatter between periods.

Pintelon and Schoukens, System Identification: A Frequency Domain Approach, 2nd ed. (2012), sections 2.6 and 10.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from balance_cli.campaign.recording.run import Run
from balance_cli.io.errors import UserError
from balance_cli.signals import periodic_transient as transient
from balance_cli.signals.covariance_pooling import inverse_bias_factor, variance_floor
from balance_cli.signals.line_covariance import LineCovariance, pool_scatter
from balance_cli.signals.periodic_transient import SteadyStart, find_steady_start
from balance_cli.signals.quantization import COMPARED_SAMPLES, quantization_steps, repeated_variance
from balance_cli.signals.run_samples import (
    channel_columns,
    load_columns,
    measured_components,
    read_samples,
    run_error,
    sample_rate,
)
from balance_cli.signals.run_spectrum import RunSpectrum
from balance_cli.signals.transient_decay import (
    FEWEST_PERIODS,
    LEAST_INFORMATION,
    deviations_from_decay,
    information_beside_transient,
    transient_covariance,
)
from balance_cli.signals.waveform_types import AnalysisWindow

__all__ = [
    "PeriodicRecord",
    "has_whole_periods",
    "inverse_bias_factor",
    "periodic_record",
    "periodic_spectrum",
    "samples_per_period",
]

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Counts = NDArray[np.intp]

LEAST_LINE_SIGNAL_TO_NOISE = 10.0
"""Amplitude of a load over its noise, from which a line is used: the bias of a ratio Y / U, exp(-100), is then nil."""
LEAST_SHARE_OF_STRONGEST = 0.01
"""Amplitude of a load over that of its strongest line; less is a side effect of the excitation of other lines."""
ROUNDING = 16 * np.finfo(float).eps
"""Amplitude of a line over the largest sample, up to which it may be the rounding of the transform of a constant."""
LEAST_SHARE_OF_LINES = 0.1
"""Share of the lines from which a load that is not declared as excited is nevertheless an input."""
NOISE_LINES = 40
"""Lines beyond the excited band that are kept, for the noise to be pooled over."""


@dataclass(frozen=True)
class PeriodicRecord:
    """The lines of a periodic run, and the periods from which they are computed.

    `period` [s] is the length of a period, a multiple of the declared one where that is not a whole number of samples;
    the record has `periods` of them. `first` (k,) is the first steady period of each line (0 is that of the record).
    From `start` to `stop` [s] every line is steady. `steady` says whether a test found so; otherwise the last two
    periods were used because there are no more. `rings` says whether the transient in them takes most of the
    information of the lines; of a single load, a local model of the whole record then says more.
    """

    spectrum: RunSpectrum
    period: float
    periods: int
    first: Counts
    start: float
    stop: float
    steady: bool
    rings: bool


def periodic_spectrum(run: Run, channel_names: Sequence[str], band: tuple[float, float] = (0.0, np.inf)) -> RunSpectrum:
    """Return the lines of a periodic run that were excited within `band` [Hz]; see `periodic_record`."""
    return periodic_record(run, channel_names, band).spectrum


def periodic_record(
    run: Run, channel_names: Sequence[str], band: tuple[float, float] = (0.0, np.inf)
) -> PeriodicRecord:
    """Average the whole periods of a periodic run, without those of the start transient.

    The last period ends with the record. Spectra are amplitudes, `x(t) = Re sum X exp(+j 2 pi f t)`. The covariance is
    that of the mean over the steady periods, pooled over neighboring lines; a line with improbably large scatter has
    its own, larger one. `spectrum.dof` belongs to the pooled covariance: the inverse must be multiplied by
    `inverse_bias_factor(dof, n)`, n = channels + components. Raises UserError where the run has no period, fewer than
    two whole periods, or no line that repeats.
    """
    c, samples = len(channel_names), samples_per_period(run)
    spectra, number, components = _period_spectra(run, channel_names, samples)
    frequency = number * sample_rate(run) / samples
    start = find_steady_start(spectra, c)
    averaged = len(spectra) - float(np.median(start.first))
    floor = variance_floor(spectra, c) + averaged * _rounding_variance(run, channel_names, components, spectra, samples)
    mean, noise = _mean_and_noise(spectra, start.first, floor)
    total = noise.scaled(1.0 + start.bias)
    noise, left, information = _beside_transient(spectra, start, mean, (noise, floor), c)
    variance = total.variance if left is None else total.variance + np.einsum("kss->ks", left).real
    excited = _excited_lines(mean, variance, len(components))
    selected = _select_lines(run, excited, frequency, band, spectra[:, :, c:])
    transient.require_like_loads(run, spectra[:, selected, c:], int(start.first.max()))
    inputs = _input_columns(components, excited[selected], run.excited)
    signals = np.array([*range(c), *(c + i for i in inputs)])
    covariance = total.at(selected, signals)
    lines = RunSpectrum(
        run=run.name,
        channel_names=tuple(channel_names),
        components=tuple(components[i] for i in inputs),
        frequency=frequency[selected],
        channels=mean[selected, :c],
        loads=mean[selected][:, signals[c:]],
        covariance=covariance if left is None else covariance + left[selected][:, signals[:, None], signals],
        dof=total.dof,
        rotor_speed=run.rotor_speed,
        level=run.level,
        window=_analysis_window(
            run, len(spectra), samples, start.first[selected], noise.at(selected, signals), noise.dof
        ),
        periods=spectra[:, selected, :c],
    )
    steady = bool(np.all(start.steady[selected]))
    rings = len(inputs) == 1 and information < LEAST_INFORMATION
    return _periodic_record_of(run, lines, spectra, samples, start.first[selected], steady, rings)


def has_whole_periods(run: Run) -> bool:
    """Whether the run declares a period, and has at least two of a whole number of samples."""
    try:
        return run.period is not None and samples_per_period(run) > 0
    except UserError:
        return False


def samples_per_period(run: Run) -> int:
    """Return the samples in the shortest multiple of the declared period that is a whole number of samples.

    It is one to within 0.01 samples over the record. Raises UserError where the run declares no period, or has fewer
    than two such multiples.
    """
    if run.period is None:
        raise run_error(run, "there is no `period`", "Select an estimator for records that do not repeat")
    exact = run.period * sample_rate(run)
    for multiple in range(1, int(run.samples / (2.0 * exact)) + 1):
        samples = round(multiple * exact)
        if abs(samples - multiple * exact) * (run.samples / samples) < 0.01:
            return samples
    raise run_error(
        run,
        f"the record does not hold two periods of a whole number of samples ({exact:g} each)",
        "Record more periods, or select an estimator for records that do not repeat",
        "attribute `period`",
    )


def _period_spectra(
    run: Run, channel_names: Sequence[str], samples: int
) -> tuple[ComplexArray, NDArray[np.intp], tuple[str, ...]]:
    """Amplitudes (P, K, c+u) of all whole periods at the lines around the excited ones, their bins (K,), components."""
    periods = run.samples // samples
    offset = run.samples - periods * samples
    channel_columns(run, channel_names)
    c, last = len(channel_names), (samples + 1) // 2
    amplitudes = np.empty((periods, c + 6, last - 1), complex)
    largest_loads = np.zeros((1, 6))
    for p in range(periods):
        channels, loads = read_samples(run, channel_names, offset + p * samples, offset + (p + 1) * samples)
        largest_loads = np.maximum(largest_loads, np.abs(loads).max(axis=0))
        # Signals by rows are transformed several at a time.
        spectrum = rfft(np.concatenate([channels.T, loads.T]), axis=1, overwrite_x=True)
        np.multiply(spectrum[:, 1:last], 2.0 / samples, out=amplitudes[p])
    components = measured_components(run, largest_loads)
    signals = [*range(c), *(c + column for column in load_columns(components))]
    load_size = np.abs(amplitudes[periods // 2 :, signals[c:]].mean(axis=0))
    largest = load_size.max(axis=1, initial=0.0)[:, None]
    least = np.maximum(LEAST_SHARE_OF_STRONGEST * largest, ROUNDING * largest_loads.T[load_columns(components)])
    strong = np.flatnonzero(np.any(load_size > least, axis=0))
    if not strong.size:
        fault = f"no load varies within a period, which is {samples} samples"
        raise run_error(run, fault, "Correct `sample_rate` and `period`", "loads")
    begin, end = max(strong[0] - 2, 0), min(strong[-1] + NOISE_LINES, last - 1)
    spectra = np.ascontiguousarray(amplitudes[:, signals, begin:end].swapaxes(1, 2))
    return spectra, np.arange(begin, end) + 1, components


def _rounding_variance(
    run: Run, channel_names: Sequence[str], components: Sequence[str], spectra: ComplexArray, samples: int
) -> Array:
    """Variance (n,) of a line by rounding that repeats from period to period, and does not average out."""
    begin = run.samples - samples
    channels, loads = read_samples(run, channel_names, begin, begin + min(samples, COMPARED_SAMPLES))
    steps = quantization_steps(np.hstack([channels, loads[:, load_columns(components)]]))
    if not steps.any():
        return steps
    power = np.abs(spectra[-1] - spectra[-2]) ** 2
    # The power of a difference is exponential, its median ln 2 of the mean; lines of n samples have 4 s^2 / n.
    scatter = np.median(power, axis=0) / (2.0 * np.log(2.0)) * samples / 4.0
    return np.asarray(repeated_variance(steps, scatter) * 4.0 / samples)


def _mean_and_noise(spectra: ComplexArray, first: Counts, floor: Array) -> tuple[ComplexArray, LineCovariance]:
    """Mean (K, n) over the steady periods of each line, and the covariance of the mean; `floor` (n,) of one period."""
    P = len(spectra)
    used = np.arange(P)[:, None] >= first
    m = used.sum(axis=0).astype(float)
    mean = np.sum(spectra * used[:, :, None], axis=0) / m[:, None]
    deviation = (spectra - mean) * used[:, :, None]
    return mean, pool_scatter(deviation.swapaxes(0, 1), m - 1.0, floor).scaled(1.0 / m)


def _beside_transient(
    spectra: ComplexArray, start: SteadyStart, mean: ComplexArray, known: tuple[LineCovariance, Array], c: int
) -> tuple[LineCovariance, ComplexArray | None, float]:
    """Noise of the mean without the transient of periods that are not steady, the square of that transient in the mean
    (K, n, n), and the share of the information of the c channels beside it: the noise, None and one without any.

    `known`: the noise with the transient, and the floor (n,) of its variance.
    """
    noise, floor = known
    if start.steady.all():
        return noise, None, 1.0
    beside = pool_scatter(*deviations_from_decay(spectra), floor)
    beside = beside.scaled(1.0 / (len(spectra) - start.first))
    left = transient_covariance(spectra, start)
    information = information_beside_transient(mean[:, :c], beside.variance[:, :c], left[:, :c, :c])
    # Two periods tell no decay: if they differ by noise alone, there is nothing to be taken out.
    if len(spectra) < FEWEST_PERIODS and information >= LEAST_INFORMATION:
        return noise, None, 1.0
    return beside, left, information


def _excited_lines(mean: ComplexArray, variance: Array, inputs: int) -> NDArray[np.bool_]:
    """Whether (K, u) a load exceeds its noise by far, and is not small beside its strongest line.

    `mean` and `variance` are (K, n), with the loads last.
    """
    amplitude = np.abs(mean[:, -inputs:])
    above_noise = amplitude > LEAST_LINE_SIGNAL_TO_NOISE * np.sqrt(variance[:, -inputs:])
    return np.asarray(above_noise & (amplitude > LEAST_SHARE_OF_STRONGEST * amplitude.max(axis=0)))


def _select_lines(
    run: Run, excited: NDArray[np.bool_], frequency: Array, band: tuple[float, float], loads: ComplexArray
) -> NDArray[np.bool_]:
    """Which lines (K,) are excited and within `band` [Hz]. Raises UserError where `loads` (P, K, u) have none."""
    selected = np.any(excited, axis=1)
    if not np.any(selected):
        raise transient.no_common_line(run, loads)
    selected &= (frequency >= band[0]) & (frequency <= band[1])
    if not np.any(selected):
        raise run_error(
            run, f"no line was excited from {band[0]:g} to {band[1]:g} Hz", "Select another band with --from and --to"
        )
    return np.asarray(selected)


def _input_columns(components: Sequence[str], excited: NDArray[np.bool_], declared: Sequence[str]) -> list[int]:
    """The loads that are inputs; the others were measured, but are neither declared as excited nor more than noise."""
    share = excited.mean(axis=0)
    return [i for i, name in enumerate(components) if name in declared or share[i] > LEAST_SHARE_OF_LINES]


def _analysis_window(
    run: Run, periods: int, samples: int, first: Counts, covariance: ComplexArray, dof: float
) -> AnalysisWindow:
    rate = sample_rate(run)
    offset = run.samples - periods * samples
    return AnalysisWindow((offset + first * samples) / rate, run.samples / rate, 1.0 / rate, covariance, dof)


def _periodic_record_of(
    run: Run, lines: RunSpectrum, spectra: ComplexArray, samples: int, first: Counts, steady: bool, rings: bool
) -> PeriodicRecord:
    rate = sample_rate(run)
    periods = len(spectra)
    offset = run.samples - periods * samples
    return PeriodicRecord(
        spectrum=lines,
        period=samples / rate,
        periods=periods,
        first=first,
        start=(offset + int(first.max()) * samples) / rate,
        stop=run.samples / rate,
        steady=steady,
        rings=rings,
    )
