"""Fits that end where two modes of the plate have one frequency, which the damping of the modes lets nobody cross.

Damping ratios belong to the modes in the order of their frequencies. Where two modes of different damping meet, the
frequencies of a fit may have to pass each other; beyond, each mode would have the damping of the other, so that
chi-square jumps and no step improves it. With damping ratios and frequencies exchanged the fit is on the other side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.levenberg_marquardt import Minimum, limit_to_bounds
from balance_cli.model.balance import BalanceModel

Array = NDArray[np.float64]

CLOSE_FREQUENCIES = 1e-2
"""Relative distance of two frequencies below which a fit may have ended at their crossing: a mass of some per cent that
the model lacked moves them by so much. Chi-square decides; a fit that had to pass ended 0.4 % before it."""
LEAST_DIFFERENCE = 0.05
"""Relative difference of two damping ratios, below which nothing keeps their modes from passing each other."""
LEAST_GAP = 1e-5
"""Relative distance of two frequencies beyond their crossing, at least."""
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
        ends = [_try_end(minimize, start) for start in exchanged_modes(model, minimum.theta)]
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


def exchanged_modes(model: BalanceModel, theta: Array) -> list[Array]:
    """Return parameters (p,) with two close modes in the other order, each with its own damping, for each such pair."""
    names, starts = model.parameters.names, []
    plate = _plate(model, theta)
    for i in np.flatnonzero(np.diff(plate.log_frequency) < CLOSE_FREQUENCIES):
        pair = [names.index(f"damping_ratio.{i + 1}"), names.index(f"damping_ratio.{i + 2}")]
        first, second = theta[pair]
        if abs(first - second) <= LEAST_DIFFERENCE * max(abs(first), abs(second)):
            continue
        start = theta + _exchanging_change(model, plate, int(i))
        start[pair] = theta[pair[::-1]]
        starts.append(limit_to_bounds(model.parameters, theta, start))
    return starts


@dataclass(frozen=True)
class _Plate:
    """Logarithms (n,) of the frequencies of the plate on its cells alone, and their derivatives (n, f).

    The derivatives by the free parameters are those of each mode by its own shape, which a mode near by does not bend.
    """

    log_frequency: Array
    derivative: Array


def _plate(model: BalanceModel, theta: Array) -> _Plate:
    from scipy.linalg import eigh

    equations = model.system(theta).equations
    n, cells = len(model.geometry.freedom), len(model.geometry.cells)
    B, k = equations.elongation[:cells, :n], equations.stiffness[:cells]
    K, M = B.T @ (k.insert_axis(-1) * B), equations.mass[:n, :n]
    squared, shapes = eigh(K.value, M.value)
    squared = np.maximum(squared, np.finfo(float).tiny)
    of_K, of_M = (np.einsum("ai,pab,bi->ip", shapes, part.derivative, shapes) for part in (K, M))
    return _Plate(0.5 * np.log(squared), 0.5 * (of_K / squared[:, None] - of_M))


def _exchanging_change(model: BalanceModel, plate: _Plate, i: int) -> Array:
    """The change (p,) of declared parameters, least in units of their tolerances, that exchanges modes i and i + 1."""
    sigma = model.parameters.sigma[model.parameters.free]
    scale = np.where(np.isfinite(sigma), sigma, 0.0)
    gap = max(plate.log_frequency[i + 1] - plate.log_frequency[i], LEAST_GAP)
    change = np.zeros(len(model.parameters.names))
    J = plate.derivative[i : i + 2] * scale
    change[model.parameters.free] = scale * np.linalg.lstsq(J, np.array([gap, -gap]), rcond=None)[0]
    return change


def plate_frequencies(model: BalanceModel, theta: Array) -> Array:
    """Return the frequencies (n,) [rad/s] of the plate on its cells alone, to which the damping ratios belong."""
    return np.asarray(np.exp(_plate(model, theta).log_frequency))
