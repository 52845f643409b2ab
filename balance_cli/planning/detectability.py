"""The smallest size of each effect that a diagnosis would find, from the information of the runs.

With the information I of all runs and priors (f: fitted parameters, c: parameters of a candidate)

    V = I_cc - I_cf I_ff^-1 I_fc

is what is left of a candidate's information once the fitted parameters have followed. Where its parameters are truly
d, the gain of the score test is noncentral chi-square distributed with the noncentrality d'V d (Rao, Proc. Camb. Phil.
Soc. 44 (1948) 50; Kay, Fundamentals of Statistical Signal Processing II, 1998, section 6.5); noncentral F, as the noise
is measured with so many degrees of freedom as the runs have that show the candidate. The effect is found where
the gain exceeds the threshold that noise alone exceeds, for any of the candidates, with the false-alarm level. Of a
parameter alone the smallest size is sqrt(lambda / V_ii), lambda being the noncentrality with the stated power.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from balance_cli.diagnosis.choices import SIGNIFICANCE_LEVEL
from balance_cli.diagnosis.search.noise_dof import pooled_dof
from balance_cli.diagnosis.search.projected_scores import remaining_information, solve_refined
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.identifiability import covariance_from_information
from balance_cli.model.effects import EffectParameter
from balance_cli.planning.extended_model import ExtendedModel
from balance_cli.planning.information import RunInformation
from balance_cli.signals.distributions import chi2, f

Array = NDArray[np.float64]
Index = NDArray[np.intp]

POWER = 0.9
"""Probability with which an effect of the smallest size is found: the usual one of clinical and radar detection."""
LARGEST_SIZE = 1e6
"""Scales of a parameter (changes that matter) from which a size is one that no run shows."""
KNOWN_NOISE_DOF = 1e7
"""Degrees of freedom from which the noise counts as known: there the noncentral F and chi-square agree to 1e-6."""


@dataclass(frozen=True)
class DetectionLevel:
    """False-alarm `level` of a whole diagnosis (all candidates together), and `power` for an effect that is there."""

    level: float = SIGNIFICANCE_LEVEL
    power: float = POWER


@dataclass(frozen=True)
class ProjectedInformation:
    """Information of runs and priors with the fitted parameters projected out.

    `covariance` (f, f) of the fitted parameters; `V` (t, t) of all tested parameters in the order of the candidates;
    `raw` (t,), the diagonal before; `projection` (f, t): the fitted ones change by -projection d where the tested ones
    are d. `noise_dof` (n,): real degrees of freedom with which the noise of the runs that show a candidate is known.
    """

    covariance: Array
    V: Array
    raw: Array
    projection: Array
    noise_dof: Array

    def block(self, rows: Index, columns: Index) -> Array:
        """A part of V."""
        return self.V[np.ix_(rows, columns)]


@dataclass(frozen=True)
class SmallestSize:
    """Smallest size of one parameter that is found, the effect's other parameters being zero.

    `sigma` is the standard deviation of the parameter if the effect were fitted; `size` is infinite where the runs
    do not show it. Both are of the fitted value (`fitted_name`, such as `1/cutoff`); `value` is the departure of the
    parameter itself from its null (of a cutoff: the cutoff).
    """

    label: str
    effect: str
    parameter: str
    unit: str
    size: float
    value: float
    sigma: float
    index: int


def tested_positions(model: ExtendedModel) -> tuple[Index, ...]:
    """Positions of each candidate's parameters among all tested ones."""
    lengths = [len(item) for item in model.indices.tested]
    edges = np.cumsum([0, *lengths])
    return tuple(
        np.arange(start, start + length, dtype=np.intp) for start, length in zip(edges[:-1], lengths, strict=True)
    )


def project(run: RunInformation, model: ExtendedModel) -> ProjectedInformation:
    """Project the fitted parameters out of the information of runs, the priors included."""
    total = run.information + model.prior_information
    fitted = model.indices.fitted
    tested = np.concatenate([*model.indices.tested, np.zeros(0, np.intp)]).astype(np.intp)
    among, cross = total[np.ix_(fitted, fitted)], total[np.ix_(fitted, tested)]
    covariance = covariance_from_information(among)
    projection = solve_refined(covariance, among, cross)
    raw = np.diag(total)[tested].copy()
    V = remaining_information(total[np.ix_(tested, tested)], cross, among, projection)
    # What rounding leaves of a parameter that the fitted ones describe as well is no information.
    informed = np.diag(V) > DEFAULT_SETTINGS.score.min_information_share * np.maximum(raw, np.finfo(float).tiny)
    V = np.where(np.outer(informed, informed), V, 0.0)
    return ProjectedInformation(covariance, V, raw, projection, _noise_dof(run, model, projection))


def _noise_dof(run: RunInformation, model: ExtendedModel, projection: Array) -> Array:
    """Degrees of freedom (n,) of the noise against which each candidate's score will be tested."""
    fitted, lengths = model.indices.fitted, [len(item) for item in model.indices.tested]
    tested = np.concatenate([*model.indices.tested, np.zeros(0, np.intp)]).astype(np.intp)
    if not run.single_runs or not lengths:
        return np.full(len(lengths), np.inf)
    variance = []
    for part in run.single_runs:
        among, cross = part.information[np.ix_(fitted, fitted)], part.information[np.ix_(fitted, tested)]
        diagonal = np.diag(part.information)[tested] - 2.0 * np.sum(projection * cross, axis=0)
        variance.append(np.maximum(diagonal + np.sum(projection * (among @ projection), axis=0), 0.0))
    uncertainty = np.array([[2.0 / part.noise_dof] for part in run.single_runs])
    pooled = pooled_dof(np.array(variance), np.broadcast_to(uncertainty, (len(variance), len(tested))), lengths)
    return np.maximum(pooled, DEFAULT_SETTINGS.score.min_noise_dof)


@dataclass(frozen=True)
class InformationRows:
    """What the worth of runs needs of their information: `rows` (f, p) of the fitted parameters, `diagonal` (p,).

    Where there are a thousand parameters it is a fortieth of the whole.
    """

    rows: Array
    diagonal: Array

    def __add__(self, other: InformationRows) -> InformationRows:
        return InformationRows(self.rows + other.rows, self.diagonal + other.diagonal)

    def __mul__(self, factor: float) -> InformationRows:
        return InformationRows(factor * self.rows, factor * self.diagonal)


def information_rows(information: Array, model: ExtendedModel) -> InformationRows:
    """The rows of the fitted parameters and the diagonal of an information (p, p)."""
    return InformationRows(information[model.indices.fitted], np.diag(information))


@dataclass(frozen=True)
class ProjectedRows:
    """`covariance` (f, f), `projection` (f, t) and the diagonal (t,) of V, as `ProjectedInformation` has them."""

    covariance: Array
    projection: Array
    diagonal: Array


def project_rows(known: InformationRows, model: ExtendedModel) -> ProjectedRows:
    """Project the fitted parameters out of what is `known` by runs and priors together; of V the diagonal alone."""
    tested = np.concatenate([*model.indices.tested, np.zeros(0, np.intp)]).astype(np.intp)
    among, cross = known.rows[:, model.indices.fitted], known.rows[:, tested]
    covariance = covariance_from_information(among)
    projection = solve_refined(covariance, among, cross)
    raw = known.diagonal[tested]
    V = raw - 2.0 * np.sum(cross * projection, axis=0) + np.sum(projection * (among @ projection), axis=0)
    informed = DEFAULT_SETTINGS.score.min_information_share * np.maximum(raw, np.finfo(float).tiny) < V
    return ProjectedRows(covariance, projection, np.where(informed, V, 0.0))


def gain_threshold(parameters: int, count: int, level: float, noise_dof: float) -> float:
    """The gain that one candidate of `count` must exceed, with this number of parameters (Bonferroni)."""
    alone = level / max(count, 1)
    if noise_dof > 0 and np.isfinite(noise_dof):
        return float(parameters * f.isf(alone, parameters, noise_dof))
    return float(chi2.isf(alone, parameters))


def required_noncentrality(parameters: int, count: int, detection: DetectionLevel, noise_dof: float) -> float:
    """The noncentrality with which the gain exceeds its threshold with the stated power."""
    threshold = gain_threshold(parameters, count, detection.level, noise_dof)
    if noise_dof < KNOWN_NOISE_DOF:
        return float(special.ncfdtrinc(parameters, noise_dof, 1.0 - detection.power, threshold / parameters))
    return float(special.chndtrinc(threshold, parameters, 1.0 - detection.power))


def informed_directions(V: Array) -> int:
    """Number of directions (as the score test counts them) that the information V (q, q) of a candidate has."""
    informed = np.flatnonzero(np.diag(V) > 0)
    if not len(informed):
        return 0
    scale = 1.0 / np.sqrt(np.diag(V)[informed])
    values = np.linalg.eigvalsh(V[np.ix_(informed, informed)] * np.outer(scale, scale))
    return int(np.count_nonzero(values > DEFAULT_SETTINGS.score.min_information_share * values.max()))


def smallest_sizes(
    projected: ProjectedInformation,
    model: ExtendedModel,
    detection: DetectionLevel,
    among: Collection[int] | None = None,
) -> tuple[SmallestSize, ...]:
    """The smallest size of every parameter of interest of every candidate, in their order.

    `among`: only of the candidates that have one of these parameters (`SmallestSize.index`).
    """
    sizes = []
    for candidate, positions, dof in zip(
        model.candidates, tested_positions(model), projected.noise_dof.tolist(), strict=True
    ):
        if among is not None and not set(positions.tolist()) & set(among):
            continue
        V = projected.block(positions, positions)
        directions = max(informed_directions(V), 1)
        needed = required_noncentrality(directions, model.candidate_count, detection, dof)
        spread = np.sqrt(np.diag(covariance_from_information(V)))
        for k, item in enumerate(model.items(candidate)):
            size = float(np.sqrt(needed / V[k, k])) if V[k, k] > 0 else float("inf")
            # Rounding leaves some information on what no run excites.
            size = size if size < LARGEST_SIZE * item.fitted_scale else float("inf")
            sigma = float(spread[k]) if np.isfinite(size) else float("inf")
            sizes.append(_smallest_size(candidate.label, candidate.effect.name, item, size, sigma, int(positions[k])))
    return tuple(sizes)


def _smallest_size(
    label: str, effect: str, item: EffectParameter, size: float, sigma: float, index: int
) -> SmallestSize:
    return SmallestSize(label, effect, item.name, item.unit, size, departure(item, size), sigma, index)


def departure(item: EffectParameter, size: float) -> float:
    """How far a parameter is from its null where the fitted value is so by `size`; of a reciprocal, its value.

    Infinite (of a reciprocal zero) where the size is.
    """
    if not np.isfinite(size):
        return 0.0 if item.reciprocal else float("inf")
    value = item.physical_value(item.fitted_null + size)
    return value if item.reciprocal else value - item.null
