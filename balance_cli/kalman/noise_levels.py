"""How large the loads and the channels' noise are: the likelihood of a record's innovations.

For a stationary model that likelihood is, but for the ends of the record, Whittle's: with the spectral density

    Phi(f) = sum_j v_j s_j(f) t_j(f) t_j(f)* + step diag(v_c)

of the channels (t_j the response to one load, s_j the shape of a layer, v_j its variance, v_c those of the channels,
that are known from where no load reaches)

    -2 ln L = N sum_f [ln det Phi + trace(Phi^-1 Phi_measured)] df / rate

for ln det Phi and the trace average to ln det S and e' S^-1 e of the innovations (Kolmogorov and Szego; Whittle, J. R.
Stat. Soc. B 15, 1953, 125). Every term of Phi has rank one, so that gradient and information are forms t_j* Phi^-1 t_k.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import scipy.signal
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MAIN_LOBE = 4
"""Lines from the centre of the window's main lobe to its edge."""
INDEPENDENT = 0.89
"""Independent spectra for each window, of those that lie a third of their length apart."""
OWN = 0.37
"""What a line tells that its neighbours do not: so much that n samples make n / 2 independent lines in all."""
STEPS = 40
SETTLED = 1e-2
"""Change of ln variance at which the maximum is reached; sizes need no more."""
WORTH = 0.1
"""Gain in -ln L that a further step is worth."""
LONGEST_STEP = 2.0
LEAST = 1e-3
"""Density over that of the noise at which a load does nothing any more."""


@dataclass(frozen=True)
class CrossSpectra:
    """Densities of c channels: `frequency` (k,) [Hz], `density` (k, c, c) [V2/Hz], both signs of frequency counted.

    `averages` (k,): how many independent spectra were averaged.
    """

    frequency: Array
    density: ComplexArray
    averages: Array

    def at(self, kept: NDArray[np.bool_]) -> CrossSpectra:
        """Some of the lines."""
        return CrossSpectra(self.frequency[kept], self.density[kept], self.averages[kept])


def cross_spectra(
    parts: Iterable[tuple[int, Array]],
    step: float,
    length: int,
    used: Callable[[int, Array], NDArray[np.bool_]] | None = None,
) -> CrossSpectra:
    """Welch's estimate with windows of `length` samples over stretches (first sample, samples (n, c)) without gaps.

    Means of each window are taken off, the lines beside zero and half the sample rate left out (Welch, IEEE Trans.
    Audio Electroacoust. 15, 1967, 70). `used` says, for the first sample of a window and the frequencies (k,), which
    lines of that window count: a harmonic that moves with the speed can be kept out window by window. The window is
    that of Blackman and Harris (four terms), whose side lobes lie 92 dB down.
    """
    window = scipy.signal.windows.blackmanharris(length, sym=False)
    frequency = np.asarray(np.fft.rfftfreq(length, step), float)
    inner = (np.arange(len(frequency)) >= MAIN_LOBE) & (np.arange(len(frequency)) < len(frequency) - MAIN_LOBE)
    total, count = None, np.zeros(len(frequency))
    for first, part in parts:
        for start in range(0, len(part) - length + 1, length // 3):
            piece = part[start : start + length]
            lines = np.fft.rfft((piece - piece.mean(axis=0)) * window[:, None], axis=0)
            mine = inner if used is None else inner & used(first + start, frequency)
            lines[~mine] = 0.0
            power = lines[:, :, None] * lines[:, None, :].conj()
            total = power if total is None else total + power
            count += mine
    kept = count > 0
    if total is None or not kept.any():
        raise ValueError("no window fits into the stretches")
    density = total[kept] * (step / np.sum(window**2) / count[kept])[:, None, None]
    return CrossSpectra(frequency[kept], density, np.maximum(INDEPENDENT * count[kept], 1.0))


def noise_of_channels(spectra: CrossSpectra, step: float, quiet: NDArray[np.bool_]) -> Array:
    """Covariance (c,) [V2] of one sample of each channel's noise, white, from `quiet` lines (k,), that no load reaches.

    The median of the lines, so that a tone among them does no harm.
    """
    power = np.einsum("kcc->kc", spectra.density[quiet]).real
    typical = float(np.median(spectra.averages[quiet]))
    return np.asarray(np.median(power, axis=0) / (step * _median_of_mean(typical)))


def _median_of_mean(averages: float) -> float:
    """Median of the mean of so many exponential variables of mean one."""
    from scipy.special import gammaincinv

    return float(gammaincinv(averages, 0.5) / averages)


@dataclass(frozen=True)
class Variances:
    """`values` (l, m) of the layers of each load, and -ln L at them, up to a constant."""

    values: Array
    misfit: float


def most_likely_variances(
    spectra: CrossSpectra,
    response: ComplexArray,
    shapes: Array,
    step: float,
    noise: Array,
    start: Array | None = None,
) -> Variances:
    """Variances of the layers of each load that make the spectra most likely, by Fisher scoring in ln v.

    `response` (k, c, m) volts per load at the lines, `shapes` (l, k) densities of the layers for unit variance, `noise`
    (c,) variance of a channel's sample, `start` (l, m) variances to begin with. Six combinations of the channels hold
    all that there is of six loads, so that only these are looked at.
    """
    size = np.sqrt(step * noise)
    Q, response = np.linalg.qr(response / size[:, None])
    reduced = Q.conj().swapaxes(1, 2) @ (spectra.density / np.outer(size, size)) @ Q
    terms = np.concatenate([response * np.sqrt(shape)[:, None, None] for shape in shapes], axis=2)
    likelihood = _Likelihood(reduced, terms, OWN * spectra.averages)
    largest, least = _largest(reduced, terms)
    begun = 0.1 * largest if start is None else start.ravel()
    ln_v = _maximum(likelihood, np.log(np.maximum(begun, least)), np.log(least))
    return Variances(np.exp(ln_v).reshape(len(shapes), -1), likelihood.at(ln_v)[0])


def _largest(density: ComplexArray, terms: ComplexArray) -> tuple[Array, Array]:
    """Variances (j,) of each term that alone would have all the power that is there, in the best of cases; and that

    at which it is nowhere more than `LEAST` of the noise.
    """
    power = np.einsum("kcc->k", density).real
    own = np.maximum(np.sum(np.abs(terms) ** 2, axis=1), 1e-300)
    return np.max(power[:, None] / own, axis=0), LEAST / np.max(own, axis=0)


def _maximum(likelihood: _Likelihood, ln_v: Array, lower: Array) -> Array:
    """Where the likelihood is largest, from `ln_v` (j,) on and not below `lower`."""
    value, gradient, information = likelihood.at(ln_v)
    damping = 1e-3
    for _ in range(STEPS):
        change = _step(gradient, information, damping, ln_v <= lower)
        tried = np.maximum(ln_v + change, lower)
        found = likelihood.at(tried)
        if found[0] > value:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        moved, gained, damping = float(np.abs(tried - ln_v).max()), value - found[0], damping / 10.0
        ln_v, (value, gradient, information) = tried, found
        if moved < SETTLED or gained < WORTH:
            break
    return ln_v


def _step(gradient: Array, information: Array, damping: float, held: NDArray[np.bool_]) -> Array:
    """Step in ln v; a variance at its bound stays where it would go further down."""
    free = ~(held & (gradient > 0))
    size = np.sqrt(np.diag(information)) + 1e-300
    scaled = information[np.ix_(free, free)] / np.outer(size[free], size[free])
    step = np.zeros_like(gradient)
    step[free] = -np.linalg.solve(scaled + damping * np.eye(free.sum()), gradient[free] / size[free]) / size[free]
    return np.clip(step, -LONGEST_STEP, LONGEST_STEP)


@dataclass(frozen=True)
class _Likelihood:
    """Of densities (k, m, m), measured with noise of unit density, when terms (k, m, j) make up the rest."""

    measured: ComplexArray
    terms: ComplexArray
    averages: Array

    def at(self, ln_v: Array) -> tuple[float, Array, Array]:
        """-ln L, its gradient (j,) and information (j, j) in ln v."""
        scaled = self.terms * np.exp(0.5 * ln_v)
        Phi = scaled @ scaled.conj().swapaxes(1, 2) + np.eye(scaled.shape[1])
        inverse = np.linalg.inv(Phi)
        weighted = inverse @ scaled
        value = np.linalg.slogdet(Phi)[1] + np.einsum("kab,kba->k", inverse, self.measured).real
        own = np.sum(scaled.conj() * weighted, axis=1).real
        told = np.sum(weighted.conj() * (self.measured @ weighted), axis=1).real
        crossed = scaled.conj().swapaxes(1, 2) @ weighted
        n = self.averages
        information = np.einsum("k,kij->ij", n, crossed.real**2 + crossed.imag**2)
        return float(n @ value), n @ (own - told), information
