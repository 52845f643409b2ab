"""Which effects cannot be told apart, and the run that would separate them best.

Two candidates a and b with the projected information V (see `detectability`) leave the same trace as far as the cosine

    c = largest singular value of V_aa^-1/2 V_ab V_bb^-1/2

is near one (the cosine of the smallest canonical angle between their traces in the weighted residual). Where b is
fitted in place of a, the share 1 - c^2 of the gain of a remains to tell that it was a.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.search.candidates import Candidate
from balance_cli.planning.detectability import ProjectedInformation, project, tested_positions
from balance_cli.planning.extended_model import ExtendedModel
from balance_cli.planning.information import RunInformation, add_information

Array = NDArray[np.float64]
Index = NDArray[np.intp]

ALIKE = 0.95
"""Cosine from which two effects are listed as alike: fitting one takes off nine tenths of the other's gain."""
MOST_PAIRS = 20
"""Pairs that are listed, and for which the separating run is sought."""
LEAST_EIGENVALUE = 1e-9
"""Least eigenvalue of a scaled block of V that is inverted."""


@dataclass(frozen=True)
class ConfusedPair:
    """Two effects (labels NAME@PLACE) that leave nearly the same trace, the most alike places of `places` in all.

    `cosine` of the angle between their traces; `run`, the proposed run that lowers it most, to `cosine_with_run`;
    empty where none of the runs changes it by more than `LEAST_CHANGE`. `further`: what other kind of run lowers it
    most, to `cosine_with_further`, where none of the hall does so; without one, `otherwise` is the measurement that
    tells these two effects apart by other means.
    """

    first: str
    second: str
    places: int
    cosine: float
    run: str
    cosine_with_run: float
    further: str = ""
    cosine_with_further: float = 1.0
    otherwise: str = ""


LEAST_CHANGE = 1e-3
"""Decrease of a cosine by which a run counts as one that separates."""


def confused_pairs(
    total: RunInformation,
    model: ExtendedModel,
    proposals: Sequence[RunInformation],
    further: Sequence[RunInformation],
) -> tuple[ConfusedPair, ...]:
    """The pairs of effects that are alike after the runs of `total`, the most alike first.

    Each pair of names stands for all pairs of their places. What an effect has in common with itself at a wider place
    is not listed. `further`: runs beyond the hall, named by what they are.
    """
    projected, positions = project(total, model), tested_positions(model)
    alike = sorted(_similar_pairs(projected, model, positions), key=lambda item: (-round(item[2], 6), item[0], item[1]))
    names = [tuple(model.candidates[k].effect.name for k in item[:2]) for item in alike]
    leading = [item for k, item in enumerate(alike) if names[k] not in names[:k]][:MOST_PAIRS]
    with_runs, with_further = (
        [(run.run, _cosines(add_information([total, run], model), model, leading)) for run in runs]
        for runs in (proposals, further)
    )
    pairs = []
    for k, item in enumerate(leading):
        places = names.count(tuple(model.candidates[each].effect.name for each in item[:2]))
        after, beyond = ([(cosines[k], name) for name, cosines in runs] for runs in (with_runs, with_further))
        pair = _pair(model, item, places, after)
        pairs.append(pair if pair.run else _with_further(pair, model, item, beyond))
    return tuple(pairs)


def _cosines(total: RunInformation, model: ExtendedModel, pairs: Sequence[tuple[int, int, float]]) -> list[float]:
    """The cosine of each pair after the runs of `total`."""
    projected, positions = project(total, model), tested_positions(model)
    return [canonical_cosine(projected, positions[i], positions[j]) for i, j, _ in pairs]


def _with_further(
    pair: ConfusedPair, model: ExtendedModel, indices: tuple[int, int, float], further: Sequence[tuple[float, str]]
) -> ConfusedPair:
    """The pair with the run beyond the hall that separates it best, or what does otherwise."""
    beyond = _pair(model, indices, pair.places, further)
    if beyond.run:
        return replace(pair, further=beyond.run, cosine_with_further=beyond.cosine_with_run)
    effects = dict.fromkeys(model.candidates[k].effect.separated_by for k in indices[:2])
    return replace(pair, cosine_with_further=pair.cosine, otherwise=" ".join(effects))


def _pair(
    model: ExtendedModel, indices: tuple[int, int, float], places: int, after: Sequence[tuple[float, str]]
) -> ConfusedPair:
    """The pair with the run that separates it best, of the cosines and names of runs."""
    i, j, cosine = indices
    least, name = min(after, default=(cosine, ""))
    first, second = model.candidates[i].label, model.candidates[j].label
    if least > cosine - LEAST_CHANGE:
        return ConfusedPair(first, second, places, cosine, "", cosine)
    return ConfusedPair(first, second, places, cosine, name, least)


def _similar_pairs(
    projected: ProjectedInformation, model: ExtendedModel, positions: Sequence[Index]
) -> Iterator[tuple[int, int, float]]:
    """Pairs of candidates whose traces have at least one direction in common."""
    roots = [_inverse_root(projected.block(each, each)) for each in positions]
    whitened = projected.V.copy()
    for rows, root in zip(positions, roots, strict=True):
        whitened[rows] = root @ whitened[rows]
        whitened[:, rows] = whitened[:, rows] @ root.T
    # The Frobenius norm bounds the largest singular value: most pairs need no decomposition.
    starts = np.array([rows[0] for rows in positions], dtype=np.intp)
    squares = np.add.reduceat(np.add.reduceat(whitened**2, starts, axis=0), starts, axis=1)
    for i, j in np.argwhere(np.triu(squares >= ALIKE**2, 1)).tolist():
        if _is_same_at_wider_place(model.candidates[i], model.candidates[j]):
            continue
        cosine = min(float(np.linalg.norm(whitened[np.ix_(positions[i], positions[j])], 2)), 1.0)
        if cosine >= ALIKE:
            yield i, j, cosine


def _is_same_at_wider_place(first: Candidate, second: Candidate) -> bool:
    """Whether two candidates are one effect at places that have a name in common, or at a cell and all cells."""
    places = [set(item.placed_effect.where) for item in (first, second)]
    same = first.effect.name == second.effect.name
    return same and bool(places[0] & places[1] or not places[0] or not places[1] or "all" in places[0] | places[1])


def canonical_cosine(projected: ProjectedInformation, first: Index, second: Index) -> float:
    """Cosine of the smallest angle between the traces of two candidates; 0 where one leaves none."""
    left, right = _inverse_root(projected.block(first, first)), _inverse_root(projected.block(second, second))
    return min(float(np.linalg.norm(left @ projected.block(first, second) @ right.T, 2)), 1.0)


def _inverse_root(V: Array) -> Array:
    """R (q, q) with R V R' = 1 on the directions that have information."""
    informed = np.diag(V) > 0
    scale = np.where(informed, 1.0 / np.sqrt(np.where(informed, np.diag(V), 1.0)), 0.0)
    values, vectors = np.linalg.eigh(V * np.outer(scale, scale))
    is_informed = values > LEAST_EIGENVALUE * max(float(values.max()), np.finfo(float).tiny)
    inverse = np.where(is_informed, 1.0 / np.sqrt(np.where(is_informed, values, 1.0)), 0.0)
    return np.asarray((inverse[:, None] * vectors.T) * scale)
