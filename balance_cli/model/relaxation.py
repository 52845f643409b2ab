"""A chain of relaxations: structural damping as a passive system in the time domain.

    h(s) = sum_i g_i s / (s + a_i) - g_0,        g_i >= 0,

follows j + (2 / pi) ln(f / f0), f0 = 1, over a band: the complex stiffness that a causal spring of
unit loss factor has in addition to its static one (Makris, J. Eng. Mech. 123, 1997, 1209-1214). Each term is a spring
in series with a dashpot, so the chain is passive. Below the band it relaxes to -g_0; above the band its stiffness is
constant. Frequencies are in units of the one at which the spring has its static stiffness.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

BAND = (0.02, 40.0)
"""Frequencies, relative to f0, at which the chain follows the law: rotor and modes are within a factor of ten of f0."""

RATES_PER_DECADE = 2
"""Relaxations per decade: one each half decade, so that neighboring relaxations overlap."""
BAND_MARGIN = 6.0
"""Factor by which the rates extend beyond the band: relaxations outside it determine the law at its ends."""


@dataclass(frozen=True)
class RelaxationChain:
    """rates a (r,), strengths g (r,) and relaxed = g_0, all per unit loss factor."""

    rates: Array
    strengths: Array
    relaxed_decrement: float

    @property
    def instantaneous_increment(self) -> float:
        """Increase of the stiffness at infinite frequency, sum_i g_i - g_0."""
        return float(self.strengths.sum() - self.relaxed_decrement)

    def transfer_function(self, s: ArrayLike) -> ComplexArray:
        """h(s) (k,) at s (k,), relative to 2 pi f0."""
        value = np.asarray(s, complex)[..., None]
        return np.asarray((value / (value + self.rates)) @ self.strengths - self.relaxed_decrement)


def hysteretic_law(frequency: ArrayLike) -> ComplexArray:
    """The law j + (2 / pi) ln(f / f0) (k,) at `frequency` (k,), relative to f0, all above zero."""
    return np.asarray(1j + 2 / np.pi * np.log(np.asarray(frequency, float)))


@cache
def relaxation_chain() -> RelaxationChain:
    """The chain nearest to the law, by nonnegative least squares over the band, with Re h = 0 at f0.

    Lawson and Hanson, Solving Least Squares Problems, 1974, chapter 23.
    """
    lowest, highest = BAND[0] / BAND_MARGIN, BAND[1] * BAND_MARGIN
    rates = np.geomspace(lowest, highest, round(RATES_PER_DECADE * np.log10(highest / lowest)) + 1)
    frequency = np.geomspace(*BAND, 40 * len(rates))
    terms = _relaxation_terms(frequency, rates)
    at_reference = _relaxation_terms(np.ones(1), rates)[0].real
    centered, law = terms - at_reference, hysteretic_law(frequency)
    from scipy.optimize import nnls

    strengths, _ = nnls(np.concatenate([centered.real, centered.imag]), np.concatenate([law.real, law.imag]))
    used = strengths > 0
    return RelaxationChain(rates[used], strengths[used], float(at_reference @ strengths))


def _relaxation_terms(frequency: Array, rates: Array) -> ComplexArray:
    """Terms s / (s + a) (k, r) at s = j times `frequency` (k,), relative to f0."""
    s = 1j * frequency[:, None]
    return np.asarray(s / (s + rates))
