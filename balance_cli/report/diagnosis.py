"""The loop closed: verdict, effects that were missing, and what they were worth on runs that no fit has seen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from balance_cli.diagnosis.result import EXPLAINED, NOTHING_MISSING, VERDICT_MEANING, Diagnosis, ModelFreeTest, Trial
from balance_cli.report.blocks import (
    BulletList,
    Details,
    Heading,
    KeyFigures,
    PageBlock,
    Paragraph,
    Picture,
    Row,
    Section,
    Table,
    TableCell,
    WarningText,
)
from balance_cli.report.diagnosis_figures import hold_out_figure, residual_figure
from balance_cli.report.diagnosis_tables import (
    effect_table,
    format_p_value,
    hold_out_table,
    mode_table,
    parameter_table,
    run_tables,
)
from balance_cli.report.figure_style import svg
from balance_cli.report.number_format import capitalize_first, format_percent, format_significant
from balance_cli.report.parameters import GOOD_FIT_CHI2_PER_DOF
from balance_cli.report.sources import Source, Sources

TEST_SIGNIFICANCE = 0.01


def verdict_sentence(source: Source[Diagnosis]) -> str:
    """The verdict in a sentence, with the effects."""
    made = source.content
    found = f" Found: {', '.join(effect.label for effect in made.effects)}." if made.effects else ""
    return f"{capitalize_first(source.label)}: {made.verdict}; {VERDICT_MEANING[made.verdict]}.{found}"


def section(sources: Sources) -> Section | None:
    """Every diagnosis given; None where there is none."""
    if not sources.diagnoses:
        return None
    blocks: list[PageBlock] = []
    for i, source in enumerate(sources.diagnoses):
        if len(sources.diagnoses) > 1:
            blocks.append(Heading(capitalize_first(source.label)))
        blocks += _diagnosis_blocks(source.content, f"-{i + 1}" if i else "")
    return Section("diagnosis", "Diagnosis: what the model lacks", tuple(blocks))


def _diagnosis_blocks(made: Diagnosis, suffix: str) -> Iterator[PageBlock]:
    yield from _verdict_blocks(made)
    if made.effects:
        if not made.chi2_per_dof_after <= GOOD_FIT_CHI2_PER_DOF:
            yield WarningText(
                "The closed model does not describe these data within their noise: every sigma of a parameter below "
                "says less than it seems to."
            )
        yield from (effect_table(made.effects), parameter_table(made.effects))
    yield from _hold_out_blocks(made, suffix)
    yield from _residual_blocks(made, suffix)
    yield Heading("Eigenfrequencies before and after")
    yield mode_table(made)
    yield from _trial_blocks(made.trials)
    yield from _model_free_test_blocks(made)


def _verdict_blocks(made: Diagnosis) -> Iterator[PageBlock]:
    words = f"{capitalize_first(made.verdict)}: {VERDICT_MEANING[made.verdict]}."
    yield Paragraph(words) if made.verdict in (NOTHING_MISSING, EXPLAINED) else WarningText(words)
    yield KeyFigures(tuple(_key_figures(made)))
    if made.location:
        yield WarningText(f"What is left: {made.location}.")
    if any(effect.evidence.empirical for effect in made.effects):
        yield WarningText("An empirical effect describes what is left; it does not explain it.")
    if made.notes:
        yield BulletList(tuple(capitalize_first(note) for note in made.notes))


def _key_figures(made: Diagnosis) -> Iterator[tuple[str, str, str]]:
    count = len(made.effects)
    yield str(count), f"effect{'' if count == 1 else 's'} found among {made.candidates} candidates", ""
    stages = ((made.chi2_per_dof_before, "before"), (made.chi2_per_dof_after, "after"))
    for ratio, stage in stages:
        yield (
            format_significant(ratio),
            f"chi2/dof {stage} closing",
            "good" if ratio <= GOOD_FIT_CHI2_PER_DOF else "bad",
        )
    yield f"{format_percent(made.frf_error_before)} %", "error of the responses before closing", ""
    yield f"{format_percent(made.frf_error_after)} %", "error of the responses after closing", ""


def _hold_out_blocks(made: Diagnosis, suffix: str) -> Iterator[PageBlock]:
    yield Heading("Error before and after, on runs that no fit has seen")
    if not made.hold_out:
        yield WarningText("No run was held out: nothing here tells what closing is worth.")
        return
    yield hold_out_table(made)
    if any(errors.after.load_error or errors.after.interaction for errors in made.hold_out.values()):
        words = "Errors by component before and after closing, rms over the runs; black: what noise alone would leave."
        name = f"hold-out{suffix}"
        yield Picture(name, words, svg(name, words, lambda: hold_out_figure(made)))
    yield Details("Every hold-out run by itself", tuple(run_tables(made)))


def _residual_blocks(made: Diagnosis, suffix: str) -> Iterator[PageBlock]:
    yield Heading("Residual before and after")
    words = (
        "Whitened residual, rms within bands of frequency: by run over all channels, and by channel over all runs. One "
        "is what noise leaves; grey: no line there. All bands are drawn equally wide."
    )
    name = f"residual{suffix}"
    yield Picture(name, words, svg(name, words, lambda: residual_figure(made.residual)))


def _trial_blocks(trials: Sequence[Trial]) -> Iterator[PageBlock]:
    """Decisions in their order; candidates that never came to a refit on demand."""
    if not trials:
        return
    yield Heading("Chain of trials")
    tried = [trial for trial in trials if trial.decision != "not refitted"]
    others = [trial for trial in trials if trial.decision == "not refitted"]
    caption = (
        "Promised: chi-square that the score test expected to gain before a refit; p: of that, corrected for the "
        "number of candidates; gained: by the refit, penalised for parameters and candidates."
    )
    if tried:
        yield _trial_table(caption, tried)
    if others:
        yield Details(f"{len(others)} that were not refitted", (_trial_table(caption, others),))


def _trial_table(caption: str, trials: Sequence[Trial]) -> Table:
    words = ("round", "candidate", "parameters", "promised", "p", "gained", "decision", "why")
    head = tuple(TableCell(word, mark="text" if word in ("candidate", "decision", "why") else "") for word in words)
    return Table(caption, (head,), tuple(_trial_row(trial) for trial in trials))


def _trial_row(trial: Trial) -> Row:
    mark = {"accepted": "good", "kept": "good", "removed": "bad"}.get(trial.decision, "")
    return (
        TableCell(str(trial.round), mark="name"),
        TableCell(trial.label, mark="text"),
        TableCell(str(trial.parameters)),
        TableCell(format_significant(trial.score)),
        TableCell(format_p_value(trial.p_value)),
        TableCell(format_significant(trial.gain)),
        TableCell(trial.decision, mark=f"text {mark}".strip()),
        TableCell(trial.why, mark="text"),
    )


def _model_free_test_blocks(made: Diagnosis) -> Iterator[PageBlock]:
    """What differs by more than chance; the rest on demand."""
    if made.tests:
        yield Heading("Tests that need no model of the plate")
        differing = [test for test in made.tests if test.p_value < TEST_SIGNIFICANCE]
        alike = [test for test in made.tests if not test.p_value < TEST_SIGNIFICANCE]
        if differing:
            yield _test_table("What differs by more than chance.", differing)
        else:
            yield Paragraph("Nothing differs by more than chance.")
        if alike:
            yield Details(f"{len(alike)} that show nothing", (_test_table("What chance would do as well.", alike),))
    if made.not_testable:
        yield Heading("What these runs say nothing of")
        yield BulletList(tuple(f"{item.name}: {item.why}" for item in made.not_testable))


def _test_table(caption: str, tests: Sequence[ModelFreeTest]) -> Table:
    head = (
        TableCell("test"),
        TableCell("place", mark="text"),
        TableCell("chi2/dof"),
        TableCell("p"),
        TableCell("finding", mark="text"),
    )
    rows = tuple(
        (
            TableCell(test.name, mark="name"),
            TableCell(test.place, mark="text"),
            TableCell(format_significant(test.chi2 / test.dof if test.dof > 0 else float("nan"))),
            TableCell(format_p_value(test.p_value)),
            TableCell(test.finding, mark="text"),
        )
        for test in tests
    )
    return Table(caption, (head,), rows)
