"""Eigenfrequencies of a balance from a record of its operation: what turbulence leaves between the rotor harmonics.

Turbulence drives the balance with a spectrum that is flat across the width of a mode. Weighted by the shapes of the
modes as the channels read them (a modal filter), the channels give one signal for each mode, whose power near the mode
is that of an oscillator above a floor. Frequency, damping, force and floor are those of the greatest Whittle likelihood
of the periodogram (Whittle, J. R. Stat. Soc. B 15, 1953, 125); its curvature gives sigma, as in the frequency-domain
identification of buildings (Yuen and Katafygiotis, J. Eng. Mech. 127, 2001, 1130; Au, Mech. Syst. Signal Process. 48,
2014, 15). Harmonics of the rotor and other lines are left out bin by bin, so that a mode beside a harmonic is told less
well, not wrongly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import read_channels
from balance_cli.campaign.rig.geometry import Acquisition
from balance_cli.model.system import System
from balance_cli.model.transient_modes import transient_modes
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.signals.channel_noise import CleanRecord, channel_noise
from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.signals.rotor.spectral_floor import row_medians
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

BAND = 0.06
"""Half-width of the band around a mode of the model, over its frequency: a stiffness may change by 12 %."""
BAND_IN_WIDTHS = 6.0
"""The same in half-bandwidths of the mode, where that is more: the floor must show beside the peak."""
FEWEST_BINS = 40
"""Bins of a band at least: ten for each of the four parameters."""
NEIGHBORS = 1.0
"""Modes up to so many times the frequency away from it are filtered out of the signal of a mode: the flanks of those
within half of that alone left a bias of 0.1 % in a mode with a damping ratio of 1 %."""
LEAST_SEPARATION = 0.1
"""Singular value of the shapes of neighboring modes, over the largest, below which they are not told apart."""
WINDOW_SHAPE = 20.0
"""Of the window of Kaiser: side lobes at -155 dB (sinh(20)/(0.217 20)). Harmonics stand 120 dB above the noise of a bin
in a record of 30 s with 24 bits, and with side lobes at -92 dB their flank passed for a mode that had moved by 5 %."""
LINE_BINS = float(np.hypot(1.0, WINDOW_SHAPE / np.pi)) + 1.0
"""Bins on either side of a harmonic or another line that are left out: the main lobe of the window and one more."""
HIGHEST_ORDER = 64
"""Harmonics of a rotor that are left out; those above are weak, and beyond most balances."""
LINE_TO_MEDIAN = 100.0
"""Power of a bin over the median of its neighbors from which it is a line: noise reaches 20, a mode three bins wide
10."""
MEDIAN_BINS = 17
DAMPING_SIGMA = 0.7
"""Prior standard deviation of the logarithm of the damping ratio: air and running drives double or halve it."""
SIGNIFICANT_GAIN = 24.0
"""Twice the gain of log-likelihood over a flat spectrum from which a mode shows: p = 1e-4 with four places of the
frequency to choose from (chi-square, three degrees of freedom). A drift is a matter of many runs."""
LARGEST_SIGMA = 0.01
"""Relative standard deviation of a frequency beyond which the mode does not show."""
INNER_SHARE = 0.85
"""Share of the band within which a frequency is accepted: at its edge the flank of another mode looks like one."""
GRID, ITERATIONS = 61, 40
CONVERGED = 1e-3
"""Gain of log-likelihood in a step of the fit below which it ends: it moves the frequency by a twentieth of sigma."""
RIDGE = 1e-9
"""Of the information, so that it is regular where the floor or the force vanishes; steps change by no more than it."""
USUAL_DAMPING = 0.01
"""Damping ratio of a mode where that of the model is not known."""
_WINDOW = np.kaiser(512, WINDOW_SHAPE)
TAPER_FACTOR = float(512 * np.sum(_WINDOW**4) / np.sum(_WINDOW**2) ** 2)
"""Variance of an estimate from a record under the window over that without (Dahlhaus, Ann. Stat. 16, 1988, 808)."""


@dataclass(frozen=True)
class OperationalModes:
    """Modes of one run: `predicted` (m,) [Hz] of the model at its rotor speed, `frequency` and `sigma` (m,) [Hz].

    The latter are NaN where nothing shows the mode. `damping_ratio` (m,) is that of the model.
    """

    predicted: Array
    frequency: Array
    sigma: Array
    damping_ratio: Array | float = USUAL_DAMPING


@dataclass(frozen=True)
class ModeShapes:
    """Eigenvalues s (m,) [1/s] of a balance in the upper half plane, and `volts` (c, m) of the live channels.

    `sigma` (m,) [1/s] is the standard deviation of each eigenvalue.
    """

    s: ComplexArray
    volts: ComplexArray
    sigma: Array


def operational_modes(
    record: RotorRecord, system: System, acquisition: Acquisition, azimuths: Sequence[Azimuth]
) -> OperationalModes:
    """Return the eigenfrequencies of one run, near those of a model.

    `azimuths` are those of all rotors, whose harmonics are left out. The frequency is that of the undamped oscillator.
    """
    return modes_near(record, shapes_of_model(record, system), acquisition, azimuths)


def shapes_of_model(record: RotorRecord, system: System) -> ModeShapes:
    """Return the modes of a model at the rotor speed of a record, as its live channels read them."""
    columns = [system.channel_names.index(name) for name in record.health.live]
    modes = transient_modes(system, record.spin, 0.45 * sample_rate(record.run), with_derivatives=False)
    s, volts = modes.s[: modes.oscillating], modes.volts[columns, : modes.oscillating]
    return ModeShapes(s, volts, np.zeros(len(s)))


def modes_near(
    record: RotorRecord, shapes: ModeShapes, acquisition: Acquisition, azimuths: Sequence[Azimuth]
) -> OperationalModes:
    """Return the eigenfrequencies of one run near given ones, as `operational_modes`; sigma is that of both."""
    run = record.run
    first, last = (int(t * sample_rate(run)) for t in record.spectra.interval)
    last = first + _fast_length(last - first)
    names, s = record.health.live, shapes.s
    frequency, spectra = tapered_spectra(read_channels(run, names, first, last), sample_rate(run))
    noise = np.sqrt(channel_noise(CleanRecord(run, names, ((first, last),)), acquisition))
    usable = between_harmonics(frequency, azimuths, record.spectra.interval)
    over_noise = shapes.volts / noise[:, None]
    estimates = [_estimate_mode(k, s, over_noise, noise, frequency, spectra, usable) for k in range(len(s))]
    values = np.array(estimates, float).reshape(-1, 2)
    sigma = np.hypot(values[:, 1], shapes.sigma / (2.0 * np.pi))
    return OperationalModes(np.abs(s) / (2.0 * np.pi), values[:, 0], sigma, -s.real / np.abs(s))


def _fast_length(samples: int) -> int:
    """Return the number of samples, less the last few, that has small factors alone: an FFT takes half the time."""
    from scipy.fft import next_fast_len

    return next(n for n in range(samples, 0, -1) if next_fast_len(n, real=True) == n)


def tapered_spectra(samples: Array, rate: float) -> tuple[Array, ComplexArray]:
    """Return frequencies (k,) [Hz] and the spectra (k, c) of samples (n, c) under the window of Kaiser."""
    from scipy.fft import rfft

    window = np.kaiser(len(samples), WINDOW_SHAPE)
    spectra = rfft(np.ascontiguousarray((samples - samples.mean(axis=0)).T) * window, axis=1)
    return np.asarray(np.fft.rfftfreq(len(samples), 1.0 / rate)), np.asarray(spectra.T)


def between_harmonics(
    frequency: Array, azimuths: Sequence[Azimuth], interval: tuple[float, float]
) -> NDArray[np.bool_]:
    """Return which bins (k,) no harmonic of a rotor passes."""
    usable = np.asarray(frequency > LINE_BINS * frequency[1], bool)
    for azimuth in azimuths:
        time = np.linspace(max(interval[0], azimuth.first), min(interval[1], azimuth.last), 1024)
        slowest, fastest = (float(of(azimuth.speed(time))) for of in (np.min, np.max))
        for order in range(1, min(HIGHEST_ORDER, int(frequency[-1] / slowest)) + 1):
            margin = LINE_BINS * frequency[1]
            usable &= ~((frequency > order * slowest - margin) & (frequency < order * fastest + margin))
    return usable


def _estimate_mode(
    k: int,
    s: ComplexArray,
    volts: ComplexArray,
    noise: Array,
    frequency: Array,
    spectra: ComplexArray,
    usable: NDArray[np.bool_],
) -> tuple[float, float]:
    """Return frequency and sigma [Hz] of mode k of eigenvalues s (m,) and shapes `volts` (c, m) over the noise (c,)."""
    nothing = float("nan"), float("nan")
    center, damping = float(np.abs(s[k])) / (2.0 * np.pi), float(-s[k].real / np.abs(s[k]))
    half = max(BAND, BAND_IN_WIDTHS * damping) * center
    bins = np.flatnonzero(usable & (np.abs(frequency - center) < half))
    weights = _modal_filter(k, np.abs(s), volts)
    if len(bins) < FEWEST_BINS or weights is None or half >= center:
        return nothing
    power = np.abs(spectra[bins] @ (weights / noise)) ** 2
    keep = _away_from_lines(frequency[bins], power)
    f, power = frequency[bins][keep], power[keep] / np.mean(power[keep])
    fit = fit_oscillator(f, power, center, damping, half)
    if fit is None or not abs(fit[0] - center) < INNER_SHARE * half:
        return nothing
    return fit if fit[1] < LARGEST_SIGMA * fit[0] else nothing


def _modal_filter(k: int, size: Array, volts: ComplexArray) -> ComplexArray | None:
    """Return the weights (c,) of the channels that give mode k and no neighbor of it; None where these are alike."""
    near = np.abs(size / size[k] - 1.0) < NEIGHBORS
    shapes = volts[:, near] / np.maximum(np.linalg.norm(volts[:, near], axis=0), np.finfo(float).tiny)
    U, singular, V = np.linalg.svd(shapes, full_matrices=False)
    is_separate = singular > LEAST_SEPARATION * singular[0]
    weights = (V[is_separate].conj().T / singular[is_separate]) @ U[:, is_separate].conj().T
    own = int(np.count_nonzero(near[:k]))
    return np.asarray(weights[own]) if abs(weights[own] @ shapes[:, own] - 1.0) < LEAST_SEPARATION else None


def _away_from_lines(frequency: Array, power: Array) -> NDArray[np.bool_]:
    """Return which bins (n,) hold no line, and lie beside none."""
    lines = frequency[power > LINE_TO_MEDIAN * _local_median(power)]
    distance = np.abs(frequency[:, None] - lines).min(axis=1, initial=np.inf)
    return np.asarray(distance > LINE_BINS * np.diff(frequency).min())


def _local_median(power: Array) -> Array:
    """Return the running median (n,) of a periodogram."""
    half = min(MEDIAN_BINS, len(power) - 1) // 2
    padded = np.pad(power, half, mode="reflect")
    return np.asarray(row_medians(np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)))


# ---- Whittle likelihood of an oscillator above a floor ---------------------------------------------------------------


def fit_oscillator(f: Array, power: Array, center: float, damping: float, half: float) -> tuple[float, float] | None:
    """Return the frequency and its sigma [Hz]; None where a flat spectrum does as well."""
    grid = center + np.linspace(-INNER_SHARE, INNER_SHARE, GRID) * half
    shapes = _oscillator(f, grid[:, None], damping)
    shapes /= shapes.sum(axis=1, keepdims=True)
    start = float(grid[np.argmax(shapes @ power)])
    floor = float(np.median(power))
    peak = max(float(power[np.argsort(np.abs(f - start))[:5]].mean()), 2.0 * floor)
    theta = np.log([start, damping, peak * (2.0 * damping) ** 2, floor])
    flat = -2.0 * len(f) * (1.0 + np.log(np.mean(power))) / TAPER_FACTOR
    value, gradient, information = _likelihood(theta, f, power, damping)
    for _ in range(ITERATIONS):
        step = np.linalg.solve(information + RIDGE * np.diag(np.diag(information)), gradient)
        step /= max(1.0, float(np.max(np.abs(step) / [0.02, 1.0, 2.0, 2.0])))  # of logarithms: far from the end
        scale = 1.0
        while (trial := _likelihood(theta + scale * step, f, power, damping))[0] < value and scale > 1e-4:
            scale *= 0.5
        gain = trial[0] - value
        if gain < 0:
            break
        theta, (value, gradient, information) = theta + scale * step, trial
        if gain < CONVERGED:
            break
    if 2.0 * value - flat < SIGNIFICANT_GAIN:
        return None
    frequency = float(np.exp(theta[0]))
    return frequency, frequency * float(np.sqrt(np.linalg.pinv(information)[0, 0]))


def _oscillator(f: Array, center: Array | float, damping: float) -> Array:
    """Return the power gain of an oscillator of unit stiffness."""
    u = f / center
    return np.asarray(1.0 / ((1.0 - u**2) ** 2 + (2.0 * damping * u) ** 2))


def _likelihood(theta: Array, f: Array, power: Array, prior_damping: float) -> tuple[float, Array, Array]:
    """Return the log-likelihood of ln(frequency, damping ratio, force, floor), gradient (4,) and information (4, 4)."""
    center, damping, force, floor = np.exp(theta)
    u = f / center
    gain = _oscillator(f, center, damping)
    peak = force * gain
    total = peak + floor
    by_center = 2.0 * gain * (-2.0 * (1.0 - u**2) * u**2 + (2.0 * damping * u) ** 2)
    by_damping = -2.0 * gain * (2.0 * damping * u) ** 2
    derivatives = np.stack([peak * by_center, peak * by_damping, peak, np.full(len(f), floor)]) / total
    value = -np.sum(np.log(total) + power / total) / TAPER_FACTOR
    gradient = derivatives @ (power / total - 1.0) / TAPER_FACTOR
    information = derivatives @ derivatives.T / TAPER_FACTOR
    departure = theta[1] - np.log(prior_damping)
    value -= 0.5 * (departure / DAMPING_SIGMA) ** 2
    gradient[1] -= departure / DAMPING_SIGMA**2
    information[1, 1] += 1.0 / DAMPING_SIGMA**2
    return float(value), gradient, information
