"""The mean of a record and its channels through time, for effects that need them beside the spectral lines.

A force that is a nonlinear function of the channels is computed in time. For this the anti-alias filter is removed from
the channels, and the channels of each spring are combined at every frequency with the inverse of their variance as
weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.signals.channel_shares import channel_shares
from balance_cli.signals.local.nonperiodic_spectrum import nonperiodic_record
from balance_cli.signals.periodic import samples_per_period
from balance_cli.signals.record_mean import delay_free_mean
from balance_cli.signals.run_samples import load_columns, read_samples, sample_rate
from balance_cli.signals.run_spectrum import RunSpectrum
from balance_cli.signals.sampled_waveform import RecordWaveform, SampledWaveform, end_to_end_rise

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Where the gain of the anti-alias filter is less, amplitudes are set to zero: dividing by it would amplify their noise.
LEAST_FILTER_GAIN = 0.3
# Number of neighboring amplitudes whose mean power is compared with the noise, the probability at which noise alone has
# this power, and the fraction of the frequencies of a record that contain little but noise.
SMOOTHING_LINES = 7
NOISE_P_VALUE = 1e-3
QUIET_QUANTILE = 0.1
# Mean of a load that is not excited, over the rms of the excited ones, from which it acts on purpose: the sweeps of a
# plan under mean loads have 1 and more; below it changes chi-square of the mean by about one.
LEAST_MEAN_LOAD = 1e-3
# Probability below which the scatter of the means of the periods is attributed to a drift, not to noise: of the channel
# that scatters most, and of all channels together, where a false alarm only makes the mean of one record less certain.
DRIFT_P_VALUE, COMMON_DRIFT_P_VALUE = 1e-4, 1e-2


def append_mean_and_waveform(run: Run, lines: RunSpectrum, geometry: Geometry) -> RunSpectrum:
    """Append the mean of a periodic record as a line at frequency zero (the last), and its mean period as a waveform.

    Both are computed from the periods that are steady at every line.
    """
    window = lines.window
    assert window is not None
    n, rate = samples_per_period(run), sample_rate(run)
    first = round(float(window.start.max()) * rate)
    channels, loads = read_samples(run, lines.channel_names, first)
    periods = np.hstack([channels, loads[:, load_columns(lines.components)]]).reshape(-1, n, lines.covariance.shape[1])
    number_of_periods = rate * (window.stop - window.start[0]) / n
    direct = ~np.array(_ac_coupled_channels(lines, geometry))
    # Lines whose noise is taken from neighbors still ringing hide a drift that their window shows: each has its factor.
    factor, window_factor = (
        number_of_periods / len(periods) * _drift_factor(periods.mean(axis=1), covariance[0], number_of_periods, direct)
        for covariance in (lines.covariance, window.covariance)
    )
    without_mean = _without_mean(lines, loads, geometry)
    lines = _append_mean(lines, periods.mean(axis=(0, 1)), factor, first / rate, without_mean, window_factor)
    c = len(lines.channel_names)
    bin_index = np.rint(lines.frequency * n / rate).astype(np.intp)
    waveform = waveform_from_samples(periods[:, :, :c].mean(axis=0), rate, lines, bin_index, geometry, is_periodic=True)
    return replace(lines, waveform=waveform)


def nonperiodic_spectrum_with_waveform(run: Run, channel_names: Sequence[str], geometry: Geometry) -> RunSpectrum:
    """The lines of a record that does not repeat, with its mean as the last line, at frequency zero, and its waveform.

    The mean is weighted by a Hann window, which suppresses the ends of the record; its noise power is 3/2 times that of
    the unweighted mean.
    """
    local = nonperiodic_record(run, channel_names)
    channels, loads = read_samples(run, channel_names)
    samples = np.hstack([channels, loads[:, load_columns(local.spectrum.components)]])
    mean, error = delay_free_mean(samples, sample_rate(run), local.spectrum)
    bin_index = np.append(local.bin_index, 0)
    sampled = waveform_from_samples(channels, sample_rate(run), local.spectrum, bin_index, geometry, is_periodic=False)
    M = local.weight.shape[1]
    waveform = RecordWaveform(
        **{**vars(sampled), "is_periodic": False},
        first=np.append(local.first, len(bin_index) - M),
        weight=np.vstack([local.weight, np.eye(M)[-1]]),
    )
    without_mean = _without_mean(local.spectrum, loads, geometry)
    return replace(_append_mean(local.spectrum, mean, 1.5, 0.0, without_mean, error=error), waveform=waveform)


def waveform_from_samples(
    samples: Array,
    rate: float,
    lines: RunSpectrum,
    bin_index: NDArray[np.intp],
    geometry: Geometry,
    is_periodic: bool,
) -> SampledWaveform:
    """The waveform of samples (n, c) at `rate` [Hz], for bins of the given indices (R,).

    Each amplitude is reduced by the fraction of noise in its power, or in the mean power of those about it:
    noise would otherwise pass for reversals of the motion, at which a contact slips. A record that does not repeat has
    a step between its ends, and so amplitudes at all frequencies: beyond the last that stands above the noise they are
    those of the straight line from end to end.
    """
    n = len(samples)
    amplitudes, volts, frequency, passed = _undo_anti_alias_filter(samples, rate, geometry)
    dynamic = lines.frequency > 0
    variance = np.median(np.diagonal(lines.covariance[dynamic], axis1=1, axis2=2).real, axis=0)
    variance = variance[: len(lines.channel_names)]
    noise = variance if is_periodic else np.minimum(variance, _quiet_variance(amplitudes))
    gain = _wiener_gain(amplitudes, noise, 1 if is_periodic else SMOOTHING_LINES)
    volts = volts * gain
    if not is_periodic:
        beyond = ~np.logical_or.accumulate((gain > 0.0)[::-1] & _is_passed(passed)[::-1, None], axis=0)[::-1]
        volts = np.where(beyond, _amplitudes(_end_to_end_line(samples)), volts)
    share = channel_shares(geometry, lines.channel_names, frequency, variance) * _is_passed(passed)[:, None]
    return SampledWaveform(
        frequency, volts, share, n, bin_index, passed[bin_index], noise=np.sqrt(noise), passed_share=np.abs(passed)
    )


def _wiener_gain(amplitudes: ComplexArray, variance: Array, smoothing_lines: int) -> Array:
    """Wiener's gain (F, c): the fraction of the power of each amplitude that is not noise of variance (c,).

    The power is averaged over neighbors, and the gain is zero where noise alone would have as much.
    N. Wiener, Extrapolation, Interpolation, and Smoothing of Stationary Time Series, 1949.
    """
    if smoothing_lines == 1:
        return np.asarray(np.maximum(1.0 - variance / np.maximum(np.abs(amplitudes) ** 2, 1e-300), 0.0))
    from balance_cli.signals.distributions import chi2

    ratio, dof = variance / np.maximum(_smooth_power(amplitudes, smoothing_lines), 1e-300), 2 * smoothing_lines
    return np.where(ratio * chi2.isf(NOISE_P_VALUE, dof) / dof < 1.0, 1.0 - ratio, 0.0)


def _smooth_power(amplitudes: ComplexArray, smoothing_lines: int) -> Array:
    """Mean power (F, c) of neighboring amplitudes."""
    from scipy.ndimage import convolve1d

    # A running sum would leave rounding errors of the largest power in the smallest, of either sign.
    return np.asarray(convolve1d(np.abs(amplitudes) ** 2, np.full(smoothing_lines, 1.0 / smoothing_lines), axis=0))


def _quiet_variance(amplitudes: ComplexArray) -> Array:
    """The variance (c,) of noise alone by the quietest frequencies of a record that does not repeat.

    The residual of its lines may be distortion, and so motion.
    """
    from balance_cli.signals.distributions import chi2

    dof = 2 * SMOOTHING_LINES
    quantile = np.quantile(_smooth_power(amplitudes, SMOOTHING_LINES), QUIET_QUANTILE, axis=0)
    return np.asarray(quantile * dof / chi2.ppf(QUIET_QUANTILE, dof))


def _undo_anti_alias_filter(
    samples: Array, rate: float, geometry: Geometry
) -> tuple[ComplexArray, ComplexArray, Array, ComplexArray]:
    """Amplitudes (F, c) of samples (n, c), those before the anti-alias filter, frequency (F,) [Hz] and filter (F,)."""
    n = len(samples)
    frequency = np.asarray(np.arange((n + 1) // 2) * (rate / n), float)
    passed = anti_alias_response(geometry.acquisition, frequency)
    is_passed = _is_passed(passed)
    amplitudes = _amplitudes(samples)
    volts = np.where(is_passed[:, None], amplitudes / np.where(is_passed, passed, 1.0)[:, None], 0.0)
    return amplitudes, volts, frequency, passed


def _amplitudes(samples: Array) -> ComplexArray:
    """Amplitudes (F, c) of samples (n, c)."""
    n = len(samples)
    return np.asarray(np.fft.rfft(samples, axis=0)[: (n + 1) // 2] * (2.0 / n))


def _end_to_end_line(samples: Array) -> Array:
    """The straight line (n, c) by which samples (n, c) rise from end to end."""
    return np.multiply.outer(np.arange(len(samples)) / len(samples), end_to_end_rise(samples))


def _is_passed(filter_response: ComplexArray) -> NDArray[np.bool_]:
    """Where (F,) the anti-alias filter leaves enough to measure."""
    return np.asarray(np.abs(filter_response) >= LEAST_FILTER_GAIN)


def record_waveform(samples: Array, rate: float, live: Sequence[str], geometry: Geometry) -> SampledWaveform:
    """The waveform of a record's live channels (n, l) [V], with a bin for each frequency and columns for all channels.

    The channels of a spring are weighted as if their noises were equal.
    """
    _, volts, frequency, passed = _undo_anti_alias_filter(samples, rate, geometry)
    share = channel_shares(geometry, live, frequency, np.ones(len(live))) * _is_passed(passed)[:, None]
    indices = [geometry.channel_names.index(name) for name in live]
    wide = np.zeros((len(volts), len(geometry.channels)), complex)
    wide_share = np.zeros(wide.shape)
    wide[:, indices], wide_share[:, indices] = volts, share
    return SampledWaveform(
        frequency, wide, wide_share, len(samples), np.arange(len(frequency)), passed, is_periodic=False
    )


def _ac_coupled_channels(lines: RunSpectrum, geometry: Geometry) -> list[bool]:
    """Which channels (c,) do not measure a constant load."""
    by_name = {channel.name: channel for channel in geometry.channels}
    return [not by_name[name].measures_dc for name in lines.channel_names]


def _without_mean(lines: RunSpectrum, loads: Array, geometry: Geometry) -> list[bool]:
    """Which channels (c,) have no useful mean: AC-coupled ones, and all where loads (n, 6) act that are not excited.

    The lines hold the excited components alone. A mean load of another one strains the rig as well, and would be taken
    for an offset of channels.
    """
    excited = load_columns(lines.components)
    mean, level = np.abs(loads.mean(axis=0)), float(np.linalg.norm(np.std(loads[:, excited], axis=0)))
    if np.delete(mean, excited).max(initial=0.0) > LEAST_MEAN_LOAD * level:
        return [True] * len(lines.channel_names)
    return _ac_coupled_channels(lines, geometry)


def _append_mean(
    lines: RunSpectrum,
    mean: Array,
    factor: float,
    start: float,
    without_mean: Sequence[bool],
    window_factor: float = 1.0,
    error: Array | None = None,
) -> RunSpectrum:
    """Append a line at frequency zero for the mean (c+u,) of the record from `start` [s] on.

    Its noise is `factor` times that of the lowest line, in the window `window_factor` times, and infinite in the
    channels `without_mean` (c,). `error` (c,) is a standard deviation of the mean of the channels beside it.
    """
    factor = 2.0 * factor
    c, z = len(without_mean), 2.0 * mean
    window = lines.window
    if window is not None:
        covariance = _append_mean_covariance(window.covariance, 2.0 * window_factor, without_mean)
        window = replace(window, start=np.append(window.start, start), covariance=covariance)
    covariance = _append_mean_covariance(lines.covariance, factor, without_mean)
    if error is not None:
        # The line is twice the mean, and a real line counts with twice its variance.
        covariance[-1, range(c), range(c)] += 8.0 * error**2
    count = len(lines.frequency)
    volts, units = np.zeros(count + 1), np.zeros((count + 1, len(lines.components)))
    volts[-1] = units[-1] = 2.0
    return replace(
        lines,
        frequency=np.append(lines.frequency, 0.0),
        channels=np.vstack([lines.channels, z[:c]]),
        loads=np.vstack([lines.loads, z[c:]]),
        covariance=covariance,
        window=window,
        constant_volts=volts,
        constant_loads=units,
        periods=None if lines.periods is None else np.pad(lines.periods, ((0, 0), (0, 1), (0, 0))),
    )


def _append_mean_covariance(covariance: ComplexArray, factor: float, ac_coupled: Sequence[bool]) -> ComplexArray:
    """Append the first covariance of (k, n, n), times a factor; infinite for channels without a DC response."""
    last = factor * covariance[:1].real.astype(complex)
    for i in np.flatnonzero(ac_coupled):
        last[:, i, :] = last[:, :, i] = 0.0
        last[:, i, i] = np.inf
    return np.concatenate([covariance, last])


def _drift_factor(means: Array, covariance: ComplexArray, periods: float, direct: NDArray[np.bool_]) -> float:
    """Variance of a mean relative to that of noise, by the means (m, n) of the periods; 1 without significant drift.

    The noise is the `covariance` (n, n) of the lowest line, which is the mean of `periods` periods; `direct` (c,) are
    the channels that measure a mean. A flicker (1/f) in all channels is too small in each of them to be found in two or
    three periods, and does not average out over them.
    """
    if len(means) < 2:
        return 1.0
    from balance_cli.signals.distributions import chi2

    c, free = len(direct), len(means) - 1
    noise = np.diagonal(covariance).real[:c] * periods / 4.0
    ratio = (np.var(means[:, :c], axis=0, ddof=1) / noise)[direct]
    if not len(ratio):
        return 1.0
    largest, common, all_free = float(ratio.max()), float(ratio.mean()), free * len(ratio)
    if largest <= chi2.isf(DRIFT_P_VALUE / c, free) / free:
        largest = 1.0
    if common <= chi2.isf(COMMON_DRIFT_P_VALUE, all_free) / all_free:
        common = 0.0
    return max(largest, common * len(means))
