"""Rotor harmonics of a run: regression of all channels on azimuth, with the noise of the record itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.io.errors import UserError
from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.signals.rotor.harmonic_noise import PooledNoise, blackman_taper, line_offsets, pooled_noise

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FEWEST_REVOLUTIONS = 10
EDGE_REVOLUTIONS = 12  # revolutions over which the weight rises at either end
FITTED_HARMONICS = 24  # harmonics regressed at least, where the sample rate lets them: the higher ones must not leak
BELOW_NYQUIST = 0.98
BLOCK_SAMPLES = 8192  # samples
# w(u) = u^3 (a + b u + c u^2 + d u^3 + e u^4) rises from 0 to 1 without slope or curvature at either end, and has the
# moments of a step: the integrals of (w - 1) and of (w - 1) u vanish.
EDGE_POWERS = np.arange(3.0, 8.0)
EDGE_POLYNOMIAL = np.linalg.solve(
    np.array(
        [
            np.ones(5),
            EDGE_POWERS,
            EDGE_POWERS * (EDGE_POWERS - 1),
            1 / (EDGE_POWERS + 1),
            1 / (EDGE_POWERS + 2),
        ]
    ),
    np.array([1.0, 0.0, 0.0, 1.0, 0.5]),
)
SLOPE_SIGNIFICANCE = (
    2.0  # standard errors by which the spectrum must fall before the mean's noise is extrapolated to it
)
STEEPEST_EXPONENT = (
    -1.5
)  # beyond 1/f noise: there the load itself has moved, in a step or manoeuvre, and its mean is no guess
MEAN_LINE_OFFSET = 0.5
MEAN_NOISE_LINES = 24  # lines: the mean is asked for its noise at the lowest frequencies


@dataclass(frozen=True)
class Harmonics:
    """Harmonics 0 to n of c signals of one run over whole revolutions.

    x(psi) = Re sum_k amplitude_k exp(+j k psi), amplitude_k = cosine_k - j sine_k; amplitude_0 is real.
    `covariance` (n+1, c, c) is E[dX dX*] of their noise: for k >= 1 circular, so that the variance of a cosine or a
    sine is half of the diagonal; for k = 0 real, the variance of the mean itself. `dof` (n+1,) are its complex degrees
    of freedom. `frequency_hz` (n+1,) is k times the mean pulse rate of the interval [s] that was used, from revolution
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

    @property
    def cosine(self) -> Array:
        """cosine_k (n+1, c)."""
        return np.asarray(self.amplitude.real)

    @property
    def sine(self) -> Array:
        """sine_k (n+1, c)."""
        return np.asarray(-self.amplitude.imag)

    def columns(self, names: Sequence[str]) -> list[int]:
        """Indices of the named signals."""
        return [self.names.index(name) for name in names]


@dataclass(frozen=True)
class _AzimuthBlock:
    """One block: azimuth (m,), speed [Hz], weight of the regression, signals (m, c)."""

    psi: Array
    speed: Array
    fraction: Array
    weight: Array
    signals: Array


@dataclass
class _NormalEquations:
    """What the blocks add up to: normal equations of the regression, and tapered lines."""

    gram: Array
    moment: Array
    lines: ComplexArray
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
    block: int = BLOCK_SAMPLES,
) -> Harmonics:
    """Harmonics 0 to `n` of the named signals (default: all channels, and the loads where the run has them).

    All harmonics are regressed jointly on azimuth, up to `FITTED_HARMONICS` of them, over whole revolutions and with a
    weight
    that rises smoothly at either end: an amplitude that moves with the speed would otherwise leak into its neighbours
    at 1/T (0.001 V from 4/rev into 2/rev, where speed moved by 6 %). The weight has the moments of a step at each
    end, so the amplitudes are means over the whole interval. A signal that is periodic in azimuth comes out exactly.

    The noise is that of neighbouring lines k + m/R, R revolutions: the record's own, coloured as it is.

    Raises UserError where the interval is too short, a harmonic lies beyond half the sample rate, or a signal is not
    finite.
    """
    names = _signal_names(run) if names is None else tuple(names)
    last = azimuth.turns if last_revolution is None else last_revolution
    _check_interval(run, azimuth, n, first_revolution, last)
    revolutions = (first_revolution, last)
    start, end = (float(t) for t in azimuth.time_of(np.array(revolutions)))
    offsets = line_offsets(last - first_revolution)
    fitted_count = _harmonics_to_fit(run, azimuth, n, start, end)
    sums = _empty_sums(n, fitted_count, offsets, len(names))
    for samples in _weighted_blocks(run, azimuth, names, revolutions, block):
        _accumulate_block(sums, samples, n, fitted_count, offsets / (last - first_revolution))
    amplitude = _solve_amplitudes(sums, n, fitted_count)
    covariance, dof = _amplitude_covariance(sums, n, offsets)
    frequency = np.arange(n + 1) * (last - first_revolution) / (end - start)
    return Harmonics(run.name, names, frequency, amplitude, covariance, dof, (start, end), revolutions, sums.samples)


def edge_weight(revolution: Array, first: int, last: int) -> Array:
    """Weight of the regression at a count of revolutions between `first` and `last`: 1 but for the ends."""
    edge = min(float(EDGE_REVOLUTIONS), (last - first) / 4)
    u = np.clip(np.minimum(revolution - first, last - revolution) / edge, 0.0, 1.0)
    return np.asarray(u**3 * np.polyval(EDGE_POLYNOMIAL[::-1], u))


def _signal_names(run: Run) -> tuple[str, ...]:
    return run.channel_names + (COMPONENTS if run.has_loads else ())


def _check_interval(run: Run, azimuth: Azimuth, n: int, first: int, last: int) -> None:
    assert run.sample_rate is not None
    if not 0 <= first < last <= azimuth.turns or last - first < FEWEST_REVOLUTIONS:
        fault = f"revolutions {first} to {last} of {azimuth.turns}: at least {FEWEST_REVOLUTIONS} are needed"
        raise UserError(fault, str(run.path or run.name), "rotor/pulse_times", "Record for longer")


def _harmonics_to_fit(run: Run, azimuth: Azimuth, n: int, start: float, end: float) -> int:
    assert run.sample_rate is not None
    fastest = float(np.max(azimuth.speed(np.linspace(start, end, 2048))))
    possible = int(BELOW_NYQUIST * run.sample_rate / 2 / fastest)
    if possible < n:
        fault = f"harmonic {n} at {n * fastest:.1f} Hz is beyond half the sample rate, {run.sample_rate:g} Hz"
        raise UserError(fault, str(run.path or run.name), "sample_rate", f"Ask for at most {possible} harmonics")
    return min(possible, max(FITTED_HARMONICS, n + 4))


def _weighted_blocks(
    run: Run, azimuth: Azimuth, names: tuple[str, ...], revolutions: tuple[int, int], block: int
) -> Iterator[_AzimuthBlock]:
    assert run.sample_rate is not None
    first, last = revolutions
    start, end = azimuth.time_of(np.array(revolutions))
    begin, stop = int(np.ceil(start * run.sample_rate)), int(np.floor(end * run.sample_rate)) + 1
    for low in range(begin, min(stop, run.samples), block):
        high = min(low + block, stop, run.samples)
        signals = _read_signals(run, names, low, high)
        time = np.clip(np.arange(low, high) / run.sample_rate, azimuth.first, azimuth.last)
        psi = azimuth.psi(time)
        revolution = psi / (2 * np.pi)
        fraction = np.clip((revolution - first) / (last - first), 0.0, 1.0)
        yield _AzimuthBlock(psi, azimuth.speed(time), fraction, edge_weight(revolution, first, last), signals)


def _read_signals(run: Run, names: tuple[str, ...], low: int, high: int) -> Array:
    """Samples (m, c) of the named channels and load components."""
    read = run.read(low, high)
    stacked = read.channels if read.loads is None else np.hstack([read.channels, read.loads])
    known = _signal_names(run)
    signals = np.asarray(stacked[:, [known.index(name) for name in names]], float)
    if not np.all(np.isfinite(signals)):
        bad = names[int(np.flatnonzero(~np.all(np.isfinite(signals), axis=0))[0])]
        remedy = "Leave the channel out"
        raise UserError("samples are not finite", str(run.path or run.name), f"channel {bad}", remedy)
    return signals


def _empty_sums(n: int, fitted_count: int, offsets: Array, count: int) -> _NormalEquations:
    columns = 2 * fitted_count + 1
    lines = np.zeros((n + 1, len(offsets), count), complex)
    return _NormalEquations(np.zeros((columns, columns)), np.zeros((columns, count)), lines, np.zeros(4))


def _trigonometric_basis(psi: Array, fitted_count: int) -> Array:
    """cos(0..fitted psi), sin(1..fitted psi): (m, 2 fitted + 1)."""
    angle = np.outer(psi, np.arange(fitted_count + 1))
    return np.hstack([np.cos(angle), np.sin(angle[:, 1:])])


def _accumulate_block(sums: _NormalEquations, samples: _AzimuthBlock, n: int, fitted_count: int, orders: Array) -> None:
    """Adds one block. Lines are integrals over azimuth, d psi = 2 pi speed dt, where harmonics are orthogonal."""
    basis = _trigonometric_basis(samples.psi, fitted_count)
    weighted = basis * samples.weight[:, None]
    sums.gram += weighted.T @ basis
    sums.moment += weighted.T @ samples.signals
    q = blackman_taper(samples.fraction) * samples.speed
    away = np.exp(-1j * np.outer(orders, samples.psi)) * q
    for k in range(n + 1):
        sums.lines[k] += away @ (samples.signals * np.exp(-1j * k * samples.psi)[:, None])
    w = samples.weight
    sums.weight += [np.sum(w), np.sum(w**2), np.sum(q), np.sum(q**2)]
    sums.samples += len(w)


def _solve_amplitudes(sums: _NormalEquations, n: int, fitted_count: int) -> ComplexArray:
    """X_k = cosine_k - j sine_k (n+1, c) from the normal equations."""
    coefficients = np.linalg.solve(sums.gram, sums.moment)
    amplitude = coefficients[: n + 1].astype(complex)
    amplitude[1:] -= 1j * coefficients[fitted_count + 1 : fitted_count + 1 + n]
    return amplitude


def _amplitude_covariance(sums: _NormalEquations, n: int, offsets: Array) -> tuple[ComplexArray, Array]:
    """Covariance (n+1, c, c) of the amplitudes and its degrees of freedom (n+1,)."""
    w, w2, q, q2 = sums.weight
    # A tapered sum over noise of density S has variance S sum q^2; so has the regression with w in place of q.
    variance_ratio = (w2 / w**2) / (q2 / q**2)
    lines = sums.lines * (2.0 / q)
    pooled = [_mean_noise(lines[0], offsets)]
    pooled += [pooled_noise(lines[k], offsets) for k in range(1, n + 1)]
    covariance = variance_ratio * np.array([noise.covariance for noise in pooled])
    return covariance, np.array([noise.dof for noise in pooled])


def _mean_noise(lines: ComplexArray, offsets: Array) -> PooledNoise:
    """Noise of harmonic 0: real, from the lines of one side (the other is its mirror image), 1/f drift allowed for.

    A mean is 2/N of nothing: X_0 is half of what the formula for k >= 1 gives. Where the spectrum of a signal falls
    from line to line by more than chance, as that of a drift does, its power law is followed down to the mean.
    """
    above = (offsets > 0) & (offsets <= MEAN_NOISE_LINES)
    pooled = pooled_noise(lines[above] / 2.0, offsets[above])
    rise = np.sqrt(_power_law_factor(np.abs(lines[above]) ** 2, offsets[above]))
    covariance = pooled.covariance.real * np.outer(rise, rise)
    return PooledNoise(covariance.astype(complex), pooled.dof)


def _power_law_factor(power: Array, lines: Array) -> Array:
    """Factor (c,) by which the power at the mean exceeds the mean power of the lines, from a fitted power law."""
    moved = np.any(power > 0, axis=0)
    x = np.log(lines) - np.mean(np.log(lines))
    slope = x @ np.log(np.where(moved, power, 1.0) + np.finfo(float).tiny) / (x @ x)
    # The logarithm of an exponential variable scatters by pi/sqrt(6); the taper correlates about two lines.
    error = np.pi / np.sqrt(6.0) * np.sqrt(2.27 / (x @ x))
    slope = np.where(moved & (slope < -SLOPE_SIGNIFICANCE * error) & (slope > STEEPEST_EXPONENT), slope, 0.0)
    law = (lines[:, None] / MEAN_LINE_OFFSET) ** slope
    return np.asarray(1.0 / np.mean(law, axis=0))
