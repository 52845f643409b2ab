"""Loads from readings by iteration, and a proof that the iteration converges.

Readings r = C1 x + C2 h(x) of loads x in units of the calibrated range; with W C1 = 1 the iteration is

    x <- W (r - C2 h(x)).

Over |x_j| <= reach_j the derivative of the right side is bounded, element by element, by M = |W C2| max |dh/dx|,
because every derivative of a term grows with the size of the loads. M is nonnegative. If its spectral radius rho is
below 1, the iteration is a contraction with factor rho in the norm max |x_i| / v_i, where v is the Perron vector of M,
and the solution is unique (Banach). For a load within the calibrated range the first error is at most
e = |W C2| |h(1)|, and the n-th at most M^n e, element by element. The errors are therefore bounded by
(1 - M)^-1 e = e + M e + ... and by the ball of radius |e| in the norm above. The smaller bound of each component gives
the reach over which M must be taken. (The ball is wide where a load hardly contributes to the slowest direction, the
sum where rho is close to 1.)

AIAA R-091A-2020, section 3, uses this iteration; the proof is given in docs/theory/calibration-model.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.terms import Term, largest_derivatives, term_values

Array = NDArray[np.float64]

EXTRAPOLATION_MARGIN = 1.1
"""Loads up to this multiple of the calibrated range are accepted and flagged; the proof includes them."""
REACH_ITERATIONS = 50
"""Upper bound on the extensions of the reach; the search ends when the reach is consistent or rho is 1 or more."""
LOAD_ITERATIONS = 200
"""At most so many load iterations: a contraction of 0.87 reaches the tolerance; a slower one is not accepted."""
LOAD_TOLERANCE = 1e-12
"""Largest last step, in units of the calibrated range: rounding of the readings, far below any noise."""


@dataclass(frozen=True)
class Contraction:
    """Contraction factor `rho` of the iteration within `reach` (n,), loads in units of the calibrated range.

    `rho` is infinite where no reach was found: convergence is then not proved.
    """

    rho: float
    reach: Array

    @property
    def is_proved(self) -> bool:
        """Whether the iteration converges for every load within EXTRAPOLATION_MARGIN times the calibrated range."""
        return self.rho < 1.0


def contraction(nonlinear_matrix: Array, terms: Sequence[Term], size: int) -> Contraction:
    """Bound the iteration for `nonlinear_matrix` = W C2 (n, q), apparent loads of q nonlinear terms; `size` is n."""
    if not terms:
        return Contraction(0.0, np.full(size, EXTRAPOLATION_MARGIN))
    apparent = np.abs(nonlinear_matrix)
    first = apparent @ np.abs(term_values(terms, np.full((1, size), EXTRAPOLATION_MARGIN)))[0]
    reach = EXTRAPOLATION_MARGIN + first
    for _ in range(REACH_ITERATIONS):
        M = apparent @ largest_derivatives(terms, reach)
        rho, v = _perron_root(M)
        if rho >= 1.0:
            break
        wider = EXTRAPOLATION_MARGIN + np.minimum(np.linalg.solve(np.eye(size) - M, first), v * np.max(first / v))
        if np.all(wider <= reach * (1.0 + 1e-9)):
            return Contraction(rho, reach)
        reach = np.maximum(reach, wider)
    return Contraction(float("inf"), reach)


def _perron_root(M: Array) -> tuple[float, Array]:
    """Bound the spectral radius rho of a nonnegative matrix; also returns v > 0 (n,) with M v <= rho v."""
    # A small positive addition to all elements can only increase rho, and makes v positive (Perron).
    values, vectors = np.linalg.eig(M + 1e-9 * max(float(M.max()), 1e-9))
    k = int(np.argmax(values.real))
    v = np.abs(vectors[:, k].real)
    return float(values[k].real), np.asarray(v / v.max())


def iterate_loads(
    linear_loads: Array, nonlinear_matrix: Array, terms: Sequence[Term]
) -> tuple[Array, NDArray[np.bool_]]:
    """Solve x = `linear_loads` - `nonlinear_matrix` h(x) for the loads x (m, n); `linear_loads` (m, n) is W r.

    Returns the loads and which rows (m,) converged.
    """
    x = linear_loads.copy()
    converged = np.zeros(len(x), bool)
    for _ in range(LOAD_ITERATIONS):
        with np.errstate(over="ignore", invalid="ignore"):
            new = linear_loads - term_values(terms, x) @ nonlinear_matrix.T
            converged = np.max(np.abs(new - x), axis=1, initial=0.0) < LOAD_TOLERANCE
        x = new
        if converged.all():
            break
    return x, converged
