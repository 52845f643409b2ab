"""Cross-validation of one step: what a candidate gains on blocks of lines that its step has not seen.

Near the null chi-square is a parabola, so that gradient and information of each half of the lines are all that is
needed: d = step from one half, gain = chi-square of the other half without it less that with it. Blocks, not single
lines: neighbours share what is wrong with them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.score import Score, extended, with_candidates
from balance_cli.estimation.gauss_newton import prior_curvature
from balance_cli.estimation.likelihood import Curvature, data_curvature
from balance_cli.estimation.measurements import Batch, selected_lines
from balance_cli.estimation.support import covariance_of
from balance_cli.model.balance import BalanceModel

Array = NDArray[np.float64]
Index = NDArray[np.intp]

BLOCK = 8


def halves(batches: Sequence[Batch]) -> tuple[tuple[Batch, ...], tuple[Batch, ...]]:
    """Every other block of each run's lines, and the rest; of runs with few lines every other line.

    The mean of a record stands alone and belongs to both: to the half without it an offset would be anything.
    """
    masks = [(_blocks(batch), _means(batch)) for batch in batches]
    kept = [
        tuple(
            selected_lines(batch, (mask if keep else ~mask) | mean)
            for batch, (mask, mean) in zip(batches, masks, strict=True)
        )
        for keep in (True, False)
    ]
    return kept[0], kept[1]


def _means(batch: Batch) -> NDArray[np.bool_]:
    """The lines (K,) at rest of runs that have others too."""
    still = batch.frequency[batch.index] == 0.0
    for part in batch.parts:
        still[part] &= not still[part].all()
    return np.asarray(still)


def _blocks(batch: Batch) -> NDArray[np.bool_]:
    mask = np.zeros(len(batch.index), bool)
    for part in batch.parts:
        count = part.stop - part.start
        block = BLOCK if count >= 4 * BLOCK else 1
        mask[part] = (np.arange(count) // block) % 2 == 0
    return mask


def fold_gain(model: BalanceModel, theta: Array, batches: Sequence[Batch], score: Score) -> float:
    """What the candidate gains in chi-square on the halves of the lines that its steps were not taken from."""
    geometry = with_candidates(model.geometry, [(score.candidate, score.start)])
    wide, at = extended(model, theta, geometry)
    system, prior = wide.system(at), prior_curvature(wide.parameters, at)
    data = [data_curvature(half, system) for half in halves(batches)]
    free = [name for name, is_free in zip(wide.parameters.names, wide.parameters.free, strict=True) if is_free]
    fitted = np.array([i for i, name in enumerate(free) if name in model.parameters.names], dtype=np.intp)
    everything = np.arange(len(free))
    gain = 0.0
    for learnt, judged in (data, data[::-1]):
        total = learnt + prior
        without, with_it = _step(total, fitted), _step(total, everything)
        gain += _change(judged, without) - _change(judged, with_it)
    return gain


def _step(total: Curvature, chosen: Index) -> Array:
    """The Gauss-Newton step (p,) of the chosen parameters; zero for others."""
    step = np.zeros(len(total.gradient))
    step[chosen] = -covariance_of(total.information[np.ix_(chosen, chosen)]) @ total.gradient[chosen]
    return step


def _change(data: Curvature, step: Array) -> float:
    """Change of chi-square by a step."""
    return float(2.0 * data.gradient @ step + step @ data.information @ step)
