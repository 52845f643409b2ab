"""A diagnosis as a summary for scripts, and in words: verdict first."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.cli.model_summary import effect_summary, modes_summary, parameters_summary
from balance_cli.diagnosis.result import VERDICT_MEANING, Diagnosis
from balance_cli.estimation.choices import GOOD_FIT_CHI2_PER_DOF

if TYPE_CHECKING:
    from balance_cli.diagnosis.result import FoundEffect, HoldOut, RunErrors
    from balance_cli.estimation.identified_model import IdentifiedModel

COLUMN_WIDTH = 9
"""Width of a component's column."""


# ---- summary ---------------------------------------------------------------------------------------------------------


def diagnosis_summary(diagnosis: Diagnosis, updated_model: IdentifiedModel) -> dict[str, Any]:
    """The keys of the contract, and what else tells how the verdict came about."""
    return {
        "verdict": diagnosis.verdict,
        "effects": [_effect_evidence_summary(effect) for effect in diagnosis.effects],
        "not_testable": [asdict(item) for item in diagnosis.not_testable],
        "hold_out": {name: asdict(errors) for name, errors in diagnosis.hold_out.items()},
        "chi2_per_dof": {"before": diagnosis.chi2_per_dof_before, "after": diagnosis.chi2_per_dof_after},
        "frf_error": {"before": diagnosis.frf_error_before, "after": diagnosis.frf_error_after},
        "parameters": parameters_summary(updated_model.parameters),
        "modes": {"before": modes_summary(diagnosis.modes_before), "after": modes_summary(diagnosis.modes_after)},
        "candidates": diagnosis.candidates,
        "trials": [asdict(trial) for trial in diagnosis.trials],
        "tests": [asdict(test) for test in diagnosis.tests],
        "location": diagnosis.location,
        "notes": diagnosis.notes,
        "converged": updated_model.converged,
    }


def _effect_evidence_summary(effect: FoundEffect) -> dict[str, Any]:
    """An effect as the contract has it."""
    return {
        **effect_summary(effect),
        "evidence": asdict(effect.evidence),
        "indistinguishable_from": effect.indistinguishable_from,
        "separated_by": effect.separated_by,
    }


# ---- text ------------------------------------------------------------------------------------------------------------


def diagnosis_text(diagnosis: Diagnosis) -> Iterator[str]:
    """Verdict, effects with their evidence, errors on the hold-out runs, and what could not be tested."""
    yield f"Verdict: {diagnosis.verdict}: {VERDICT_MEANING[diagnosis.verdict]}"
    yield (
        f"chi2/dof {_before_after_text(diagnosis.chi2_per_dof_before, diagnosis.chi2_per_dof_after)} against the "
        "measured noise, "
        "error of the responses "
        f"{_before_after_text(100 * diagnosis.frf_error_before, 100 * diagnosis.frf_error_after)} %"
    )
    if diagnosis.location:
        yield f"What is left: {diagnosis.location}"
    if diagnosis.effects and diagnosis.chi2_per_dof_after > GOOD_FIT_CHI2_PER_DOF:
        yield "The closed model does not describe these data: every sigma below says less than it seems to"
    for effect in diagnosis.effects:
        yield from _effect_text(effect)
    yield from _hold_out_text(diagnosis.hold_out)
    if diagnosis.not_testable:
        yield "These runs say nothing of:"
        yield from (f"   {item.name}: {item.why}" for item in diagnosis.not_testable)
    yield from diagnosis.notes


def _before_after_text(before: float, after: float) -> str:
    return f"{before:.3g} -> {after:.3g}"


def _effect_text(effect: FoundEffect) -> Iterator[str]:
    evidence = effect.evidence
    kind = ", empirical: it describes and does not explain" if evidence.empirical else ""
    count = f"{evidence.parameters} parameter{'' if evidence.parameters == 1 else 's'}"
    rise = f"without it chi2 rises by {evidence.gain:.4g}"
    yield f"{effect.label}{kind}: {rise} ({count}, p {_p_value_text(evidence.p_value)})"
    for item in effect.parameters:
        interval = "" if item.interval is None else "   95 %: {:.4g} to {:.4g}".format(*item.interval)
        yield f"   {item.name:<24} {item.value:12.5g} +- {item.sigma:<9.2g} {item.unit}{interval}"
    if effect.indistinguishable_from:
        yield f"   cannot be told from {', '.join(effect.indistinguishable_from)}"
        if effect.separated_by:
            yield f"   what would separate them: {effect.separated_by}"


def _p_value_text(value: float) -> str:
    return f"{value:.1e}" if value > 1e-99 else "< 1e-99"


def _hold_out_text(hold_out: dict[str, HoldOut]) -> Iterator[str]:
    """A block for each run: components across; before, after and what noise alone would leave down."""
    if not hold_out:
        return
    yield "Errors on runs that no fit has seen, %; interaction in brackets"
    for name, errors in hold_out.items():
        parts = {"before": errors.before, "after": errors.after, "noise": errors.noise}
        components = [one for one in COMPONENTS if one in errors.after.load_error or one in errors.after.interaction]
        yield f"   {name:<16}" + "".join(f"{one:>{COLUMN_WIDTH}}" for one in (*components, "response"))
        for label, part in parts.items():
            cells = [*(_component_text(part, one) for one in components), _percent(part.frf_error)]
            yield f"      {label:<13}" + "".join(f"{cell:>{COLUMN_WIDTH}}" for cell in cells)


def _component_text(errors: RunErrors, component: str) -> str:
    if component in errors.load_error:
        return _percent(errors.load_error[component])
    return f"({_percent(errors.interaction[component])})"


def _percent(ratio: float) -> str:
    return f"{100 * ratio:.3g}" if math.isfinite(ratio) else "-"
