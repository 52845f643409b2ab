"""Fits that end where two modes of the plate have one frequency, which the damping of the modes lets nobody cross.

Damping ratios belong to the modes in the order of their frequencies. Where two modes of different damping meet, the
frequencies of a fit may have to pass each other; beyond, each mode would have the damping of the other, so that
chi-square jumps and no step improves it. With the two damping ratios exchanged the fit is on the other side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.levenberg_marquardt import Minimum
from balance_cli.model.balance import BalanceModel

Array = NDArray[np.float64]

CLOSE_FREQUENCIES = 1e-3
"""Relative distance of two frequencies below which a fit may have ended where they meet: the steps before an end get
smaller by ten each, so that it comes as near as 1e-6."""
MOST_CROSSINGS = 3
"""Pairs of modes that pass each other, one after another: a rig of two planes of symmetry has two or three."""


def cross_modes(
    model: BalanceModel, minimum: Minimum, iterations: int, minimize: Callable[[Array], Minimum]
) -> Minimum:
    """Return a better minimum beyond a crossing of modes, where no step leads on; else the same minimum.

    `minimize` begins at a full parameter vector and takes at most so many `iterations`.
    """
    taken = 0
    for _ in range(MOST_CROSSINGS):
        if minimum.converged or minimum.iterations >= iterations:
            break
        ends = [_try_end(minimize, start) for start in exchanged_damping(model, minimum.theta)]
        better = [end for end in ends if end is not None and end.total.chi2 < minimum.total.chi2]
        if not better:
            break
        taken += minimum.iterations
        minimum = min(better, key=lambda end: end.total.chi2)
    return replace(minimum, iterations=minimum.iterations + taken) if taken else minimum


def _try_end(minimize: Callable[[Array], Minimum], start: Array) -> Minimum | None:
    try:
        return minimize(start)
    except np.linalg.LinAlgError:
        return None


def exchanged_damping(model: BalanceModel, theta: Array) -> list[Array]:
    """Return parameters (p,) with the damping ratios of two modes exchanged, for each pair of nearly one frequency."""
    names, starts = model.parameters.names, []
    for i in np.flatnonzero(np.diff(np.log(plate_frequencies(model, theta))) < CLOSE_FREQUENCIES):
        pair = [names.index(f"damping_ratio.{i + 1}"), names.index(f"damping_ratio.{i + 2}")]
        start = theta.copy()
        start[pair] = theta[pair[::-1]]
        starts.append(start)
    return starts


def plate_frequencies(model: BalanceModel, theta: Array) -> Array:
    """Return the frequencies (n,) [rad/s] of the plate on its cells alone, to which the damping ratios belong."""
    from scipy.linalg import eigh

    equations = model.system(theta, derivatives=False).equations
    n, cells = len(model.geometry.freedom), len(model.geometry.cells)
    B, k = equations.elongation.value[:cells, :n], equations.stiffness.value[:cells]
    eigenvalues = eigh((B.T * k) @ B, equations.mass.value[:n, :n], eigvals_only=True)
    return np.sqrt(np.maximum(eigenvalues, np.finfo(float).tiny))
