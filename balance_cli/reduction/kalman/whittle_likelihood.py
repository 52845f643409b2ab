"""Variances of random loads by maximum likelihood of the innovations of a record.

For a stationary model that likelihood is, except for effects of the ends of the record, Whittle's: with the spectral
density

    Phi(f) = sum_j v_j s_j(f) t_j(f) t_j(f)* + step diag(v_c)

of the channels (t_j the response to one load, s_j the shape of a layer, v_j its variance, v_c those of the channels,
which are known from frequencies above all loads)

    -2 ln L = N sum_f [ln det Phi + trace(Phi^-1 Phi_measured)] df / rate

because ln det Phi and the trace average to ln det S and e' S^-1 e of the innovations (Kolmogorov and Szego; Whittle, J.
R. Stat. Soc. B 15, 1953, 125). Every load term of Phi has rank one, so that gradient and information consist of forms
t_j* Phi^-1 t_k.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.cross_spectra import CrossSpectra

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

INDEPENDENT_PER_BIN = 0.37
"""Independent information of a frequency bin, correlated with its neighbors: n samples then count as n / 2 bins."""
MAX_ITERATIONS = 40
"""Scoring steps at most; the tolerances below usually end the iteration."""
LN_VARIANCE_TOLERANCE = 1e-2
"""Change of ln variance at which the iteration ends: 0.5 % of a standard deviation, which needs no more precision."""
LOG_LIKELIHOOD_TOLERANCE = 0.1
"""Gain of ln L below which the iteration ends: one standard error changes ln L by 0.5."""
LONGEST_STEP = 2.0
"""Largest step of ln variance, a factor of seven: the quadratic approximation does not hold beyond."""
NEGLIGIBLE_DENSITY = 1e-3
"""Density over that of the noise at which a load has no effect: the lower bound of its variance."""


@dataclass(frozen=True)
class LayerVariances:
    """Variances `values` (l, m) of the layers of each load, and `misfit`, -ln L at them up to a constant."""

    values: Array
    misfit: float


def estimate_layer_variances(
    spectra: CrossSpectra,
    response: ComplexArray,
    shapes: Array,
    step: float,
    noise: Array,
    start: Array | None = None,
) -> LayerVariances:
    """Estimate the variances of the layers of each load by maximum likelihood, with Fisher scoring in ln v.

    `response` (k, c, m): volts per load in the frequency bins; `shapes` (l, k): densities of the layers for unit
    variance; `noise` (c,): variance of one sample of each channel; `start` (l, m): initial variances. Six combinations
    of the channels contain all information about six loads, so that only these are used.
    """
    size = np.sqrt(step * noise)
    Q, response = np.linalg.qr(response / size[:, None])
    reduced = Q.conj().swapaxes(1, 2) @ (spectra.density / np.outer(size, size)) @ Q
    terms = np.concatenate([response * np.sqrt(shape)[:, None, None] for shape in shapes], axis=2)
    likelihood = _WhittleLikelihood(reduced, terms, INDEPENDENT_PER_BIN * spectra.averages)
    largest, least = _variance_bounds(reduced, terms)
    initial = 0.1 * largest if start is None else start.ravel()
    ln_v = _maximize_likelihood(likelihood, np.log(np.maximum(initial, least)), np.log(least))
    return LayerVariances(np.exp(ln_v).reshape(len(shapes), -1), likelihood.at(ln_v)[0])


def _variance_bounds(density: ComplexArray, terms: ComplexArray) -> tuple[Array, Array]:
    """Return the largest and the least variance (j,) of each term.

    With the largest the term alone explains the power of any bin; with the least it nowhere exceeds
    `NEGLIGIBLE_DENSITY` of the noise.
    """
    power = np.einsum("kcc->k", density).real
    term_power = np.maximum(np.sum(np.abs(terms) ** 2, axis=1), 1e-300)
    return np.max(power[:, None] / term_power, axis=0), NEGLIGIBLE_DENSITY / np.max(term_power, axis=0)


def _maximize_likelihood(likelihood: _WhittleLikelihood, ln_v: Array, lower: Array) -> Array:
    """Return ln v (j,) of the maximum, from the initial `ln_v` on and not below `lower`."""
    value, gradient, information = likelihood.at(ln_v)
    damping = 1e-3  # Levenberg-Marquardt, relative to the diagonal of the information
    for _ in range(MAX_ITERATIONS):
        trial = np.maximum(ln_v + _scoring_step(gradient, information, damping, ln_v <= lower), lower)
        at_trial = likelihood.at(trial)
        if at_trial[0] > value:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        change, gain, damping = float(np.abs(trial - ln_v).max()), value - at_trial[0], damping / 10.0
        ln_v, (value, gradient, information) = trial, at_trial
        if change < LN_VARIANCE_TOLERANCE or gain < LOG_LIKELIHOOD_TOLERANCE:
            break
    return ln_v


def _scoring_step(gradient: Array, information: Array, damping: float, at_bound: NDArray[np.bool_]) -> Array:
    """Return the step in ln v; a variance at its lower bound is fixed if the step would lower it."""
    free = ~(at_bound & (gradient > 0))
    size = np.sqrt(np.diag(information)) + 1e-300
    scaled = information[np.ix_(free, free)] / np.outer(size[free], size[free])
    step = np.zeros_like(gradient)
    step[free] = -np.linalg.solve(scaled + damping * np.eye(free.sum()), gradient[free] / size[free]) / size[free]
    return np.clip(step, -LONGEST_STEP, LONGEST_STEP)


@dataclass(frozen=True)
class _WhittleLikelihood:
    """Likelihood of measured densities (k, m, m), given noise of unit density and load terms (k, m, j)."""

    measured: ComplexArray
    terms: ComplexArray
    averages: Array

    def at(self, ln_v: Array) -> tuple[float, Array, Array]:
        """Return -ln L, its gradient (j,) and information (j, j) in ln v."""
        scaled = self.terms * np.exp(0.5 * ln_v)
        Phi = scaled @ scaled.conj().swapaxes(1, 2) + np.eye(scaled.shape[1])
        inverse = np.linalg.inv(Phi)
        weighted = inverse @ scaled
        value = np.linalg.slogdet(Phi)[1] + np.einsum("kab,kba->k", inverse, self.measured).real
        expected = np.sum(scaled.conj() * weighted, axis=1).real
        observed = np.sum(weighted.conj() * (self.measured @ weighted), axis=1).real
        products = scaled.conj().swapaxes(1, 2) @ weighted
        n = self.averages
        information = np.einsum("k,kij->ij", n, products.real**2 + products.imag**2)
        return float(n @ value), n @ (expected - observed), information
