"""The score test: the predicted gain of a candidate, from its derivative at the null, without a refit.

With half the gradient g and the information I of the model in which the candidate is at its null (f: fitted parameters
with their priors, c: parameters of the candidate),

    s = -(g_c - I_cf I_ff^-1 g_f),    V = I_cc - I_cf I_ff^-1 I_fc,    gain = max 2 s'd - d'V d

over the changes d that the candidate's bounds allow. Without bounds gain = s'V^-1 s, which is chi-square distributed
where nothing is missing (Rao, Proc. Camb. Phil. Soc. 44 (1948) 50). One curvature serves many candidates, because none
of them changes the equations at its null.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.search.bounded_gain import best_gain, one_sided_bounds
from balance_cli.diagnosis.search.candidates import Candidate, parameters_of_interest
from balance_cli.diagnosis.search.extended_models import (
    add_all_starts,
    add_candidates,
    extend_model,
    free_names,
    hold_other_parameters,
)
from balance_cli.diagnosis.search.point_mass import place_mass_candidates
from balance_cli.diagnosis.search.projected_scores import ParameterIndices, ProjectedScore, project_out_fitted
from balance_cli.diagnosis.settings import ScoreSettings, SearchSettings
from balance_cli.diagnosis.significance import gain_p_value
from balance_cli.estimation.batch import MAX_DERIVATIVE_BYTES, Batch, select_lines, split_by_run
from balance_cli.estimation.levenberg_marquardt import limit_to_bounds
from balance_cli.estimation.maximum_likelihood import penalized_chi2
from balance_cli.model.balance import Estimate
from balance_cli.model.placed_effects import PlacedEffect

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Score:
    """The predicted gain of a candidate in chi-square, with so many `parameters`, from start number `start`.

    Start values that were fitted to the data count among the parameters. `expected`: gain by a change of every
    parameter by its scale, which is what the data could show. Of its parameters of interest: `information` (q, q), V;
    `step` (q,), the change that gains, and `fitted_step` (f,), the change of the fitted parameters with it.
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
        """The p-value of the gain, of this candidate alone."""
        return gain_p_value(self.gain, self.parameters, self.noise_dof)


def has_nuisance_parameters(score: Score) -> bool:
    """Return whether a score depends on parameters that are unidentifiable at the null, and may be far too small."""
    return any(item.nuisance for item in score.candidate.placed_effect.parameters)


def scores(
    estimate: Estimate, batches: Sequence[Batch], candidates: Sequence[Candidate], settings: ScoreSettings
) -> tuple[Score, ...]:
    """Return the score of every candidate, the best of its starts."""
    best: dict[str, Score] = {}
    trials = [
        (candidate, number)
        for candidate in candidates
        for number in range(len(candidate.starts))
        if _is_new_null(candidate, number)
    ]
    separate = split_by_run(batches)
    # The first starts are hundreds of parameters, which the forces of the further ones would carry along.
    for kind in ([trial for trial in trials if trial[1] == 0], [trial for trial in trials if trial[1] > 0]):
        groups = _split_trials(kind, len(free_names(estimate.model)), separate)
        for score in (score for group in groups for score in _score_trials(estimate, separate, group, settings)):
            label = score.candidate.label
            if label not in best or score.gain > best[label].gain:
                best[label] = score
    return tuple(best[candidate.label] for candidate in candidates)


def score_in_two_stages(
    estimate: Estimate, batches: Sequence[Batch], candidates: Sequence[Candidate], settings: SearchSettings
) -> tuple[Score, ...]:
    """Return the scores of all candidates: the best of them on all lines, the others on a subset.

    On all lines a candidate is scored at the best of its starts on the subset.
    """
    limits = settings.score
    stride = sum(len(batch.lines.index) for batch in batches) // limits.screening_lines
    candidates = place_mass_candidates(candidates, estimate, batches, settings)
    if stride < 2:
        return scores(estimate, batches, candidates, limits)
    tones = _tone_frequencies(candidates)
    subset = [select_lines(batch, _screening_mask(batch, stride, tones, limits.tone_lines)) for batch in batches]
    result = {
        score.candidate.label: replace(score, expected=stride * score.expected)
        for score in scores(estimate, subset, candidates, limits)
    }
    ranked = sorted(result.values(), key=lambda score: score.gain / max(score.parameters, 1), reverse=True)
    leading = ranked[: limits.full_score_candidates]
    on_all_lines = scores(estimate, batches, [_at_best_start(score) for score in leading], limits)
    for screened, score in zip(leading, on_all_lines, strict=True):
        result[score.candidate.label] = replace(score, candidate=screened.candidate, start=screened.start)
    return tuple(result.values())


def _at_best_start(score: Score) -> Candidate:
    """The candidate with the start of its score as the only one, so that one curvature serves all candidates."""
    return replace(score.candidate, starts=(score.candidate.starts[score.start],))


def _tone_frequencies(candidates: Sequence[Candidate]) -> tuple[float, ...]:
    """The frequencies [Hz] at which the tones among the candidates begin."""
    hints = [(candidate, candidate.effect.search.tone) for candidate in candidates]
    starts = [start[tone.frequency] for candidate, tone in hints if tone is not None for start in candidate.starts]
    return tuple(dict.fromkeys(starts))


def _screening_mask(batch: Batch, stride: int, tones: Sequence[float], tone_lines: int) -> NDArray[np.bool_]:
    """Every n-th line, but all lines at frequency zero and beside a tone, whose information no other line has."""
    frequency = batch.line_frequency
    mask = (frequency == 0) | (np.arange(len(frequency)) % stride == 0)
    for tone in tones:
        distance = np.abs(frequency - tone)
        for lines in batch.parts:
            nearest = np.argsort(distance[lines], kind="stable")[:tone_lines]
            mask[lines.start + nearest] = True
    return np.asarray(mask)


def _is_new_null(candidate: Candidate, number: int) -> bool:
    """Whether this start has another null model than the first one."""
    return number == 0 or candidate.at_null(candidate.starts[number]) != candidate.at_null(candidate.starts[0])


def _split_trials(
    trials: Sequence[tuple[Candidate, int]], fitted: int, batches: Sequence[Batch]
) -> list[list[tuple[Candidate, int]]]:
    """Groups of trials whose derivatives of the largest batch, beside those of the `fitted` parameters, fit in memory.

    With what they are made of, two runs at a time, they take ten times as many bytes. Each group computes those of the
    fitted parameters anew, so that it has at least as many of its own.
    """
    room = max(MAX_DERIVATIVE_BYTES // max(batch.lines.channels.nbytes for batch in batches) - fitted, fitted)
    groups: list[list[tuple[Candidate, int]]] = []
    taken = room
    for trial in trials:
        own = len(parameters_of_interest(trial[0].placed_effect.parameters))
        if taken + own > room:
            groups.append([])
            taken = 0
        groups[-1].append(trial)
        taken += own
    return groups


def _score_trials(
    estimate: Estimate, batches: Sequence[Batch], trials: Sequence[tuple[Candidate, int]], settings: ScoreSettings
) -> list[Score]:
    """The score of each candidate from the start of this number."""
    null, placed = add_all_starts(estimate, trials)
    tested = [_tested_names(effect) for effect in placed]
    names = {name for each in tested for name in each}
    extended = hold_other_parameters(null.model, estimate.model, names)
    indices = ParameterIndices.from_names(free_names(extended), tested)
    projected = project_out_fitted(extended, null.theta, batches, indices, settings)
    return [_score(*trial, part, settings) for trial, part in zip(trials, projected, strict=True)]


def _tested_names(effect: PlacedEffect) -> list[str]:
    """Full names of the parameters of interest of an effect."""
    return [effect.full_name(item) for item in parameters_of_interest(effect.parameters)]


def _score(candidate: Candidate, number: int, part: ProjectedScore, settings: ScoreSettings) -> Score:
    items = parameters_of_interest(candidate.placed_effect.parameters)
    informed = np.diag(part.V) > settings.min_remaining_share * np.maximum(part.raw, np.finfo(float).tiny)
    scale = np.array([item.fitted_scale for item in items])
    lower, upper = (bound[informed] for bound in one_sided_bounds(items))
    V = part.V[np.ix_(informed, informed)]
    best = best_gain(part.s[informed], V, lower, upper, settings.min_information_share)
    step = np.zeros(len(items))
    step[informed] = best.step
    noise_dof = part.noise_dof
    if best.gain > settings.min_tested_gain:
        noise_dof = max(min(noise_dof, part.gain_dof(step, best.gain)), settings.min_noise_dof)
    return Score(
        candidate=candidate,
        start=number,
        gain=best.gain,
        parameters=best.directions + candidate.fitted_start_values,
        expected=float(scale[informed] ** 2 @ np.diag(part.V)[informed]),
        noise_dof=noise_dof,
        information=part.V,
        step=step,
        fitted_step=part.fitted_step - part.projection @ step,
    )


# ---- fits from a score -----------------------------------------------------------------------------------------------


def add_scored_candidate(geometry: Geometry, score: Score) -> Geometry:
    """Return the geometry with the candidate of a score at the values from which it is fitted."""
    candidate = score.candidate
    values = candidate.start_from_score(geometry, score.start, [float(d) for d in score.step])
    return geometry.model_copy(update={"effects": (*geometry.effects, candidate.at_start(values))})


def apply_score_step(estimate: Estimate, batches: Sequence[Batch], score: Score, settings: ScoreSettings) -> Estimate:
    """Return the estimate with a candidate at the step of its score, from which a weak effect is quickly fitted.

    The fitted parameters follow, within their bounds. The step is shortened until chi-square falls.
    """
    null = extend_model(estimate, add_candidates(estimate.geometry, [(score.candidate, score.start)]))
    extended, step = null.model, np.zeros(len(null.theta))
    step[[extended.parameters.index(name) for name in free_names(estimate.model)]] = score.fitted_step
    step[[extended.parameters.index(name) for name in _tested_names(score.candidate.placed_effect)]] = score.step
    before = penalized_chi2(null, batches)
    for fraction in settings.step_fractions:
        stepped = extended.at(limit_to_bounds(extended.parameters, null.theta, null.theta + fraction * step))
        if penalized_chi2(stepped, batches) < before:
            return stepped
    return null
