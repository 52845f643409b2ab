"""Model updating: verdict, effects that the model lacked, and the errors before and after on hold-out runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from balance_cli.diagnosis.result import EXPLAINED, NOTHING_MISSING, Diagnosis, ModelFreeTest, Trial
from balance_cli.estimation.choices import GOOD_FIT_CHI2_PER_DOF
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
from balance_cli.report.diagnosis_residual import residual_blocks
from balance_cli.report.diagnosis_story import (
    TEST_SIGNIFICANCE,
    accepted_sentences,
    open_question_blocks,
    ruled_out_items,
    worth_paragraphs,
    worth_table,
)
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
from balance_cli.report.sources import Source, Sources


def verdict_sentence(source: Source[Diagnosis]) -> str:
    """The verdict in words, with the effects found; those that change no load by their names alone."""
    diagnosis = source.content
    found = ", ".join(effect.label for effect in diagnosis.effects if not effect.is_of_no_consequence)
    light = ", ".join(dict.fromkeys(effect.name for effect in diagnosis.effects if effect.is_of_no_consequence))
    sentence = f"{capitalize_first(source.label)}: {diagnosis.verdict}; {diagnosis.meaning}."
    sentence += f" Found: {found}." if found else ""
    return sentence + (f" Found, of no consequence to any load: {light}." if light else "")


def section(sources: Sources) -> Section | None:
    """All diagnoses; None where there is none."""
    if not sources.diagnoses:
        return None
    blocks: list[PageBlock] = []
    for i, source in enumerate(sources.diagnoses):
        if len(sources.diagnoses) > 1:
            blocks.append(Heading(capitalize_first(source.label)))
        blocks += _diagnosis_blocks(source.content, f"-{i + 1}" if i else "")
    return Section("diagnosis", "Diagnosis: what the model lacks", tuple(blocks))


def _diagnosis_blocks(diagnosis: Diagnosis, suffix: str) -> Iterator[PageBlock]:
    yield from _verdict_blocks(diagnosis)
    yield Heading("What the residual looked like")
    yield from residual_blocks(diagnosis, suffix)
    yield _residual_picture(diagnosis, suffix)
    yield from _effect_blocks(diagnosis)
    yield Heading("What was ruled out, and why")
    yield from _ruled_out_blocks(diagnosis)
    yield Heading("What the effects are worth in hub loads")
    yield from _worth_blocks(diagnosis, suffix)
    yield Heading("What would settle what remains")
    yield from open_question_blocks(diagnosis)
    yield Heading("Eigenfrequencies before and after")
    yield mode_table(diagnosis)


def _effect_blocks(diagnosis: Diagnosis) -> Iterator[PageBlock]:
    """How the effects were found, with their evidence and parameters."""
    yield Heading("What explained it")
    if not diagnosis.effects:
        yield Paragraph(f"Nothing: of {diagnosis.candidate_count} candidates none was accepted.")
        return
    yield BulletList(tuple(accepted_sentences(diagnosis)))
    if not diagnosis.chi2_per_dof_after <= GOOD_FIT_CHI2_PER_DOF:
        yield WarningText(
            "The updated model does not describe these data to within their noise: the uncertainties of the "
            "parameters below are underestimated."
        )
    yield from (effect_table(diagnosis.effects), parameter_table(diagnosis.effects))


def _ruled_out_blocks(diagnosis: Diagnosis) -> Iterator[PageBlock]:
    items = tuple(capitalize_first(item) for item in ruled_out_items(diagnosis))
    yield BulletList(items) if items else Paragraph("These runs rule out nothing by themselves.")
    yield from _trial_blocks(diagnosis.trials)
    yield from _model_free_test_blocks(diagnosis)


def _worth_blocks(diagnosis: Diagnosis, suffix: str) -> Iterator[PageBlock]:
    table = worth_table(diagnosis.effects)
    if table is not None:
        yield table
    yield from worth_paragraphs(diagnosis)
    yield from _hold_out_blocks(diagnosis, suffix)


def _verdict_blocks(diagnosis: Diagnosis) -> Iterator[PageBlock]:
    words = f"{capitalize_first(diagnosis.verdict)}: {diagnosis.meaning}."
    yield Paragraph(words) if diagnosis.verdict in (NOTHING_MISSING, EXPLAINED) else WarningText(words)
    yield KeyFigures(tuple(_key_figures(diagnosis)))
    if diagnosis.location:
        yield WarningText(f"Residual of the updated model: {diagnosis.location.rstrip('.')}.")
    if any(effect.evidence.empirical for effect in diagnosis.effects):
        yield WarningText("An empirical effect describes the residual; it does not explain it.")
    if diagnosis.notes:
        yield BulletList(tuple(capitalize_first(note) for note in diagnosis.notes))


def _key_figures(diagnosis: Diagnosis) -> Iterator[tuple[str, str, str]]:
    count = len(diagnosis.effects)
    yield str(count), f"effect{'' if count == 1 else 's'} found among {diagnosis.candidate_count} candidates", ""
    stages = ((diagnosis.chi2_per_dof_before, "before"), (diagnosis.chi2_per_dof_after, "after"))
    for ratio, stage in stages:
        yield (
            format_significant(ratio),
            f"chi2/dof {stage} updating",
            "good" if ratio <= GOOD_FIT_CHI2_PER_DOF else "bad",
        )
    yield f"{format_percent(diagnosis.frf_error_before)} %", "error of the responses before updating", ""
    yield f"{format_percent(diagnosis.frf_error_after)} %", "error of the responses after updating", ""


def _hold_out_blocks(diagnosis: Diagnosis, suffix: str) -> Iterator[PageBlock]:
    if not diagnosis.hold_out:
        yield WarningText("No run was held out: the gain in accuracy is not verified.")
        return
    yield hold_out_table(diagnosis)
    if any(errors.after.load_error or errors.after.interaction for errors in diagnosis.hold_out.values()):
        caption = "Errors by component before and after updating, rms over the runs; black: noise floor."
        name = f"hold-out{suffix}"
        yield Picture(name, caption, svg(name, caption, lambda: hold_out_figure(diagnosis)))
    yield Details("Each hold-out run", tuple(run_tables(diagnosis)))


def _residual_picture(diagnosis: Diagnosis, suffix: str) -> Picture:
    caption = (
        "Whitened residual, rms within frequency bands: by run over all channels, and by channel over all runs. The "
        "noise alone gives 1; gray: no line in the band. All bands are drawn equally wide."
    )
    name = f"residual{suffix}"
    return Picture(name, caption, svg(name, caption, lambda: residual_figure(diagnosis.residual)))


def _trial_blocks(trials: Sequence[Trial]) -> Iterator[PageBlock]:
    """Decisions in their order; candidates without a refit in a folded table."""
    if not trials:
        return
    yield Heading("Sequence of trials")
    refitted = [trial for trial in trials if trial.decision != "not refitted"]
    others = [trial for trial in trials if trial.decision == "not refitted"]
    caption = (
        "Predicted gain: reduction of chi-square by the score test, before a refit; p: of that, corrected for the "
        "number of candidates; gain: by the refit, minus a penalty for parameters and candidates."
    )
    if refitted:
        yield _trial_table(caption, refitted)
    if others:
        yield Details(f"{len(others)} candidates without a refit", (_trial_table(caption, others),))


def _trial_table(caption: str, trials: Sequence[Trial]) -> Table:
    words = ("round", "candidate", "parameters", "predicted gain", "p", "gain", "decision", "reason")
    head = tuple(TableCell(word, mark="text" if word in ("candidate", "decision", "reason") else "") for word in words)
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
        TableCell(trial.reason, mark="text"),
    )


def _model_free_test_blocks(diagnosis: Diagnosis) -> Iterator[PageBlock]:
    """Significant tests of the data, the others in a folded table."""
    if diagnosis.data_tests:
        yield Heading("Tests of the data without a model")
        differing = [test for test in diagnosis.data_tests if test.p_value < TEST_SIGNIFICANCE]
        insignificant = [test for test in diagnosis.data_tests if not test.p_value < TEST_SIGNIFICANCE]
        if differing:
            yield _test_table("Significant differences.", differing)
        else:
            yield Paragraph("No difference is significant.")
        if insignificant:
            yield Details(
                f"{len(insignificant)} tests without a significant difference",
                (_test_table("Not significant.", insignificant),),
            )


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
