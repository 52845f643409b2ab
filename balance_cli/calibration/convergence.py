"""Loads from outputs by iteration, and the proof that it converges.

Outputs r = C1 x + C2 h(x) of loads x in units of full range; with W C1 = 1 the iteration is

    x <- W (r - C2 h(x)).

Over |x_j| <= reach_j the derivative of the right side is at most M = |W C2| max |dh/dx|, element by element, for every
derivative of a term grows with the loads. M has no negative element: if its spectral radius rho is below 1, the
iteration contracts with rho in the norm max |x_i| / v_i, v its Perron vector, and x has one solution (Banach). For a
load within full range the first error is at most e = |W C2| |h(1)|, element by element, the n-th at most M^n e. So none
is larger than (1 - M)^-1 e = e + M e + ..., nor outside the ball that e has in the norm above; both together give the
reach for which M must be taken. (The ball is wide where a load has next to no part in the slowest direction, the sum
where M is nearly 1.)
(AIAA R-091A-2020, section 3, iterates so; the proof is ours.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.terms import Term, columns, largest_derivatives

Array = NDArray[np.float64]

# Loads beyond full range that are still taken, flagged: the proof covers them.
EXTRAPOLATION_MARGIN = 1.1
REACH_ITERATIONS = 50
LOAD_ITERATIONS = 200
LOAD_TOLERANCE = 1e-12


@dataclass(frozen=True)
class Contraction:
    """`rho`, by which every step shrinks the error at least; `reach` (n,), loads over full range, where that holds.

    Infinite rho where no reach could be found: then nothing is proved.
    """

    rho: float
    reach: Array

    @property
    def proved(self) -> bool:
        """Whether the iteration converges from every load within MARGIN of full range."""
        return self.rho < 1.0


def contraction(nonlinear_matrix: Array, terms: Sequence[Term], size: int) -> Contraction:
    """The proof for `back` = W C2 (n, q), the loads that each of the q curved terms feigns; n is `size`."""
    if not terms:
        return Contraction(0.0, np.full(size, EXTRAPOLATION_MARGIN))
    apparent = np.abs(nonlinear_matrix)
    first = apparent @ np.abs(columns(terms, np.full((1, size), EXTRAPOLATION_MARGIN)))[0]
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
    """A bound of the spectral radius rho of a matrix without negative elements, and v > 0 (n,) with M v <= rho v."""
    # A small positive part everywhere can only make rho larger, and makes v positive.
    values, vectors = np.linalg.eig(M + 1e-9 * max(float(M.max()), 1e-9))
    k = int(np.argmax(values.real))
    v = np.abs(vectors[:, k].real)
    return float(values[k].real), np.asarray(v / v.max())


def iterate_loads(
    linear_loads: Array, nonlinear_matrix: Array, terms: Sequence[Term]
) -> tuple[Array, NDArray[np.bool_]]:
    """Loads x (m, n) with x = `linear_loads` - back h(x), and which rows (m,) converged; `linear_loads` (m, n) is W
    r.
    """
    x = linear_loads.copy()
    done = np.zeros(len(x), bool)
    for _ in range(LOAD_ITERATIONS):
        with np.errstate(over="ignore", invalid="ignore"):
            new = linear_loads - columns(terms, x) @ nonlinear_matrix.T
            done = np.max(np.abs(new - x), axis=1, initial=0.0) < LOAD_TOLERANCE
        x = new
        if done.all():
            break
    return x, done
