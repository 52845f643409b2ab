"""The score test: what a candidate would gain, from its derivative at the null with all fitted parameters projected out.

With half the gradient g and the information I of the model in which the candidate stands at its null (f: fitted
parameters with their priors, c: the candidate's own),

    s = -(g_c - I_cf I_ff^-1 g_f),    V = I_cc - I_cf I_ff^-1 I_fc,    gain = max 2 s'd - d'V d

over the changes d that the candidate's bounds allow. Without bounds gain = s'V^-1 s, which is chi-square distributed
where nothing is missing (Rao, Proc. Camb. Phil. Soc. 44 (1948) 50). No refit is needed: one curvature serves many
candidates, for each leaves the equations at its null as they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.candidates import Candidate, tested
from balance_cli.estimation.gauss_newton import prior_curvature
from balance_cli.estimation.likelihood import Curvature, data_curvature
from balance_cli.estimation.measurements import Batch
from balance_cli.estimation.support import covariance_of
from balance_cli.geometry import Geometry
from balance_cli.model.balance import BalanceModel, balance_model

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Parameters of candidates that go into one curvature: more make it large, fewer make many.
AT_ONCE = 60
# Of a candidate's information, what the fitted parameters must leave for it to be seen beside them.
LEAST_SHARE = 1e-9


@dataclass(frozen=True)
class Score:
    """What one candidate would gain in chi-square, for `parameters` of its own, begun at start number `start`.

    `expected` is the gain that a change of every parameter by its scale would make: what the data could show.
    """

    candidate: Candidate
    start: int
    gain: float
    parameters: int
    expected: float

    @property
    def p_value(self) -> float:
        """Probability of so large a gain where nothing is missing (one candidate alone)."""
        from scipy.stats import chi2

        return float(chi2.sf(self.gain, self.parameters)) if self.parameters else 1.0


def scores(
    model: BalanceModel, theta: Array, batches: Sequence[Batch], candidates: Sequence[Candidate]
) -> tuple[Score, ...]:
    """The score of every candidate, the best of its starts."""
    best: dict[str, Score] = {}
    for number in range(max((len(one.starts) for one in candidates), default=0)):
        with_start = [one for one in candidates if len(one.starts) > number and _starts_matter(one, number)]
        for group in _groups(with_start):
            for score in _group_scores(model, theta, batches, group, number):
                label = score.candidate.label
                if label not in best or score.gain > best[label].gain:
                    best[label] = score
    return tuple(best[one.label] for one in candidates)


def _starts_matter(candidate: Candidate, number: int) -> bool:
    """Whether this start differs at the null from the first one."""
    return number == 0 or candidate.at_null(candidate.starts[number]) != candidate.at_null(candidate.starts[0])


def _groups(candidates: Sequence[Candidate]) -> Iterator[list[Candidate]]:
    group: list[Candidate] = []
    for one in candidates:
        size = sum(len(tested(other.one.parameters)) for other in [*group, one])
        if group and size > AT_ONCE:
            yield group
            group = []
        group.append(one)
    if group:
        yield group


def _group_scores(
    model: BalanceModel, theta: Array, batches: Sequence[Batch], group: Sequence[Candidate], number: int
) -> list[Score]:
    geometry = with_candidates(model.geometry, [(one, number) for one in group])
    wide, at = extended(model, theta, geometry)
    names = {one.one.full_name(item) for one in group for item in tested(one.one.parameters)}
    wide = _only(wide, model, names)
    data = data_curvature(batches, wide.system(at))
    total = data + prior_curvature(wide.parameters, at)
    free = [name for name, is_free in zip(wide.parameters.names, wide.parameters.free, strict=True) if is_free]
    fitted = np.array([i for i, name in enumerate(free) if name not in names], dtype=np.intp)
    inverse = covariance_of(total.information[np.ix_(fitted, fitted)])
    return [_score(one, number, wide, total, data, free, fitted, inverse) for one in group]


def with_candidates(geometry: Geometry, chosen: Sequence[tuple[Candidate, int]], started: bool = False) -> Geometry:
    """The geometry with these candidates at their nulls, or where a fit begins."""
    added = [one.at_start(one.starts[n]) if started else one.at_null(one.starts[n]) for one, n in chosen]
    return geometry.model_copy(update={"effects": (*geometry.effects, *added)})


def extended(model: BalanceModel, theta: Array, geometry: Geometry) -> tuple[BalanceModel, Array]:
    """The model of a geometry with more effects, and its parameters with those of `model` as they are in `theta`.

    What `model` holds (sigma 0) is held there too.
    """
    wide = balance_model(geometry)
    known = dict(zip(model.parameters.names, theta, strict=True))
    held = dict(zip(model.parameters.names, model.parameters.sigma, strict=True))
    at = [known.get(name, value) for name, value in zip(wide.parameters.names, wide.parameters.value, strict=True)]
    sigma = [held.get(name, s) for name, s in zip(wide.parameters.names, wide.parameters.sigma, strict=True)]
    return wide.with_sigma(np.array(sigma, float)), np.array(at, float)


def _only(wide: BalanceModel, model: BalanceModel, names: set[str]) -> BalanceModel:
    """Only the model's own parameters and these are free; the candidates' others are held."""
    kept = names | set(model.parameters.names)
    sigma = [s if name in kept else 0.0 for name, s in zip(wide.parameters.names, wide.parameters.sigma, strict=True)]
    return wide.with_sigma(np.array(sigma, float))


def _score(
    one: Candidate,
    number: int,
    wide: BalanceModel,
    total: Curvature,
    data: Curvature,
    free: Sequence[str],
    fitted: Index,
    inverse: Array,
) -> Score:
    items = tested(one.one.parameters)
    own = np.array([free.index(one.one.full_name(item)) for item in items], dtype=np.intp)
    cross = total.information[np.ix_(own, fitted)] @ inverse
    s = -(total.gradient[own] - cross @ total.gradient[fitted])
    V = total.information[np.ix_(own, own)] - cross @ total.information[np.ix_(fitted, own)]
    raw = np.diag(data.information)[own]
    seen = np.diag(V) > LEAST_SHARE * np.maximum(raw, 1e-300)
    scale = np.array([item.fitted_scale for item in items])
    lower = np.array([item.fitted_bounds[0] >= item.fitted_null for item in items])
    upper = np.array([item.fitted_bounds[1] <= item.fitted_null for item in items])
    gain, used = best_gain(s[seen], V[np.ix_(seen, seen)], lower[seen], upper[seen])
    return Score(one, number, gain, used, float(scale[seen] ** 2 @ np.diag(V)[seen]))


def best_gain(s: Array, V: Array, lower: NDArray[np.bool_], upper: NDArray[np.bool_]) -> tuple[float, int]:
    """Max of 2 s'd - d'V d with d >= 0 where `lower`, d <= 0 where `upper`; and the number of directions seen.

    As |L' d - L^-1 s|^2 it is a least-squares problem with signs: free parameters stand in it once for each sign.
    """
    from scipy.optimize import nnls

    if not len(s):
        return 0.0, 0
    size = 1.0 / np.sqrt(np.diag(V))
    values, vectors = np.linalg.eigh(V * np.outer(size, size))
    kept = values > LEAST_SHARE * values.max()
    root = np.sqrt(values[kept])[:, None] * vectors[:, kept].T
    target = (vectors[:, kept].T @ (s * size)) / np.sqrt(values[kept])
    columns = np.concatenate([root[:, ~upper], -root[:, ~lower]], axis=1)
    if not columns.shape[1]:
        return 0.0, int(kept.sum())
    rest = nnls(columns, target)[1]
    return float(max(target @ target - rest**2, 0.0)), int(kept.sum())
