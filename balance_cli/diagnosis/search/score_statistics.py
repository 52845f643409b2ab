"""The score test: what a candidate would gain, from its derivative at the null, all fitted parameters projected out.

With half the gradient g and the information I of the model in which the candidate stands at its null (f: fitted
parameters with their priors, c: the candidate's own),

    s = -(g_c - I_cf I_ff^-1 g_f),    V = I_cc - I_cf I_ff^-1 I_fc,    gain = max 2 s'd - d'V d

over the changes d that the candidate's bounds allow. Without bounds gain = s'V^-1 s, which is chi-square distributed
where nothing is missing (Rao, Proc. Camb. Phil. Soc. 44 (1948) 50). No refit is needed: one curvature serves many
candidates, for each leaves the equations at its null as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.search.candidates import Candidate, parameters_of_interest
from balance_cli.diagnosis.search.noise_dof import RunInformation, noise_dof
from balance_cli.diagnosis.search.point_mass import place_mass_candidates
from balance_cli.estimation.identifiability import covariance_from_information
from balance_cli.estimation.levenberg_marquardt import prior_curvature
from balance_cli.estimation.likelihood import batch_derivatives
from balance_cli.estimation.maximum_likelihood import penalized_chi2
from balance_cli.estimation.measurements import WORKERS, Batch, select_lines, split_by_run
from balance_cli.model.balance import BalanceModel, balance_model
from balance_cli.model.effects import EffectParameter

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Of a candidate's information, what the fitted parameters must leave for it to be seen beside them.
MIN_INFORMATION_SHARE = 1e-9
# Lines that all candidates are tried with, and how many of them with every line.
SCREENING_LINES = 2000
FULLY_SCORED_CANDIDATES = 40
# Parts of a step that are tried one after another.
STEP_FRACTIONS = (1.0, 0.3, 0.1, 0.03)


@dataclass(frozen=True)
class Score:
    """What one candidate would gain in chi-square, for `parameters` of its own, begun at start number `start`.

    What the data chose of that start counts among the parameters.

    `expected` is the gain that a change of every parameter by its scale would make: what the data could show.
    Of its own parameters that do something by themselves: `information` (q, q), V; `step` (q,), the change that gains,
    and `fitted_step` (f,), how the fitted parameters then go along.
    """

    candidate: Candidate
    start: int
    gain: float
    parameters: int
    expected: float
    noise_dof: float
    information: Array
    step: Array
    fitted_step: Array

    @property
    def p_value(self) -> float:
        """Probability of so large a gain where nothing is missing (one candidate alone)."""
        return gain_p_value(self.gain, self.parameters, self.noise_dof)


def gain_p_value(gain: float, parameters: int, noise_dof: float = np.inf) -> float:
    """Probability of so large a gain by chance, with a noise that is known to `noise_dof` degrees of freedom (F)."""
    from scipy.stats import chi2, f

    if not parameters:
        return 1.0
    if not np.isfinite(noise_dof):
        return float(chi2.sf(gain, parameters))
    return float(f.sf(gain / parameters, parameters, noise_dof))


def has_nuisance_parameters(score: Score) -> bool:
    """Whether a score rests on values that nobody knows, so that it may be far too small."""
    return any(item.nuisance for item in score.candidate.one.parameters)


def scores(
    model: BalanceModel, theta: Array, batches: Sequence[Batch], candidates: Sequence[Candidate]
) -> tuple[Score, ...]:
    """The score of every candidate, the best of its starts."""
    best: dict[str, Score] = {}
    separate = split_by_run(batches)
    for number in range(max((len(one.starts) for one in candidates), default=0)):
        with_start = [one for one in candidates if len(one.starts) > number and _starts_matter(one, number)]
        for score in _scores_of_start(model, theta, separate, with_start, number):
            label = score.candidate.label
            if label not in best or score.gain > best[label].gain:
                best[label] = score
    return tuple(best[one.label] for one in candidates)


def score_in_two_stages(
    model: BalanceModel, theta: Array, batches: Sequence[Batch], candidates: Sequence[Candidate]
) -> tuple[Score, ...]:
    """As `scores`, with fewer lines for those that then do not look as if they would gain anything."""
    lines = sum(len(batch.index) for batch in batches)
    stride = lines // SCREENING_LINES
    candidates = place_mass_candidates(candidates, model, theta, batches)
    if stride < 2:
        return scores(model, theta, batches, candidates)
    every = [select_lines(batch, _screening_mask(batch, stride)) for batch in batches]
    found = {
        one.candidate.label: replace(one, expected=stride * one.expected)
        for one in scores(model, theta, every, candidates)
    }
    leading = sorted(found.values(), key=lambda one: one.gain / max(one.parameters, 1), reverse=True)[
        :FULLY_SCORED_CANDIDATES
    ]
    found |= {one.candidate.label: one for one in scores(model, theta, batches, [one.candidate for one in leading])}
    return tuple(found.values())


def _screening_mask(batch: Batch, stride: int) -> NDArray[np.bool_]:
    """Every so many lines, but all of those at rest, which say what no other does."""
    still = batch.frequency[batch.index] == 0
    return np.asarray(still | (np.arange(len(still)) % stride == 0))


def _starts_matter(candidate: Candidate, number: int) -> bool:
    """Whether this start differs at the null from the first one."""
    return number == 0 or candidate.at_null(candidate.starts[number]) != candidate.at_null(candidate.starts[0])


@dataclass(frozen=True)
class _ParameterIndices:
    """Where things stand among the free parameters: those fitted, and each candidate's own."""

    fitted: Index
    own: tuple[Index, ...]


def _scores_of_start(
    model: BalanceModel, theta: Array, batches: Sequence[Batch], chosen: Sequence[Candidate], number: int
) -> list[Score]:
    if not chosen:
        return []
    geometry = add_candidates(model.geometry, [(one, number) for one in chosen])
    wide, at = extend_model(model, theta, geometry)
    own = [[one.one.full_name(item) for item in parameters_of_interest(one.one.parameters)] for one in chosen]
    names = {name for each in own for name in each}
    wide = hold_other_parameters(wide, model, names)
    free = [name for name, is_free in zip(wide.parameters.names, wide.parameters.free, strict=True) if is_free]
    where = {name: i for i, name in enumerate(free)}
    fitted = np.array([i for i, name in enumerate(free) if name not in names], dtype=np.intp)
    places = _ParameterIndices(fitted, tuple(np.array([where[name] for name in each], dtype=np.intp) for each in own))
    projected = _project_out_fitted(wide, at, batches, places)
    return [_score(one, number, part) for one, part in zip(chosen, projected, strict=True)]


@dataclass(frozen=True)
class ProjectedScore:
    """Of a candidate: s (q,), V (q, q) with the fitted parameters projected out; `raw` (q,) is V's diagonal before.

    By a step d the fitted parameters change by `rest` - `along` d, (f,) and (f, q).
    `noise_dof`: degrees of freedom of the noise in the runs that speak of it.
    """

    s: Array
    V: Array
    raw: Array
    noise_dof: float
    rest: Array
    projection: Array


def _project_out_fitted(
    wide: BalanceModel, at: Array, batches: Sequence[Batch], places: _ParameterIndices
) -> list[ProjectedScore]:
    prior, runs = prior_curvature(wide.parameters, at), _run_information(wide, at, batches, places)
    gradient = sum((run.gradient for run in runs), prior.gradient)
    cross = sum((run.cross for run in runs), prior.information[places.fitted])
    blocks = [sum(parts, np.zeros_like(parts[0])) for parts in zip(*(run.blocks for run in runs), strict=True)]
    inverse = covariance_from_information(cross[:, places.fitted])
    step = inverse @ gradient[places.fitted]
    projection = [inverse @ cross[:, own] for own in places.own]
    dof = noise_dof(runs, places.fitted, places.own, projection)
    return [
        ProjectedScore(
            -(gradient[own] - cross[:, own].T @ step),
            V - cross[:, own].T @ follows,
            np.diag(V).copy(),
            float(known),
            -step,
            follows,
        )
        for own, V, follows, known in zip(places.own, blocks, projection, dof, strict=True)
    ]


def _run_information(
    wide: BalanceModel, at: Array, batches: Sequence[Batch], places: _ParameterIndices
) -> tuple[RunInformation, ...]:
    """What each run tells, in order."""
    system = wide.system(at)

    def from_batch(batch: Batch) -> RunInformation:
        return RunInformation.from_batch(batch, batch_derivatives(batch, system), places.fitted, places.own)

    with ThreadPoolExecutor(WORKERS) as workers:
        return tuple(workers.map(from_batch, batches))


def add_candidates(
    geometry: Geometry, chosen: Sequence[tuple[Candidate, int]], at_start_values: bool = False
) -> Geometry:
    """The geometry with these candidates at their nulls, or where a fit begins."""
    added = [one.at_start(one.starts[n]) if at_start_values else one.at_null(one.starts[n]) for one, n in chosen]
    return geometry.model_copy(update={"effects": (*geometry.effects, *added)})


def add_scored_candidate(geometry: Geometry, score: Score) -> Geometry:
    """The geometry with the candidate of a score where a fit of it begins."""
    one = score.candidate
    values = one.start_from_score(geometry, score.start, [float(d) for d in score.step])
    return geometry.model_copy(update={"effects": (*geometry.effects, one.at_start(values))})


def extend_model(model: BalanceModel, theta: Array, geometry: Geometry) -> tuple[BalanceModel, Array]:
    """The model of a geometry with more effects, and its parameters with those of `model` as they are in `theta`.

    What `model` holds (sigma 0) is held there too.
    """
    wide = balance_model(geometry)
    known = dict(zip(model.parameters.names, theta, strict=True))
    held = dict(zip(model.parameters.names, model.parameters.sigma, strict=True))
    at = [known.get(name, value) for name, value in zip(wide.parameters.names, wide.parameters.value, strict=True)]
    sigma = [held.get(name, s) for name, s in zip(wide.parameters.names, wide.parameters.sigma, strict=True)]
    return wide.with_sigma(np.array(sigma, float)), np.array(at, float)


def apply_score_step(
    model: BalanceModel, theta: Array, batches: Sequence[Batch], score: Score
) -> tuple[BalanceModel, Array]:
    """The model with a candidate where its score says that it gains, from which a weak one is soon fitted.

    The fitted parameters go along, and the step is shortened until chi-square falls.
    """
    one = score.candidate.one
    wide, null = extend_model(model, theta, add_candidates(model.geometry, [(score.candidate, score.start)]))
    step = np.zeros(len(null))
    free = [name for name, is_free in zip(model.parameters.names, model.parameters.free, strict=True) if is_free]
    step[[wide.parameters.index(name) for name in free]] = score.fitted_step
    step[[wide.parameters.index(one.full_name(item)) for item in parameters_of_interest(one.parameters)]] = score.step
    before = penalized_chi2(wide, null, batches)
    for share in STEP_FRACTIONS:
        if penalized_chi2(wide, null + share * step, batches) < before:
            return wide, np.asarray(null + share * step)
    return wide, null


def hold_other_parameters(wide: BalanceModel, model: BalanceModel, names: set[str]) -> BalanceModel:
    """Only the model's own parameters and these are free; the candidates' others are held."""
    kept = names | set(model.parameters.names)
    sigma = [s if name in kept else 0.0 for name, s in zip(wide.parameters.names, wide.parameters.sigma, strict=True)]
    return wide.with_sigma(np.array(sigma, float))


def _score(one: Candidate, number: int, part: ProjectedScore) -> Score:
    items = parameters_of_interest(one.one.parameters)
    seen = np.diag(part.V) > MIN_INFORMATION_SHARE * np.maximum(part.raw, 1e-300)
    scale = np.array([item.fitted_scale for item in items])
    lower, upper = one_sided_bounds(items)
    best = best_gain(part.s[seen], part.V[np.ix_(seen, seen)], lower[seen], upper[seen])
    expected = float(scale[seen] ** 2 @ np.diag(part.V)[seen])
    step = np.zeros(len(items))
    step[seen] = best.step
    fitted_step = part.rest - part.projection @ step
    return Score(
        one, number, best.gain, best.directions + one.chosen, expected, part.noise_dof, part.V, step, fitted_step
    )


def one_sided_bounds(items: Sequence[EffectParameter]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which parameters (q,) cannot go below their null, and which cannot go above it."""
    lower = np.array([item.fitted_bounds[0] >= item.fitted_null for item in items], bool)
    upper = np.array([item.fitted_bounds[1] <= item.fitted_null for item in items], bool)
    return lower, upper


class BestGain(NamedTuple):
    """The largest gain, the number of directions that the data see, and the step (q,) that makes it."""

    gain: float
    directions: int
    step: Array


def best_gain(s: Array, V: Array, lower: NDArray[np.bool_], upper: NDArray[np.bool_]) -> BestGain:
    """Max of 2 s'd - d'V d with d >= 0 where `lower`, d <= 0 where `upper`.

    As |L' d - L^-1 s|^2 it is a least-squares problem with signs: free parameters stand in it once for each sign.
    """
    from scipy.optimize import nnls

    step = np.zeros(len(s))
    known = np.diag(V) > 0
    if not known.any():
        return BestGain(0.0, 0, step)
    size = np.where(known, 1.0 / np.sqrt(np.where(known, np.diag(V), 1.0)), 0.0)
    values, vectors = np.linalg.eigh(V * np.outer(size, size))
    kept = values > MIN_INFORMATION_SHARE * values.max()
    root = np.sqrt(values[kept])[:, None] * vectors[:, kept].T
    target = (vectors[:, kept].T @ (s * size)) / np.sqrt(values[kept])
    up, down = np.flatnonzero(known & ~upper), np.flatnonzero(known & ~lower)
    columns = np.concatenate([root[:, up], -root[:, down]], axis=1)
    if not columns.shape[1]:
        return BestGain(0.0, int(kept.sum()), step)
    chosen, rest = nnls(columns, target)
    step[up] += chosen[: len(up)]
    step[down] -= chosen[len(up) :]
    return BestGain(float(max(target @ target - rest**2, 0.0)), int(kept.sum()), step * size)
