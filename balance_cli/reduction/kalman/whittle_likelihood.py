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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.cross_spectra import CrossSpectra

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

INDEPENDENT_PER_BIN = 0.37
"""What a line tells that its neighbours do not: so much that n samples make n / 2 independent lines in all."""
MAX_ITERATIONS = 40
LN_VARIANCE_TOLERANCE = 1e-2
"""Change of ln variance at which the maximum is reached; sizes need no more."""
LOG_LIKELIHOOD_TOLERANCE = 0.1
"""Gain in -ln L that a further step is worth."""
LONGEST_STEP = 2.0
NEGLIGIBLE_DENSITY = 1e-3
"""Density over that of the noise at which a load does nothing any more."""


@dataclass(frozen=True)
class LayerVariances:
    """`values` (l, m) of the layers of each load, and -ln L at them, up to a constant."""

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
    """Variances of the layers of each load that make the spectra most likely, by Fisher scoring in ln v.

    `response` (k, c, m) volts per load at the lines, `shapes` (l, k) densities of the layers for unit variance, `noise`
    (c,) variance of a channel's sample, `start` (l, m) variances to begin with. Six combinations of the channels hold
    all that there is of six loads, so that only these are looked at.
    """
    size = np.sqrt(step * noise)
    Q, response = np.linalg.qr(response / size[:, None])
    reduced = Q.conj().swapaxes(1, 2) @ (spectra.density / np.outer(size, size)) @ Q
    terms = np.concatenate([response * np.sqrt(shape)[:, None, None] for shape in shapes], axis=2)
    likelihood = _WhittleLikelihood(reduced, terms, INDEPENDENT_PER_BIN * spectra.averages)
    largest, least = _variance_bounds(reduced, terms)
    begun = 0.1 * largest if start is None else start.ravel()
    ln_v = _maximize_likelihood(likelihood, np.log(np.maximum(begun, least)), np.log(least))
    return LayerVariances(np.exp(ln_v).reshape(len(shapes), -1), likelihood.at(ln_v)[0])


def _variance_bounds(density: ComplexArray, terms: ComplexArray) -> tuple[Array, Array]:
    """Variances (j,) of each term that alone would have all the power that is there, in the best of cases; and that

    at which it is nowhere more than `NEGLIGIBLE_DENSITY` of the noise.
    """
    power = np.einsum("kcc->k", density).real
    own = np.maximum(np.sum(np.abs(terms) ** 2, axis=1), 1e-300)
    return np.max(power[:, None] / own, axis=0), NEGLIGIBLE_DENSITY / np.max(own, axis=0)


def _maximize_likelihood(likelihood: _WhittleLikelihood, ln_v: Array, lower: Array) -> Array:
    """Where the likelihood is largest, from `ln_v` (j,) on and not below `lower`."""
    value, gradient, information = likelihood.at(ln_v)
    damping = 1e-3
    for _ in range(MAX_ITERATIONS):
        change = _scoring_step(gradient, information, damping, ln_v <= lower)
        tried = np.maximum(ln_v + change, lower)
        found = likelihood.at(tried)
        if found[0] > value:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        moved, gained, damping = float(np.abs(tried - ln_v).max()), value - found[0], damping / 10.0
        ln_v, (value, gradient, information) = tried, found
        if moved < LN_VARIANCE_TOLERANCE or gained < LOG_LIKELIHOOD_TOLERANCE:
            break
    return ln_v


def _scoring_step(gradient: Array, information: Array, damping: float, held: NDArray[np.bool_]) -> Array:
    """Step in ln v; a variance at its bound stays where it would go further down."""
    free = ~(held & (gradient > 0))
    size = np.sqrt(np.diag(information)) + 1e-300
    scaled = information[np.ix_(free, free)] / np.outer(size[free], size[free])
    step = np.zeros_like(gradient)
    step[free] = -np.linalg.solve(scaled + damping * np.eye(free.sum()), gradient[free] / size[free]) / size[free]
    return np.clip(step, -LONGEST_STEP, LONGEST_STEP)


@dataclass(frozen=True)
class _WhittleLikelihood:
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
