"""Score and information of candidates with all fitted parameters projected out (see `score_statistics`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.search.gain_dof import gain_dof
from balance_cli.diagnosis.search.noise_dof import RunInformation, noise_dof
from balance_cli.diagnosis.settings import ScoreSettings
from balance_cli.estimation.batch import WORKERS, Batch
from balance_cli.estimation.identifiability import covariance_from_information
from balance_cli.estimation.levenberg_marquardt import prior_curvature
from balance_cli.estimation.likelihood import batch_derivatives
from balance_cli.estimation.shared_solutions import SharedSolutions
from balance_cli.model.balance import BalanceModel

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class ParameterIndices:
    """Indices among the free parameters: those fitted, and those tested of each candidate."""

    fitted: Index
    tested: tuple[Index, ...]

    @classmethod
    def from_names(cls, free: Sequence[str], tested: Sequence[Sequence[str]]) -> ParameterIndices:
        """Return the indices of each candidate's `tested` names among the `free` ones, and of all others."""
        index = {name: i for i, name in enumerate(free)}
        names = {name for each in tested for name in each}
        fitted = np.array([i for i, name in enumerate(free) if name not in names], dtype=np.intp)
        return cls(fitted, tuple(np.array([index[name] for name in each], dtype=np.intp) for each in tested))


@dataclass(frozen=True)
class ProjectedScore:
    """Of a candidate: s (q,) and V (q, q) with the fitted parameters projected out; `raw` (q,), diagonal of V before.

    With a step d of the candidate the fitted parameters change by `fitted_step` - `projection` d, (f,) and (f, q).
    `noise_dof`: degrees of freedom of the noise in the runs that inform about it; `gain_dof` gives those against which
    a gain by a step is tested.
    """

    s: Array
    V: Array
    raw: Array
    noise_dof: float
    fitted_step: Array
    projection: Array
    gain_dof: Callable[[Array, float], float]


def project_out_fitted(
    model: BalanceModel, null: Array, batches: Sequence[Batch], indices: ParameterIndices, settings: ScoreSettings
) -> list[ProjectedScore]:
    """Return the projected score of each candidate in `indices`, at the parameters `null` (p,) of their null."""
    prior, runs = prior_curvature(model.parameters, null), _run_information(model, null, batches, indices)
    gradient = sum((run.gradient for run in runs), prior.gradient)
    cross = sum((run.cross for run in runs), prior.information[indices.fitted])
    sizes = [len(tested) for tested in indices.tested]
    elements = np.split(np.sum([run.blocks for run in runs], axis=0), np.cumsum(np.square(sizes))[:-1])
    blocks = [each.reshape(q, q) for each, q in zip(elements, sizes, strict=True)]
    inverse = covariance_from_information(cross[:, indices.fitted])
    among = cross[:, indices.fitted]
    step = solve_refined(inverse, among, gradient[indices.fitted])
    projections = [solve_refined(inverse, among, cross[:, tested]) for tested in indices.tested]
    dof = noise_dof(runs, indices.fitted, indices.tested, projections, settings.min_noise_dof)
    return [
        ProjectedScore(
            s=-(gradient[tested] - projection.T @ gradient[indices.fitted]),
            V=remaining_information(V, cross[:, tested], among, projection),
            raw=np.diag(V).copy(),
            noise_dof=float(known),
            fitted_step=-step,
            projection=projection,
            gain_dof=partial(gain_dof, runs, indices.fitted, tested, projection),
        )
        for tested, V, projection, known in zip(indices.tested, blocks, projections, dof, strict=True)
    ]


def solve_refined(inverse: Array, matrix: Array, right: Array) -> Array:
    """The solution of matrix x = right from an inverse with rounding errors, refined once."""
    x = inverse @ right
    return np.asarray(x + inverse @ (right - matrix @ x))


def remaining_information(V: Array, cross: Array, among: Array, projection: Array) -> Array:
    """Return V (q, q) with the fitted parameters projected out; without an error of first order in `projection` (f, q).

    It is a small difference where a candidate does nearly the same as the fitted parameters.
    """
    remaining = V - cross.T @ projection - projection.T @ cross + projection.T @ among @ projection
    return np.asarray(0.5 * (remaining + remaining.T))


def _run_information(
    model: BalanceModel, null: Array, batches: Sequence[Batch], indices: ParameterIndices
) -> tuple[RunInformation, ...]:
    """The information of each run, in order."""
    system = model.system(null)
    shared = SharedSolutions(system)

    def from_batch(batch: Batch) -> RunInformation:
        derivatives = batch_derivatives(batch, system, shared)
        return RunInformation.from_batch(batch, derivatives, indices.fitted, indices.tested)

    with ThreadPoolExecutor(WORKERS) as workers:
        return tuple(workers.map(from_batch, batches))
