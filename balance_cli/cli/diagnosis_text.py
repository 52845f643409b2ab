"""A diagnosis as JSON keys for scripts, and as text for the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.cli.model_summary import declared_summary, effect_summary, modes_summary, parameters_summary
from balance_cli.diagnosis.result import Diagnosis
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.diagnosis.significance import DATA_TEST_LEVEL
from balance_cli.estimation.choices import GOOD_FIT_CHI2_PER_DOF
from balance_cli.io.percent import percent_text

if TYPE_CHECKING:
    from balance_cli.diagnosis.result import FoundEffect, HoldOut, RunErrors, Trial
    from balance_cli.estimation.identified_model import IdentifiedModel

EXPECTED_SHOWN = 10.0
"""Expected error over the noise, from which it is shown."""
COLUMN_WIDTH = 11
"""Width of a component's column."""


# ---- summary ---------------------------------------------------------------------------------------------------------


def diagnosis_summary(diagnosis: Diagnosis, updated_model: IdentifiedModel) -> dict[str, Any]:
    """Return the JSON keys of docs/json.md, with the trials and tests that led to the verdict."""
    return {
        "verdict": diagnosis.verdict,
        "effects": [_effect_evidence_summary(effect) for effect in diagnosis.effects],
        "not_testable": [{"name": item.name, "why": item.reason} for item in diagnosis.untestable_effects],
        "hold_out": {name: _known_items(asdict(errors)) for name, errors in diagnosis.hold_out.items()},
        "chi2_per_dof": {"before": diagnosis.chi2_per_dof_before, "after": diagnosis.chi2_per_dof_after},
        "frf_error": {"before": diagnosis.frf_error_before, "after": diagnosis.frf_error_after},
        "frf_band": updated_model.quality.frf_band,
        "band": updated_model.band,
        "parameters": parameters_summary(updated_model.parameters),
        "declared": declared_summary(updated_model),
        "modes": {"before": modes_summary(diagnosis.modes_before), "after": modes_summary(diagnosis.modes_after)},
        "candidates": diagnosis.candidate_count,
        "trials": [_trial_summary(trial) for trial in diagnosis.trials],
        "tests": [asdict(test) for test in diagnosis.data_tests],
        "location": diagnosis.location,
        "left_out_of_fit": None if diagnosis.left_out is None else asdict(diagnosis.left_out),
        "notes": diagnosis.notes,
        "converged": updated_model.converged,
    }


def _effect_evidence_summary(effect: FoundEffect) -> dict[str, Any]:
    """The JSON keys of an effect and of its evidence."""
    evidence = effect.evidence
    return {
        **effect_summary(effect),
        "evidence": {
            "gain": evidence.gain,
            "parameters": evidence.parameters,
            "p_value": evidence.p_value,
            "score": evidence.score,
            "folds": evidence.cross_validation_gain,
            "round": evidence.round,
            "empirical": evidence.empirical,
        },
        "indistinguishable_from": effect.indistinguishable_from,
        "separated_by": effect.separated_by,
        "worth": effect.worth,
        "of_no_consequence": effect.is_of_no_consequence,
        "doubtful": bool(effect.is_doubtful),
    }


def _trial_summary(trial: Trial) -> dict[str, Any]:
    return {
        "round": trial.round,
        "label": trial.label,
        "score": trial.score,
        "parameters": trial.parameters,
        "p_value": trial.p_value,
        "gain": trial.gain,
        "decision": trial.decision,
        "why": trial.reason,
        "folds": trial.cross_validation_gain,
        "noise_dof": trial.noise_dof,
    }


# ---- text ------------------------------------------------------------------------------------------------------------


def diagnosis_text(diagnosis: Diagnosis) -> Iterator[str]:
    """Return the lines of the text: verdict, effects with their evidence, hold-out errors, and what was not tested."""
    yield f"Verdict: {diagnosis.verdict}: {diagnosis.meaning}"
    chi2 = _before_after_text(diagnosis.chi2_per_dof_before, diagnosis.chi2_per_dof_after)
    error = _before_after_text(100 * diagnosis.frf_error_before, 100 * diagnosis.frf_error_after)
    yield f"chi2/dof {chi2} against the measured noise, error of the responses {error} %"
    if diagnosis.location:
        yield f"Remaining residual: {diagnosis.location}"
    if diagnosis.left_out is not None:
        yield f"Left out: {diagnosis.left_out.description}"
    if diagnosis.effects and diagnosis.chi2_per_dof_after > GOOD_FIT_CHI2_PER_DOF:
        yield "The updated model does not describe these data: the uncertainties below are underestimated"
    for effect in diagnosis.effects:
        yield from _effect_text(effect)
    if diagnosis.location:
        yield from _shown_by_data_text(diagnosis)
        yield from _removed_text(diagnosis)
    yield from _hold_out_text(diagnosis.hold_out)
    if diagnosis.untestable_effects:
        yield "Not testable with these runs:"
        yield from (f"   {item.name}: {item.reason}" for item in diagnosis.untestable_effects)
    yield from diagnosis.notes


def _before_after_text(before: float, after: float) -> str:
    return f"{before:.3g} -> {after:.3g}"


def _effect_text(effect: FoundEffect) -> Iterator[str]:
    evidence = effect.evidence
    kind = ", empirical: describes the data without explaining them" if evidence.empirical else ""
    count = f"{evidence.parameters} parameter{'' if evidence.parameters == 1 else 's'}"
    rise = f"without it chi2 rises by {_gain_text(evidence.gain)}"
    yield f"{effect.label}{kind}: {rise} ({count}, p {_p_value_text(evidence.p_value)})"
    for item in effect.parameters:
        interval = "" if item.interval is None else "   95 %: {:.4g} to {:.4g}".format(*item.interval)
        yield f"   {item.name:<24} {item.value:12.5g} +- {item.sigma:<9.2g} {item.unit}{interval}"
    if effect.worth:
        largest = max(effect.worth, key=lambda name: effect.worth[name] if effect.worth else 0.0)
        yield f"   worth: without it {largest} at the rotor harmonics is off by up to {effect.worth[largest]:.2g} sigma"
    if effect.is_doubtful:
        yield "   doubtful: the records disagree on it, and what no effect explains may look like it"
    if effect.is_of_no_consequence:
        yield "   of no consequence: it moves no load by a tenth of its sigma"
    if effect.indistinguishable_from:
        yield f"   cannot be distinguished from {', '.join(effect.indistinguishable_from)}"
        if effect.separated_by:
            yield f"   measurement that would separate them: {effect.separated_by}"


def _gain_text(gain: float) -> str:
    """A gain of chi-square; Wald's statistic of a strong effect is right to an order of magnitude."""
    return f"about {gain:.1g}" if gain >= DEFAULT_SETTINGS.selection.strong_gain else f"{gain:.4g}"


def _shown_by_data_text(diagnosis: Diagnosis) -> Iterator[str]:
    """What the data show without a model, the clearest of each kind: it narrows down what an effect must explain."""
    clear = [test for test in diagnosis.data_tests if test.p_value < DATA_TEST_LEVEL]
    clear.sort(key=lambda test: -test.chi2 / max(test.dof, 1.0))
    for name in dict.fromkeys(test.name for test in clear):
        first, *others = [test for test in clear if test.name == name]
        more = f" ({len(others)} more)" if others else ""
        yield f"Shown without a model: {name}, {first.place}: {first.finding}{more}"


def _removed_text(diagnosis: Diagnosis) -> Iterator[str]:
    """What the search found and did not keep: where a residual is left, it says where to look."""
    kept = {effect.label for effect in diagnosis.effects}
    removed: dict[str, dict[str, None]] = {}
    for trial in diagnosis.trials:
        if trial.decision == "removed" and trial.label not in kept:
            removed.setdefault(trial.reason, {})[trial.label] = None
    for reason, labels in removed.items():
        yield f"Found and not kept: {', '.join(labels)}: {reason}"


def _p_value_text(value: float) -> str:
    return f"{value:.1e}" if value > 1e-99 else "< 1e-99"


def _known_items(items: dict[str, object]) -> dict[str, object]:
    """The items that are known."""
    return {key: value for key, value in items.items() if value is not None}


def _hold_out_text(hold_out: dict[str, HoldOut]) -> Iterator[str]:
    """A block for each run: a column for each component; rows before, after, noise floor, and what is expected.

    The last one where it is more than noise: loads that rest on the declaration are not known better.
    """
    if not hold_out:
        return
    yield "Errors on hold-out runs, %; interaction in brackets"
    for run, errors in hold_out.items():
        parts = {"before": errors.before, "after": errors.after, "noise": errors.noise}
        if errors.expected is not None and errors.expected.frf_error > EXPECTED_SHOWN * errors.noise.frf_error:
            parts["expected"] = errors.expected
        known = {*errors.after.load_error, *errors.after.interaction}
        components = [name for name in COMPONENTS if name in known]
        yield f"   {run:<16}" + "".join(f"{title:>{COLUMN_WIDTH}}" for title in (*components, "response"))
        for label, part in parts.items():
            cells = [*(_component_text(part, component) for component in components), _percent(part.frf_error)]
            yield f"      {label:<13}" + "".join(f"{cell:>{COLUMN_WIDTH}}" for cell in cells)


def _component_text(errors: RunErrors, component: str) -> str:
    if component in errors.load_error:
        return _percent(errors.load_error[component])
    return f"({_percent(errors.interaction[component])})" if component in errors.interaction else "-"


def _percent(ratio: float) -> str:
    return percent_text(ratio, 3) if math.isfinite(ratio) else "-"
