"""Lines of periodic records: whole steady periods, no window, noise from the scatter between periods.

Pintelon and Schoukens, System Identification: A Frequency Domain Approach, 2nd ed. (2012), sections 2.6 and 10.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.io.errors import UserError
from balance_cli.signals.covariance_pooling import (
    inverse_bias_factor,
    mahalanobis_distances,
    outlier_bound,
    pooled_covariance,
    variance_floor,
    window_sums,
)
from balance_cli.signals.periodic_transient import find_steady_start
from balance_cli.signals.run_samples import (
    channel_columns,
    load_columns,
    measured_components,
    read_samples,
    run_error,
    sample_rate,
)
from balance_cli.signals.run_spectrum import RunSpectrum
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
LEAST_SHARE_OF_STRONGEST = 0.01
LEAST_SHARE_OF_LINES = 0.1
NOISE_LINES = 40
INFLATION_PROBABILITY = 1e-4
DECAY_LINES = 11
# Differences of neighbouring lines share one: their mean square is worth two thirds of as many independent ones.
DIFFERENCE_DOF = 2.0 / 3.0


@dataclass(frozen=True)
class PeriodicRecord:
    """The lines of a periodic run, and which periods they rest on.

    `period` [s] that was cut (a multiple of the declared one where that has no whole number of samples), `periods` in
    the record, `first` (k,) steady period of each line (0 is the first), `start` and `stop` [s] of what is steady at
    every line, `steady`: whether a test says so, or two periods had to be kept for want of more.
    """

    spectrum: RunSpectrum
    period: float
    periods: int
    first: Counts
    start: float
    stop: float
    steady: bool


def periodic_spectrum(run: Run, channel_names: Sequence[str], band: tuple[float, float] = (0.0, np.inf)) -> RunSpectrum:
    """Lines of a periodic run at the frequencies that were excited, within `band` [Hz]; see `periodic_record`."""
    return periodic_record(run, channel_names, band).spectrum


def periodic_record(
    run: Run, channel_names: Sequence[str], band: tuple[float, float] = (0.0, np.inf)
) -> PeriodicRecord:
    """Cut a periodic run in whole periods (the last ends with the record), leave the start transient out, average.

    Spectra are amplitudes, `x(t) = Re sum X exp(+j 2 pi f t)`. The covariance is that of the mean over the steady
    periods, pooled over neighbouring lines; a line with improbably large scatter has its own, larger one. `spectrum.dof`
    belongs to the pooled covariance: consumers that invert it multiply the inverse by `inverse_bias_factor(dof, n)`,
    n = channels + components. UserError: no period, fewer than two whole periods, or nothing that repeats.
    """
    samples = samples_per_period(run)
    spectra, number, components = _period_spectra(run, channel_names, samples)
    frequency = number * sample_rate(run) / samples
    start = find_steady_start(spectra)
    mean, covariance, dof = _mean_and_covariance(spectra, start.first)
    noise = (
        (covariance, dof) if start.steady.all() or len(spectra) < 3 else _covariance_about_decay(spectra, start.first)
    )
    covariance = covariance * (1.0 + start.bias)[:, None, None]
    excited = _excited_lines(mean, covariance, len(components))
    chosen = np.any(excited, axis=1)
    if not np.any(chosen):
        raise run_error(
            run, "no line of the loads repeats from period to period", "Check `period`", "attribute `period`"
        )
    chosen &= (frequency >= band[0]) & (frequency <= band[1])
    if not np.any(chosen):
        raise run_error(run, f"no line was excited from {band[0]:g} to {band[1]:g} Hz", "Ask for another band")
    lines = RunSpectrum(
        run=run.name,
        channel_names=tuple(channel_names),
        components=components,
        frequency=frequency[chosen],
        channels=mean[chosen, : len(channel_names)],
        loads=mean[chosen, len(channel_names) :],
        covariance=covariance[chosen],
        dof=dof,
        rotor_speed=run.rotor_speed,
        level=run.level,
        window=_analysis_window(run, len(spectra), samples, start.first[chosen], noise[0][chosen], noise[1]),
    )
    lines = _drop_unexcited_components(lines, excited[chosen], run.excited)
    return _periodic_record_of(run, lines, spectra, samples, start.first[chosen], bool(np.all(start.steady[chosen])))


def has_whole_periods(run: Run) -> bool:
    """Whether the run declares a period and holds at least two that can be cut."""
    try:
        return run.period is not None and samples_per_period(run) > 0
    except UserError:
        return False


def samples_per_period(run: Run) -> int:
    """Samples in the shortest multiple of the declared period that is a whole number of samples, to 0.01 of one

    over the record. UserError where the run declares no period, or holds fewer than two such multiples.
    """
    if run.period is None:
        raise run_error(run, "there is no `period`", "Choose an estimator for records that do not repeat")
    exact = run.period * sample_rate(run)
    for multiple in range(1, int(run.samples / (2.0 * exact)) + 1):
        samples = round(multiple * exact)
        if abs(samples - multiple * exact) * (run.samples / samples) < 0.01:
            return samples
    raise run_error(
        run,
        f"the record does not hold two periods of a whole number of samples ({exact:g} each)",
        "Record more periods, or choose an estimator for records that do not repeat",
        "attribute `period`",
    )


def _period_spectra(
    run: Run, channel_names: Sequence[str], samples: int
) -> tuple[ComplexArray, NDArray[np.intp], tuple[str, ...]]:
    """Amplitudes (P, K, c+u) of every whole period around the lines that were excited, the numbers of these lines (K,)

    and the components.
    """
    periods = run.samples // samples
    offset = run.samples - periods * samples
    channel_columns(run, channel_names)
    each = []
    every_load = np.zeros((1, 6))
    for p in range(periods):
        channels, loads = read_samples(run, channel_names, offset + p * samples, offset + (p + 1) * samples)
        every_load = np.maximum(every_load, np.abs(loads).max(axis=0))
        spectrum = np.fft.rfft(np.hstack([channels, loads]), axis=0)[1 : (samples + 1) // 2]
        each.append(spectrum * (2.0 / samples))
    components = measured_components(run, every_load)
    c = len(channel_names)
    kept = [*range(c), *(c + place for place in load_columns(components))]
    spectra = np.asarray(each)[:, :, kept]
    late = np.abs(spectra[periods // 2 :, :, c:].mean(axis=0))
    strong = np.flatnonzero(np.any(late > LEAST_SHARE_OF_STRONGEST * late.max(axis=0), axis=1))
    lines = np.arange(max(strong[0] - 2, 0), min(strong[-1] + NOISE_LINES, spectra.shape[1]))
    return spectra[:, lines], lines + 1, components


def _mean_and_covariance(spectra: ComplexArray, first: Counts) -> tuple[ComplexArray, ComplexArray, float]:
    """Mean (K, n) over the steady periods of each line, covariance of that mean (K, n, n), its dof."""
    P = len(spectra)
    used = np.arange(P)[:, None] >= first
    m = used.sum(axis=0).astype(float)
    mean = np.sum(spectra * used[:, :, None], axis=0) / m[:, None]
    deviation = (spectra - mean) * used[:, :, None]
    scatter = np.einsum("pki,pkj->kij", deviation, deviation.conj())
    covariance, dof = _pool_scatter(scatter, m - 1.0, variance_floor(spectra))
    return mean, covariance / m[:, None, None], dof


def _pool_scatter(scatter: ComplexArray, counts: Array, floor: Array) -> tuple[ComplexArray, float]:
    """Covariance (K, n, n) of one period and its dof; larger where a line scatters more than its neighbours."""
    covariance, dof = pooled_covariance(scatter, counts, floor=floor)
    return covariance * _scatter_inflation(scatter, covariance, counts, dof)[:, None, None], dof


def _covariance_about_decay(spectra: ComplexArray, first: Counts) -> tuple[ComplexArray, float]:
    """Covariance (K, n, n) of the mean over the periods used, and its dof, as free of a decay as it can be told."""
    counts = np.full(spectra.shape[1], DIFFERENCE_DOF)
    covariance, dof = _pool_scatter(_scatter_about_decay(spectra), counts, variance_floor(spectra))
    return covariance / (len(spectra) - first)[:, None, None], dof


def _scatter_about_decay(spectra: ComplexArray) -> ComplexArray:
    """Scatter (K, n, n) of the last periods about a free motion, worth WORTH_OF_DIFFERENCE degrees of freedom.

    From one period to the next that shrinks by the same complex factor r at neighbouring lines, so that
    x_2 - x_1 - r (x_1 - x_0) holds noise alone, 1 + |1 + r|^2 + |r|^2 times that of one period. Where there are
    periods enough an earlier difference, of other noise, is the instrument that r is found with. What several modes
    leave far from their peaks is smooth in frequency, and goes with the difference of neighbouring lines.
    """
    differences = np.diff(spectra, axis=0)
    early, late = differences[-2:]
    instrument = differences[-4] if len(differences) > 3 else early
    weight = 1.0 / np.maximum(np.median(np.abs(late) ** 2, axis=0), 1e-300)
    width = min(DECAY_LINES, len(late))
    common = window_sums(np.sum(instrument.conj() * late * weight, axis=1), width)
    power = window_sums(np.sum(instrument.conj() * early * weight, axis=1), width)
    r = common / np.where(power == 0, 1.0, power)
    r = r / np.maximum(np.abs(r), 1.0)
    left = (late - r[:, None] * early) / np.sqrt(1.0 + np.abs(1.0 + r) ** 2 + np.abs(r) ** 2)[:, None]
    k = np.minimum(np.arange(len(left)), len(left) - 2)
    left = (left[k + 1] - left[k]) * np.sqrt(DIFFERENCE_DOF / 2.0)
    return np.asarray(left[:, :, None] * left[:, None, :].conj())


def _scatter_inflation(scatter: ComplexArray, covariance: ComplexArray, counts: Array, dof: float) -> Array:
    """1 where a line scatters as its neighbours do; where that is improbable, how much more it scatters (K,)."""
    far = mahalanobis_distances(scatter, covariance, counts, dof)
    return np.where(far > outlier_bound(counts, scatter.shape[1], INFLATION_PROBABILITY), far, 1.0)


def _excited_lines(mean: ComplexArray, covariance: ComplexArray, inputs: int) -> NDArray[np.bool_]:
    """Where (K, u) a load component stands well above its noise and is not a mere trace of its strongest line."""
    amplitude = np.abs(mean[:, -inputs:])
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).real[:, -inputs:])
    above_noise = amplitude > LEAST_LINE_SIGNAL_TO_NOISE * sigma
    return np.asarray(above_noise & (amplitude > LEAST_SHARE_OF_STRONGEST * amplitude.max(axis=0)))


def _drop_unexcited_components(lines: RunSpectrum, excited: NDArray[np.bool_], declared: Sequence[str]) -> RunSpectrum:
    """The lines without load components that were measured, but neither declared as excited nor anything but noise."""
    share = excited.mean(axis=0)
    kept = [i for i, name in enumerate(lines.components) if name in declared or share[i] > LEAST_SHARE_OF_LINES]
    c = lines.channels.shape[1]
    signals = np.array([*range(c), *(c + i for i in kept)])
    window = lines.window
    if window is not None:
        window = replace(window, covariance=window.covariance[:, signals[:, None], signals])
    return replace(
        lines,
        window=window,
        components=tuple(lines.components[i] for i in kept),
        loads=lines.loads[:, kept],
        covariance=lines.covariance[:, signals[:, None], signals],
    )


def _analysis_window(
    run: Run, periods: int, samples: int, first: Counts, covariance: ComplexArray, dof: float
) -> AnalysisWindow:
    rate = sample_rate(run)
    offset = run.samples - periods * samples
    return AnalysisWindow((offset + first * samples) / rate, run.samples / rate, 1.0 / rate, covariance, dof)


def _periodic_record_of(
    run: Run, lines: RunSpectrum, spectra: ComplexArray, samples: int, first: Counts, steady: bool
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
    )
