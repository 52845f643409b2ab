"""The story of a diagnosis in words: what the residual looked like, what explained it, and what was ruled out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.diagnosis.result import (
    CONTRADICTED,
    EXPLAINED,
    NOTHING_MISSING,
    Diagnosis,
    FoundEffect,
    ModelFreeTest,
    Trial,
)
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.choices import GOOD_FIT_CHI2_PER_DOF
from balance_cli.report.blocks import BulletList, PageBlock, Paragraph, Row, Table, TableCell, plain_row
from balance_cli.report.diagnosis_errors import pooled_hold_out_errors
from balance_cli.report.number_format import (
    MISSING_VALUE,
    capitalize_first,
    format_percent,
    format_significant,
    join_names,
)

TEST_SIGNIFICANCE = 0.01
"""p-value below which a test of the data found a difference, the level of the verdicts."""
RULED_OUT_BY = {
    "channels of a cell": "no gain, delay, filter or crosstalk of these channels",
    "first against last periods": "no gain or delay that drifts within the records",
    "static against low frequency": "static and dynamic responses agree where frequency goes to zero",
    "low against high level": "no effect that grows with the load: friction, play, cubic or quadratic stiffness",
    "rest against spin": "no effect of the turning rotor",
    "mains": "no mains interference",
}
"""What equal data say, by the name of the test."""


def accepted_sentences(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield for each effect found how it came in, and the misfit without it."""
    for effect in sorted(diagnosis.effects, key=lambda effect: effect.evidence.round):
        yield f"{effect.label}: {_entry_text(diagnosis, effect)}.{_without_text(diagnosis, effect)}"


def _entry_text(diagnosis: Diagnosis, effect: FoundEffect) -> str:
    number = effect.evidence.round
    trials = [trial for trial in diagnosis.trials if trial.round == number and trial.gain == trial.gain]
    own = next((trial for trial in trials if trial.label == effect.label and trial.decision == "accepted"), None)
    if own is None:
        return f"added in round {number}"
    others = [trial for trial in trials if trial.decision == "rejected" and trial.gain > 0]
    words = f"accepted in round {number}" if number else "found before the search"
    if own.reason:
        words += f", because {own.reason}"
    if not others or not own.gain > 0:
        return words
    listed = [f"{trial.label} {format_percent(trial.gain / own.gain)} %" for trial in _largest(others)]
    return f"{words}; others gained less of chi-square in its place: {join_names(listed)} of what it gained"


def _largest(trials: Sequence[Trial]) -> list[Trial]:
    return sorted(trials, key=lambda trial: -trial.gain)[:3]


def chi2_per_dof_without(diagnosis: Diagnosis, effect: FoundEffect) -> float:
    """Return chi2/dof of the updated model without one of its effects; NaN where it cannot be told.

    Where the updated model does not describe the data, the gains of effects are those of weights with a model error.
    """
    if not diagnosis.dof or not diagnosis.chi2_per_dof_after <= GOOD_FIT_CHI2_PER_DOF:
        return float("nan")
    return diagnosis.chi2_per_dof_after + effect.evidence.gain / diagnosis.dof


def _without_text(diagnosis: Diagnosis, effect: FoundEffect) -> str:
    value = chi2_per_dof_without(diagnosis, effect)
    if value != value:
        return ""
    before = format_significant(diagnosis.chi2_per_dof_after)
    # Of a strong effect the gain is Wald's statistic, which is right to an order of magnitude.
    strong = effect.evidence.gain >= DEFAULT_SETTINGS.selection.strong_gain
    without = f"about {format_significant(value, 1)}" if strong else format_significant(value)
    return f" Without it chi2/dof would be {without} in place of {before}."


def ruled_out_items(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield what the data rule out by themselves, then the candidates that were refitted and not taken."""
    names = dict.fromkeys(test.name for test in diagnosis.data_tests)
    for name in names:
        yield from _test_items([test for test in diagnosis.data_tests if test.name == name])
    accepted = {effect.label for effect in diagnosis.effects}
    reasons: dict[str, list[str]] = {}
    for trial in diagnosis.trials:
        refused = trial.decision in ("rejected", "removed") and trial.label not in accepted
        if refused and trial.label not in reasons.setdefault(trial.reason or "no gain", []):
            reasons[trial.reason or "no gain"].append(trial.label)
    for reason, labels in reasons.items():
        more = f" and {len(labels) - 6} more" if len(labels) > 6 else ""
        yield f"{', '.join(labels[:6])}{more}: {reason}"
    refitted = {trial.label for trial in diagnosis.trials if trial.decision != "not refitted"}
    left = diagnosis.candidate_count - len(accepted | refitted)
    if left > 0:
        yield f"the score test ranked {left} further candidates lower; none of them was refitted"


def _test_items(tests: Sequence[ModelFreeTest]) -> Iterator[str]:
    equal = [test for test in tests if not test.p_value < TEST_SIGNIFICANCE]
    if equal:
        what = RULED_OUT_BY.get(tests[0].name, "no difference")
        places = join_names([test.place for test in equal[:3]])
        more = f" and {len(equal) - 3} more" if len(equal) > 3 else ""
        yield f"{tests[0].name}, {len(equal)} of {len(tests)} without a significant difference ({places}{more}): {what}"


def worth_table(effects: Sequence[FoundEffect]) -> Table | None:
    """Return the worth of each effect for each load component; None where no effect has one."""
    shown = [effect for effect in effects if effect.worth]
    names = [name for name in COMPONENTS if any(name in (effect.worth or {}) for effect in shown)]
    if not shown:
        return None
    head = plain_row("effect", *names)
    rows: list[Row] = []
    for effect in shown:
        worth = effect.worth or {}
        most = max(worth.values())
        cells = (
            TableCell(
                format_significant(worth[name], 2) if name in worth else MISSING_VALUE,
                mark="best" if worth.get(name) == most else "",
            )
            for name in names
        )
        rows.append((TableCell(effect.label, mark="name"), *cells))
    caption = (
        "What each effect is worth: the largest error of a harmonic load at the rotor speed if the model had all other "
        "effects and not this one, over the sigma of the load. Above 2 the load would be wrong beyond its stated "
        "95 % interval; below 0.1 the effect is of no consequence. Bold: the largest of its row."
    )
    return Table(caption, (head,), tuple(rows))


def worth_paragraphs(diagnosis: Diagnosis) -> Iterator[PageBlock]:
    """Yield one sentence on all effects together: errors of known hub loads before and after."""
    before, after = (pooled_hold_out_errors(diagnosis, stage, "load_error") for stage in ("before", "after"))
    names = [name for name in after if name in before]
    if names:
        worst = max(names, key=lambda name: before[name].value)
        yield Paragraph(
            f"All together, on known loads that no fit has used: the error of {worst} goes from "
            f"{format_percent(before[worst].value)} % to {format_percent(after[worst].value)} % (noise alone "
            f"{format_percent(after[worst].noise)} %)."
        )


def open_question_items(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield what remains open, each with the measurement that would settle it."""
    if diagnosis.verdict == CONTRADICTED:
        yield "the update makes hold-out runs worse: do not use it; find what differs between these and the other runs"
    if diagnosis.left_out is not None:
        yield diagnosis.left_out.description
    for effect in diagnosis.effects:
        if effect.indistinguishable_from:
            remedy = f": {effect.separated_by} separates them" if effect.separated_by else ""
            others = join_names(effect.indistinguishable_from)
            yield f"{effect.label} cannot be told from {others} with these runs{remedy}"
        if effect.evidence.empirical:
            yield f"{effect.label} describes a resonance without naming its cause: search for a part that moves there"
    for item in diagnosis.untestable_effects:
        yield f"{item.name} was not tested: {item.reason}"
    if not diagnosis.hold_out:
        yield "the gain is not verified: keep a run out of the fit (--hold-out), best one with known loads"


def open_question_blocks(diagnosis: Diagnosis) -> Iterator[PageBlock]:
    """Yield what would settle what remains, or that nothing remains."""
    items = [capitalize_first(item) for item in open_question_items(diagnosis)]
    if diagnosis.verdict in (EXPLAINED, NOTHING_MISSING):
        yield Paragraph("Nothing remains in these data beyond their noise." + (" Open is:" if items else ""))
    else:
        where = diagnosis.location.rstrip(".") or "see the map of the residual above"
        yield Paragraph(
            f"Something remains that no effect explains ({where}). Sweeps with finer lines there, and at a "
            "second level, show whether it is a resonance or grows with the load."
        )
    if items:
        yield BulletList(tuple(items))
