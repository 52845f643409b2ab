"""Degrees of freedom of the noise against which a gain is tested that a few lines make.

The noise of a static line is that of the reading of a load, which a few rows tell. Its variance may be far larger than
estimated, whatever the other lines tell of the variance of the whole score. With s and V the score and information of
a line along the step of the candidate, and nu degrees of freedom of its noise, the line gains

    nu ln(1 + c / nu) - nu ln(1 + (c - g) / nu),    c = s^2 / V,    g = 2 s - V,

in place of g: the log-likelihood ratio of Student's t distribution (Lange, Little and Taylor, J. Am. Stat. Assoc. 84
(1989) 881). The gain G of all lines is as significant as the sum G' of these gains where it is tested against a noise
with n degrees of freedom, n ln(1 + G / n) = G'.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.search.noise_dof import RunInformation

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def gain_dof(
    runs: Sequence[RunInformation], fitted: Index, tested: Index, projection: Array, step: Array, gain: float
) -> float:
    """Return the degrees of freedom of the noise against which the `gain` of a candidate is to be tested.

    `tested` (q,): its parameters; `projection` (f, q): change of the fitted ones with them; `step` (q,): the change of
    the candidate's that gains. Infinite where no line of the `runs` has a noise of several parts.
    """
    robust = gain
    for run in runs:
        if run.lines is not None:
            line_gain, robust_gain = _line_gains(run, fitted, tested, projection, step)
            robust += float(np.sum(robust_gain - line_gain))
    return equivalent_dof(gain, robust)


def _line_gains(
    run: RunInformation, fitted: Index, tested: Index, projection: Array, step: Array
) -> tuple[Array, Array]:
    """Gain (K,) of each line by the step, with a noise that is known and with its own degrees of freedom."""
    assert run.lines is not None and run.weighted is not None
    with_it = projection @ step
    influence = run.weighted[:, :, tested] @ step - run.lines.weighted_of_fitted @ with_it
    change = run.lines.derivatives[:, :, tested] @ step - run.lines.of_fitted @ with_it
    s = 2.0 * np.sum((np.conj(change) * run.lines.weighted_residual).real, axis=1)
    V = 2.0 * np.sum((np.conj(change) * influence).real, axis=1)
    informative = np.flatnonzero(V > 0.0)
    dof = 2.0 / np.maximum(run.line_uncertainty(influence)[informative], np.finfo(float).tiny)
    gain, chi2 = 2.0 * s[informative] - V[informative], s[informative] ** 2 / V[informative]
    return gain, dof * (np.log1p(chi2 / dof) - np.log1p((chi2 - gain) / dof))


def equivalent_dof(gain: float, robust: float) -> float:
    """Return the n of n ln(1 + gain / n) = robust; infinite where `robust` is no smaller, zero where it is nothing."""
    from scipy.optimize import brentq

    def excess(log_ratio: float) -> float:
        ratio = np.exp(log_ratio)
        return float(gain * np.log1p(ratio) / ratio - robust)

    # Of a smaller gain per degree of freedom rounding leaves no difference.
    highest = -0.5 * np.log(np.finfo(float).eps)
    lowest = -highest
    if gain <= 0.0 or excess(lowest) <= 0.0:
        return np.inf
    if excess(highest) >= 0.0:
        return 0.0
    return float(gain / np.exp(brentq(excess, lowest, highest)))
