"""Close the loop: find what a model lacks, add it, and say what it was worth."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.data_tests.model_free import model_free_tests
from balance_cli.diagnosis.residual_map import location, residual_map
from balance_cli.diagnosis.result import (
    EXPLAINED,
    NOTHING_MISSING,
    PARTLY_EXPLAINED,
    UNEXPLAINED,
    Diagnosis,
    Evidence,
    FoundEffect,
    Trial,
)
from balance_cli.diagnosis.search.initial_candidates import seeds
from balance_cli.diagnosis.search.mass_region import mass_intervals
from balance_cli.diagnosis.search.refit import State
from balance_cli.diagnosis.search.search import WRONG, Found, search
from balance_cli.diagnosis.search.search_lines import search_lines
from balance_cli.diagnosis.search.unmodelled_modes import with_extra_modes
from balance_cli.diagnosis.selection.alternatives import Standing, contested
from balance_cli.diagnosis.selection.confirm import SIGNIFICANT, Confirmed, chance, confirm
from balance_cli.diagnosis.selection.effect_selection import believed, pruned, with_only
from balance_cli.diagnosis.selection.fit import Fit, fitted
from balance_cli.diagnosis.selection.mains_frequency import at_best_frequency
from balance_cli.diagnosis.selection.testability import not_testable
from balance_cli.estimation.fit_quality import fit_quality
from balance_cli.estimation.identifiability import parameter_support
from balance_cli.estimation.identified_model import FitQuality, IdentifiedModel
from balance_cli.estimation.likelihood import data_curvature
from balance_cli.estimation.maximum_likelihood import TOLERANCE
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.estimation.measurements import Batch, stacked
from balance_cli.estimation.model_error import with_model_error
from balance_cli.io.errors import UserError
from balance_cli.model.balance import BalanceModel, balance_model
from balance_cli.model.fitted_effects import FittedEffect
from balance_cli.model.placed_effects import declared_effects
from balance_cli.signals.run_spectrum import RecordWaveform
from balance_cli.steps.identify import described, identified_effects

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

GOOD_FIT = 1.2
"""Chi-square per degree of freedom up to which a model describes its data (contract, verdicts)."""
TOO_GOOD = 0.7
"""Chi-square per degree of freedom below which the noise was less than was measured."""
MOST_LOOKS = 2
"""How often what is missing is asked, once more where a rival has taken an effect's place."""


def diagnose(
    model: IdentifiedModel, spectra: Spectra, progress: Progress | None = None
) -> tuple[Diagnosis, IdentifiedModel]:
    """The diagnosis, without hold-out runs, and the closed model.

    `spectra` come with means and waveforms. Raises UserError for a model of the paper's form, and without any sweep.
    """
    if model.form != "physical":
        raise UserError("the paper's form has no parameters to add to", "MODEL", remedy="Identify with --form physical")
    if not spectra.lines:
        raise UserError("no sweep run to diagnose with", remedy="Give at least one sweep run")
    say = _Steps(progress)
    batches = stacked(spectra.lines, spectra.statics, model.geometry.channel_names)
    start = balance_model(model.geometry)
    before = (start, np.array(model.parameters.value, float))
    loop = _closed_loop(*before, spectra, batches, say)
    fit, after, quality = loop.fit, (loop.fit.model, loop.fit.theta), _quality(*before, batches)
    closed = described(fit.model, batches, fit.minimum, "ml", "diagnosis", spectra.channels_left_out)
    if _labels(fit.model) == _labels(start) and closed.quality.chi2 > quality.chi2:
        # Nothing came in or went, and a fit that had to carry a model error is no better than the one given.
        closed, after = model, before
    effects = _effects(closed, loop, mass_intervals(fit.model, fit.theta, batches))
    residuals = residual_map(batches, before, after)
    verdict = _verdict(effects, loop.confirmed, closed.quality)
    diagnosis = Diagnosis(
        geometry=model.geometry,
        verdict=verdict,
        effects=effects,
        trials=loop.trials,
        tests=model_free_tests(spectra, model.geometry, float(closed.modes.frequency.min())),
        not_testable=not_testable(loop.confirmed.scores, spectra, fit.model.geometry),
        chi2_per_dof_before=quality.chi2_per_dof,
        chi2_per_dof_after=closed.quality.chi2_per_dof,
        frf_error_before=quality.frf_error,
        frf_error_after=closed.quality.frf_error,
        modes_before=model.modes,
        modes_after=closed.modes,
        residual=residuals,
        candidates=len(loop.confirmed.scores),
        location="" if verdict in (NOTHING_MISSING, EXPLAINED) else location(residuals),
        notes=_notes(spectra, fit, closed.quality),
    )
    say("done")
    return diagnosis, closed


@dataclass(frozen=True)
class _Loop:
    """Where the loop ended: the fit, how each effect in it stands, all that was tried, and the tests against noise."""

    fit: Fit
    standings: dict[str, Standing]
    trials: tuple[Trial, ...]
    confirmed: Confirmed


def _closed_loop(
    start: BalanceModel, theta: Array, spectra: Spectra, batches: Sequence[Batch], say: Callable[[str], None]
) -> _Loop:
    """Search, and test what was found; where that leaves a residual, with resonances that describe it."""
    lines = search_lines(spectra, start.geometry.channel_names)
    given = _labels(start)
    say("search")
    found = search(start, theta, lines, say, seeds(spectra.lines, start.geometry))
    sure = given | {item.label for item in found.trials if item.round == 0}
    loop = _tested(found.state, batches, given, sure, found, say)
    if _described_well(loop.confirmed, _quality(loop.fit.model, loop.fit.theta, batches)):
        return loop
    # A resonance that nobody has written down may have passed for an effect: it is also sought without those found.
    beginnings = [(loop.fit.model, loop.fit.theta)]
    if not _labels(loop.fit.model) <= sure:
        beginnings.append(with_only(sure, loop.fit.model.geometry, start, theta))
    state, tried = with_extra_modes(beginnings, lines, _last_round(loop.trials) + 1, say)
    trials = (*loop.trials, *tried)
    if state is None:
        return replace(loop, trials=trials)
    return _tested(state, batches, given, sure, replace(found, trials=trials), say)


def _tested(
    state: State,
    batches: Sequence[Batch],
    given: Collection[str],
    sure: Collection[str],
    found: Found,
    say: Callable[[str], None],
) -> _Loop:
    """What holds of a search on all lines: confirmed, pruned, believed, and held against its rivals."""
    say("maximum likelihood of all lines")
    # While the model is still wrong, nothing can be judged by the noise alone.
    wrong = state.error > WRONG
    judged = with_model_error(batches, state.shares) if wrong else batches
    fit = fitted(state.model, state.theta, judged)
    fit = at_best_frequency(fit, declared_effects(fit.model.geometry), judged)
    trials, rivals = found.trials, _rivals(found)
    for look in range(MOST_LOOKS):
        confirmed = confirm(fit, judged, not wrong, _last_round(trials) + 1, say)
        say("what is needed")
        trials, rivals = (*trials, *confirmed.trials), {**rivals, **_near(confirmed)}
        count, last = len(confirmed.scores), _last_round(trials) + 1
        fit, removed = pruned(confirmed.fit, judged, count, last)
        fit, doubted = believed(fit, judged, not wrong, sure, last)
        stands = contested(fit, judged, given, rivals, count, last + 1, say)
        trials, fit = (*trials, *removed, *doubted, *stands.trials), stands.fit
        if not stands.trials or look == MOST_LOOKS - 1:
            break
    fit = fitted(fit.model, fit.theta, judged, TOLERANCE)
    return _Loop(fit, stands.standings, trials, confirmed)


def _labels(model: BalanceModel) -> set[str]:
    return {one.label for one in declared_effects(model.geometry)}


def _last_round(trials: Sequence[Trial]) -> int:
    return max((trial.round for trial in trials), default=0)


class _Steps:
    """Tells the progress; every call is a step further, the last one the end."""

    EXPECTED = 16

    def __init__(self, progress: Progress | None) -> None:
        self._progress, self._count = progress, 0

    def __call__(self, what: str) -> None:
        self._count += 1
        if self._progress is not None:
            self._progress(what, 1.0 if what == "done" else min(self._count / self.EXPECTED, 0.95))


def _quality(model: BalanceModel, theta: Array, batches: Sequence[Batch]) -> FitQuality:
    """How well the model given describes the lines, as it is."""
    system = model.system(theta)
    determined = parameter_support(model.parameters, data_curvature(batches, system).information).determined
    return fit_quality(batches, system, determined)


def _described_well(confirmed: Confirmed, quality: FitQuality) -> bool:
    return confirmed.left >= SIGNIFICANT and quality.chi2_per_dof <= GOOD_FIT


def _verdict(effects: Sequence[FoundEffect], confirmed: Confirmed, quality: FitQuality) -> str:
    """As in the contract; a fit that is no good is never `nothing missing`, nor `explained` what is only described."""
    good = _described_well(confirmed, quality)
    if not effects:
        return NOTHING_MISSING if good else UNEXPLAINED
    empirical = any(effect.evidence.empirical for effect in effects)
    return EXPLAINED if good and not empirical else PARTLY_EXPLAINED


def _effects(
    closed: IdentifiedModel, loop: _Loop, intervals: Mapping[str, tuple[float, float]]
) -> tuple[FoundEffect, ...]:
    """The effects that the loop has added, strongest first; those of the model given are not news.

    `intervals`: those of 95 % of parameters, by their full names, where sigma says little.
    """
    described_effects = {one.label: one for one in identified_effects(closed)}
    result = []
    for one in declared_effects(closed.geometry):
        if one.label not in loop.standings:
            continue
        stands = loop.standings[one.label]
        came = next(
            (item for item in loop.trials if item.decision == "accepted" and _same(item.label, one.label)), None
        )
        evidence = Evidence(
            gain=stands.gain,
            parameters=stands.parameters,
            p_value=chance(stands.gain, max(stands.parameters, 1), len(loop.confirmed.scores)),
            score=came.score if came else float("nan"),
            folds=came.folds if came else float("nan"),
            round=came.round if came else 0,
            empirical=one.effect.empirical,
        )
        bounded = tuple(
            replace(item, interval=intervals.get(f"{one.label}.{item.name}"))
            for item in described_effects[one.label].parameters
        )
        effect = replace(described_effects[one.label], parameters=bounded)
        result.append(_found(effect, evidence, stands.alike, one.effect.separated_by))
    return tuple(sorted(result, key=lambda item: -item.evidence.gain))


def _same(tried: str, label: str) -> bool:
    """Whether an effect that was tried is this one, perhaps at a smaller place by now."""
    name, _, where = label.partition("@")
    other, _, there = tried.partition("@")
    return name == other and set(where.split(",")) <= set(there.split(","))


def _rivals(found: Found) -> dict[str, tuple[str, ...]]:
    """Rivals that came near an effect in its round of the search."""
    near = {}
    for label, gains in found.rivals.items():
        near[label] = tuple(name for name, gain in gains.items() if name != label and gain > 0.9 * gains[label])
    return near


def _near(confirmed: Confirmed) -> dict[str, tuple[str, ...]]:
    """Rivals that came near an effect in its round of the tests against the noise."""
    return {label: _within(gaps) for label, gaps in confirmed.rivals.items()}


def _within(gaps: dict[str, float]) -> tuple[str, ...]:
    return tuple(name for name, gap in sorted(gaps.items(), key=lambda item: item[1]) if gap < NEAR)


NEAR = 30.0
"""Chi-square by which a rival may have been behind in its round and still be looked at in the end."""


def _found(effect: FittedEffect, evidence: Evidence, same: tuple[str, ...], separated_by: str) -> FoundEffect:
    separated_by = separated_by if same else ""
    return FoundEffect(effect.name, effect.where, effect.parameters, evidence, same, separated_by, effect.choice)


def _notes(spectra: Spectra, fit: Fit, quality: FitQuality) -> tuple[str, ...]:
    """What the runs given leave untested, and what to make of a chi-square that is too small."""
    notes = []
    distorted = any(isinstance(run.waveform, RecordWaveform) for run in spectra.lines)
    if fit.model.system(fit.theta).forces and distorted and quality.chi2_per_dof < TOO_GOOD:
        notes.append(
            "chi2/dof is below one because the noise of records that do not repeat was measured with the forces found "
            "still in it: every sigma and p is on the safe side"
        )
    levels = {(run.components, run.rotor_speed): set() for run in spectra.lines}  # type: ignore[var-annotated]
    for run in spectra.lines:
        levels[(run.components, run.rotor_speed)].add(tuple(run.level))
    if all(len(each) == 1 for each in levels.values()):
        notes.append("every component was excited at one level only: nothing was compared across levels")
    if len({run.rotor_speed for run in spectra.lines}) == 1:
        notes.append("all sweeps have one rotor speed: nothing was compared across speeds")
    if not spectra.statics:
        notes.append("no static run: what the balance does at rest was not tested")
    return tuple(notes)
