"""The loop closed: verdict, effects that were missing, and what they were worth on runs that no fit has seen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from balance_cli.diagnosis.result import EXPLAINED, MEANING, NOTHING_MISSING, Diagnosis, ModelFreeTest, Trial
from balance_cli.report.blocks import (
    Block,
    Cell,
    Details,
    Figures,
    Heading,
    Picture,
    Points,
    Row,
    Section,
    Table,
    Text,
    Warn,
)
from balance_cli.report.diagnosis_figures import hold_out_figure, residual_figure
from balance_cli.report.diagnosis_tables import (
    effect_table,
    hold_out_table,
    mode_table,
    parameter_table,
    probability,
    run_tables,
)
from balance_cli.report.figure_style import svg
from balance_cli.report.number_format import percent, sentence, significant
from balance_cli.report.parameters import DESCRIBES
from balance_cli.report.sources import Source, Sources

SIGNIFICANT = 0.01


def verdict_words(source: Source[Diagnosis]) -> str:
    """The verdict in a sentence, with the effects."""
    made = source.content
    found = f" Found: {', '.join(effect.label for effect in made.effects)}." if made.effects else ""
    return f"{sentence(source.label)}: {made.verdict}; {MEANING[made.verdict]}.{found}"


def section(sources: Sources) -> Section | None:
    """Every diagnosis given; None where there is none."""
    if not sources.diagnoses:
        return None
    blocks: list[Block] = []
    for i, source in enumerate(sources.diagnoses):
        if len(sources.diagnoses) > 1:
            blocks.append(Heading(sentence(source.label)))
        blocks += _blocks(source.content, f"-{i + 1}" if i else "")
    return Section("diagnosis", "Diagnosis: what the model lacks", tuple(blocks))


def _blocks(made: Diagnosis, ending: str) -> Iterator[Block]:
    yield from _verdict(made)
    if made.effects:
        if not made.chi2_per_dof_after <= DESCRIBES:
            yield Warn(
                "The closed model does not describe these data within their noise: every sigma of a parameter below "
                "says less than it seems to."
            )
        yield from (effect_table(made.effects), parameter_table(made.effects))
    yield from _hold_out(made, ending)
    yield from _residual(made, ending)
    yield Heading("Eigenfrequencies before and after")
    yield mode_table(made)
    yield from _chain(made.trials)
    yield from _tests(made)


def _verdict(made: Diagnosis) -> Iterator[Block]:
    words = f"{sentence(made.verdict)}: {MEANING[made.verdict]}."
    yield Text(words) if made.verdict in (NOTHING_MISSING, EXPLAINED) else Warn(words)
    yield Figures(tuple(_figures(made)))
    if made.location:
        yield Warn(f"What is left: {made.location}.")
    if any(effect.evidence.empirical for effect in made.effects):
        yield Warn("An empirical effect describes what is left; it does not explain it.")
    if made.notes:
        yield Points(tuple(sentence(note) for note in made.notes))


def _figures(made: Diagnosis) -> Iterator[tuple[str, str, str]]:
    count = len(made.effects)
    yield str(count), f"effect{'' if count == 1 else 's'} found among {made.candidates} candidates", ""
    stages = ((made.chi2_per_dof_before, "before"), (made.chi2_per_dof_after, "after"))
    for ratio, stage in stages:
        yield significant(ratio), f"chi2/dof {stage} closing", "good" if ratio <= DESCRIBES else "bad"
    yield f"{percent(made.frf_error_before)} %", "error of the responses before closing", ""
    yield f"{percent(made.frf_error_after)} %", "error of the responses after closing", ""


def _hold_out(made: Diagnosis, ending: str) -> Iterator[Block]:
    yield Heading("Error before and after, on runs that no fit has seen")
    if not made.hold_out:
        yield Warn("No run was held out: nothing here tells what closing is worth.")
        return
    yield hold_out_table(made)
    if any(errors.after.load_error or errors.after.interaction for errors in made.hold_out.values()):
        words = "Errors by component before and after closing, rms over the runs; black: what noise alone would leave."
        name = f"hold-out{ending}"
        yield Picture(name, words, svg(name, words, lambda: hold_out_figure(made)))
    yield Details("Every hold-out run by itself", tuple(run_tables(made)))


def _residual(made: Diagnosis, ending: str) -> Iterator[Block]:
    yield Heading("Residual before and after")
    words = (
        "Whitened residual, rms within bands of frequency: by run over all channels, and by channel over all runs. One "
        "is what noise leaves; grey: no line there. All bands are drawn equally wide."
    )
    name = f"residual{ending}"
    yield Picture(name, words, svg(name, words, lambda: residual_figure(made.residual)))


def _chain(trials: Sequence[Trial]) -> Iterator[Block]:
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
    head = tuple(Cell(word, mark="text" if word in ("candidate", "decision", "why") else "") for word in words)
    return Table(caption, (head,), tuple(_trial_row(trial) for trial in trials))


def _trial_row(trial: Trial) -> Row:
    mark = {"accepted": "good", "kept": "good", "removed": "bad"}.get(trial.decision, "")
    return (
        Cell(str(trial.round), mark="name"),
        Cell(trial.label, mark="text"),
        Cell(str(trial.parameters)),
        Cell(significant(trial.score)),
        Cell(probability(trial.p_value)),
        Cell(significant(trial.gain)),
        Cell(trial.decision, mark=f"text {mark}".strip()),
        Cell(trial.why, mark="text"),
    )


def _tests(made: Diagnosis) -> Iterator[Block]:
    """What differs by more than chance; the rest on demand."""
    if made.tests:
        yield Heading("Tests that need no model of the plate")
        differing = [test for test in made.tests if test.p_value < SIGNIFICANT]
        alike = [test for test in made.tests if not test.p_value < SIGNIFICANT]
        if differing:
            yield _test_table("What differs by more than chance.", differing)
        else:
            yield Text("Nothing differs by more than chance.")
        if alike:
            yield Details(f"{len(alike)} that show nothing", (_test_table("What chance would do as well.", alike),))
    if made.not_testable:
        yield Heading("What these runs say nothing of")
        yield Points(tuple(f"{item.name}: {item.why}" for item in made.not_testable))


def _test_table(caption: str, tests: Sequence[ModelFreeTest]) -> Table:
    head = (Cell("test"), Cell("place", mark="text"), Cell("chi2/dof"), Cell("p"), Cell("finding", mark="text"))
    rows = tuple(
        (
            Cell(test.name, mark="name"),
            Cell(test.place, mark="text"),
            Cell(significant(test.chi2 / test.dof if test.dof > 0 else float("nan"))),
            Cell(probability(test.p_value)),
            Cell(test.finding, mark="text"),
        )
        for test in tests
    )
    return Table(caption, (head,), rows)
