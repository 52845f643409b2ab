"""Rotor harmonics of a run: regression of all channels on azimuth, with the noise measured in the same record."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.io.errors import UserError
from balance_cli.io.result_view import plural
from balance_cli.signals.rotor.amplitude_errors import azimuth_error_covariance, bridging_covariance
from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.signals.rotor.edge_weight import edge_weight
from balance_cli.signals.rotor.harmonic_noise import (
    AROUND,
    NoiseLines,
    blackman_taper,
    line_offsets,
    mean_line_offsets,
    mean_noise,
    noise_only_lines,
    pooled_noise,
)
from balance_cli.signals.rotor.joint_regression import JointRegression, complex_amplitudes, harmonic_products
from balance_cli.signals.rotor.line_sums import LineSums, trigonometric_basis
from balance_cli.signals.rotor.other_lines import NO_OTHER_LINES, OtherLines
from balance_cli.signals.rotor.record_length import FEWEST_REVOLUTIONS
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FITTED_HARMONICS = 24
"""Least number of harmonics in the regression, where the sample rate permits: those left out would leak."""
BELOW_NYQUIST = 0.98
"""Of half the sample rate: the highest frequency of a harmonic, at the highest speed."""
BLOCK_SAMPLES = 4096
"""Samples in a block: the basis of 49 columns then takes 1.6 MB, and stays in the cache of a core."""


@dataclass(frozen=True)
class Harmonics:
    """Harmonics 0 to n of c signals of one run over whole revolutions.

    x(psi) = Re sum_k amplitude_k exp(+j k psi), amplitude_k = cosine_k - j sine_k; amplitude_0 is real.
    `covariance` (n+1, c, c) is E[dX dX*] of their noise: for k >= 1 circular, so that the variance of a cosine or a
    sine is half of the diagonal; for k = 0 real, the variance of the mean itself. `dof` (n+1,) are its complex degrees
    of freedom. `frequency_hz` (n+1,) is k times the mean pulse rate over `interval` [s], which lasts from revolution
    `revolutions[0]` to `revolutions[1]`.
    """

    run: str
    names: tuple[str, ...]
    frequency_hz: Array
    amplitude: ComplexArray
    covariance: ComplexArray
    dof: Array
    interval: tuple[float, float]
    revolutions: tuple[int, int]
    samples: int
    noise_lines: NoiseLines | None = None

    @property
    def cosine(self) -> Array:
        """Cosine amplitudes (n+1, c)."""
        return np.asarray(self.amplitude.real)

    @property
    def sine(self) -> Array:
        """Sine amplitudes (n+1, c)."""
        return np.asarray(-self.amplitude.imag)

    def columns(self, names: Sequence[str]) -> list[int]:
        """Return the columns of the named signals."""
        return [self.names.index(name) for name in names]


@dataclass(frozen=True)
class _AzimuthBlock:
    """A block of m samples: azimuth, speed [Hz], fraction of the interval, weight, `other` (e, m), signals (m, c).

    `other_columns` (e,) are the places of the other columns among those of the whole record, of which some have faded.
    `turns` is the number of revolutions of the interval.
    """

    psi: Array
    speed: Array
    fraction: Array
    weight: Array
    other: Array
    other_columns: NDArray[np.int64]
    signals: Array
    turns: int


@dataclass
class _NormalEquations:
    """Sums over the blocks: normal equations of the regression, and lines of the tapered record.

    `turning` (2 F + 1,) are the sums of w exp(j k psi), k = 0 to 2 F, which hold every product of two columns of the
    trigonometric basis; `border` (e, 2 F + 1 + e) are the products of the other columns with these and themselves.
    """

    turning: ComplexArray
    border: Array
    moment: Array
    lines: LineSums
    weight: Array  # sums of w, w^2, q, q^2
    samples: int = 0


def estimate_harmonics(
    run: Run,
    azimuth: Azimuth,
    n: int = 8,
    *,
    names: Sequence[str] | None = None,
    first_revolution: int = 0,
    last_revolution: int | None = None,
    other: OtherLines = NO_OTHER_LINES,
    block: int = BLOCK_SAMPLES,
) -> Harmonics:
    """Estimate harmonics 0 to `n` of the named signals (default: all channels, and the loads where the run has them).

    All harmonics are regressed jointly on azimuth, FITTED_HARMONICS or more, over whole revolutions, with a weight that
    rises smoothly at either end: an amplitude that varies with the speed would otherwise leak into its neighbors at
    1/T (0.001 V from 4/rev into 2/rev, where the speed changed by 6 %). The weight has the moments of a step at each
    end, so that the amplitudes are means over the whole interval. For a signal that is periodic in azimuth the result
    is exact. `other` lines are regressed with them, and are not returned; what they cost is in the covariance.

    The noise is that of the neighboring lines k + m/R of the same record, R revolutions, the error of bridged gaps,
    and what the scatter of the pulses leaves of an error of the azimuth.

    Raises UserError where the interval is too short, a harmonic is beyond half the sample rate, or a signal is not
    finite.
    """
    names = _signal_names(run) if names is None else tuple(names)
    last = azimuth.turns if last_revolution is None else last_revolution
    _check_interval(run, azimuth, first_revolution, last)
    revolutions = (first_revolution, last)
    start, end = (float(t) for t in azimuth.time_of(np.array(revolutions)))
    offsets = line_offsets(last - first_revolution)
    fitted_count = count_regressed_harmonics(run, azimuth, n, (start, end))
    sums = _empty_sums(n * (last - first_revolution) + int(offsets[-1]), fitted_count, other.columns, len(names))
    for samples in _weighted_blocks(run, azimuth, names, revolutions, other, block):
        _accumulate_block(sums, samples, fitted_count)
    regression = JointRegression(harmonic_products(sums.turning, fitted_count), sums.border)
    amplitude = complex_amplitudes(regression.solve(sums.moment), n, fitted_count)
    covariance, dof, noise_lines = _amplitude_covariance(sums, amplitude, revolutions, offsets, regression)
    weighted_revolutions = (last - first_revolution) * sums.weight[0] ** 2 / (sums.weight[1] * sums.samples)
    covariance = covariance + azimuth_error_covariance(amplitude, azimuth, weighted_revolutions)

    def error_amplitudes(index: NDArray[np.int64], errors: Array) -> ComplexArray:
        time = np.clip(index / sample_rate(run), azimuth.first, azimuth.last)
        psi = azimuth.psi(time)
        weight = edge_weight(psi / (2 * np.pi), *revolutions)
        moment = trigonometric_basis(psi, fitted_count, other.basis(time)) @ (errors * weight).T
        return complex_amplitudes(regression.solve(moment), n, fitted_count).T

    span = sample_span(run, start, end)
    covariance = covariance + bridging_covariance(run, names, span, error_amplitudes)
    frequency = np.arange(n + 1) * (last - first_revolution) / (end - start)
    return Harmonics(
        run.name, names, frequency, amplitude, covariance, dof, (start, end), revolutions, sums.samples, noise_lines
    )


def _signal_names(run: Run) -> tuple[str, ...]:
    return run.channel_names + (COMPONENTS if run.has_loads else ())


def _check_interval(run: Run, azimuth: Azimuth, first: int, last: int) -> None:
    if not 0 <= first < last <= azimuth.turns or last - first < FEWEST_REVOLUTIONS:
        fault = f"revolutions {first} to {last} of {azimuth.turns}: at least {FEWEST_REVOLUTIONS} are needed"
        raise UserError(fault, run.file, "rotor/pulse_times", "Record for longer")


def count_regressed_harmonics(run: Run, azimuth: Azimuth, n: int, interval: tuple[float, float]) -> int:
    """Return the highest harmonic in the regression for harmonics 0 to `n`; UserError where the rate is too low."""
    fastest = float(np.max(azimuth.speed(np.linspace(*interval, 2048))))
    possible = int(BELOW_NYQUIST * sample_rate(run) / 2 / fastest)
    if possible < n:
        fault = f"harmonic {n} at {n * fastest:.1f} Hz is beyond half the sample rate of {sample_rate(run):g} Hz"
        remedy = f"Request at most {plural(possible, 'harmonic')}" if possible else "Record at a higher rate"
        raise UserError(fault, run.file, "sample_rate", remedy)
    return min(possible, max(FITTED_HARMONICS, n + 4))


def _weighted_blocks(
    run: Run, azimuth: Azimuth, names: tuple[str, ...], revolutions: tuple[int, int], other: OtherLines, block: int
) -> Iterator[_AzimuthBlock]:
    first, last = revolutions
    start, end = azimuth.time_of(np.array(revolutions))
    begin, stop = sample_span(run, start, end)
    for low in range(begin, stop, block):
        high = min(low + block, stop)
        signals = read_signals(run, names, low, high)
        psi, speed = azimuth.of_samples(sample_rate(run), low, high)
        time = np.clip(np.arange(low, high) / sample_rate(run), azimuth.first, azimuth.last)
        revolution = psi / (2 * np.pi)
        fraction = np.clip((revolution - first) / (last - first), 0.0, 1.0)
        weight = edge_weight(revolution, first, last)
        lines, columns = other.remaining(float(time[0]))
        yield _AzimuthBlock(psi, speed, fraction, weight, lines.basis(time), columns, signals, last - first)


def sample_span(run: Run, start: float, end: float) -> tuple[int, int]:
    """Return the first sample and the end of an interval [s]."""
    return int(np.ceil(start * sample_rate(run))), min(int(np.floor(end * sample_rate(run))) + 1, run.samples)


def read_signals(run: Run, names: tuple[str, ...], low: int, high: int) -> Array:
    """Samples (m, c) of the named channels and load components."""
    read = run.read(low, high)
    stacked = read.channels if read.loads is None else np.hstack([read.channels, read.loads])
    known = _signal_names(run)
    signals = stacked if names == known else np.asarray(stacked[:, [known.index(name) for name in names]], float)
    if not np.all(np.isfinite(signals)):
        bad = names[int(np.flatnonzero(~np.all(np.isfinite(signals), axis=0))[0])]
        remedy = "Leave the channel out"
        raise UserError("samples are not finite", run.file, f"channel {bad}", remedy)
    return signals


def _empty_sums(highest_line: int, fitted_count: int, other: int, count: int) -> _NormalEquations:
    columns = 2 * fitted_count + 1 + other
    turning, border, lines = np.zeros(2 * fitted_count + 1, complex), np.zeros((other, columns)), count + other
    return _NormalEquations(turning, border, np.zeros((columns, count)), LineSums(highest_line, lines), np.zeros(4))


def _accumulate_block(sums: _NormalEquations, samples: _AzimuthBlock, fitted_count: int) -> None:
    """Add a block to the sums.

    Lines are integrals over azimuth, d psi = 2 pi speed dt, over which harmonics are orthogonal.
    """
    w, F, c = samples.weight, fitted_count, samples.signals.shape[1]
    basis = trigonometric_basis(samples.psi, F, samples.other)
    weighted = np.empty((c + 3 + len(samples.other), len(w)))
    np.multiply(samples.signals.T, w, out=weighted[:c])
    weighted[c] = w
    np.multiply(basis[F : 2 * F + 1 : max(F, 1)], w, out=weighted[c + 1 : c + 3])
    np.multiply(basis[2 * F + 1 :], w, out=weighted[c + 3 :])
    products = weighted @ basis.T
    columns = np.concatenate([np.arange(2 * F + 1), 2 * F + 1 + samples.other_columns])
    sums.moment[columns] += products[:c].T
    constant, cosine, sine = products[c : c + 3, : 2 * F + 1]
    sums.turning[: F + 1] += constant[: F + 1]
    sums.turning[1 : F + 1] += 1j * constant[F + 1 :]
    sums.turning[F + 1 :] += cosine[1 : F + 1] - sine[F + 1 :] + 1j * (sine[1 : F + 1] + cosine[F + 1 :])
    sums.border[samples.other_columns[:, None], columns] += products[c + 3 :]
    q = blackman_taper(samples.fraction) * samples.speed
    tapered = np.hstack([samples.signals, samples.other.T])
    tapered *= q[:, None]
    of_lines = np.concatenate([np.arange(c), c + samples.other_columns])
    sums.lines.add(samples.psi / (2.0 * np.pi * samples.turns), tapered, of_lines)
    sums.weight += [np.sum(w), np.sum(w**2), np.sum(q), np.sum(q**2)]
    sums.samples += len(w)


def _of_cosine_and_sine(factor: Array, n: int) -> Array:
    """Return the mean (n+1,) of a factor (2 F + 1,) on the variances of cosine and sine of each harmonic."""
    cosine, sine = factor[: n + 1], factor[len(factor) // 2 + 1 :][:n]
    return np.append(cosine[0], 0.5 * (cosine[1:] + sine))


def _amplitude_covariance(
    sums: _NormalEquations,
    amplitude: ComplexArray,
    revolutions: tuple[int, int],
    offsets: Array,
    regression: JointRegression,
) -> tuple[ComplexArray, Array, NoiseLines]:
    """Covariance (n+1, c, c) of the amplitudes (n+1, c), its degrees of freedom (n+1,), and the lines of the noise."""
    n, turns = len(amplitude) - 1, revolutions[1] - revolutions[0]
    w, w2, q, q2 = sums.weight
    # A tapered sum over noise of density S has variance S sum q^2; so has the regression with w in place of q.
    variance_ratio = (w2 / w**2) / (q2 / q**2)
    innermost = mean_line_offsets(turns)
    every = np.concatenate([offsets, np.arange(-AROUND, AROUND + 1)]).astype(np.int64)
    beside = turns * np.arange(1, n + 1)[:, None] + every
    lines = sums.lines.at(np.concatenate([innermost.astype(np.int64), beside.ravel()])) * (2.0 / q)
    lines, of_others = np.split(lines, [amplitude.shape[1]], axis=1)
    to_start = np.exp(2j * np.pi * innermost * revolutions[0] / turns)  # lines count azimuth from the first pulse
    mean = mean_noise(to_start[:, None] * lines[: len(innermost)], innermost, amplitude[0].real)
    pooled = pooled_noise(lines[len(innermost) :].reshape(*beside.shape, -1)[:, : len(offsets)], offsets)
    factor = variance_ratio * _of_cosine_and_sine(regression.variance_inflation(), n)
    covariance = factor[:, None, None] * np.concatenate([mean.covariance[None], pooled.covariance])
    rest = (lines - of_others @ regression.solve_others(sums.moment))[len(innermost) :].reshape(*beside.shape, -1)
    around = rest[:, len(offsets) :] * np.exp(2j * np.pi * every[len(offsets) :] * revolutions[0] / turns)[:, None]
    clean = np.asarray(rest[:, : len(offsets)], complex)
    noise_lines = NoiseLines(clean, offsets, noise_only_lines(np.abs(clean) ** 2, offsets), factor[1:].real, around)
    return covariance, np.concatenate([mean.dof[None], pooled.dof]), noise_lines
