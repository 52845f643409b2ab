"""Tables of a diagnosis: effects with their evidence, their parameters, errors on the hold-out runs, modes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from balance_cli.diagnosis.result import Diagnosis, FoundEffect, HoldOut
from balance_cli.estimation.identified_model import ModeTable
from balance_cli.report.blocks import Cell, Row, Table, group_row
from balance_cli.report.check_errors import KINDS, TITLES, Error
from balance_cli.report.diagnosis_errors import STAGES, pooled, response_error, run_errors
from balance_cli.report.frequencies import CONSIDERABLE, matched_modes, signed_percent
from balance_cli.report.number_format import NONE, listed, percent, significant, with_sigma

LEAST_P = 1e-99
RESPONSES = "Response: % of what the channels read"
ERROR_HEAD = ("", "before", "after", "noise", "after / noise")
PLUS_MINUS = "\N{PLUS-MINUS SIGN}"


def probability(value: float) -> str:
    """A probability to two digits, and a bound where it is beyond all measure."""
    if not np.isfinite(value):
        return NONE
    return f"<{LEAST_P:.0e}" if value < LEAST_P else significant(value, 2)


def effect_table(effects: Sequence[FoundEffect]) -> Table:
    """Each effect with its evidence, and what it cannot be told from."""
    words = ("effect", "chi2 without it", "parameters", "p", "on folds", "cannot be told from", "what would separate")
    head = tuple(Cell(word, mark="text" if i > 4 else "") for i, word in enumerate(words))
    caption = (
        "Effects found, strongest first. Chi2 without it: by how much chi-square rises when the effect is left out and "
        "everything else refitted; p: of that, corrected for the number of candidates; on folds: the gain on lines "
        "that the fit had not seen."
    )
    return Table(caption, (head,), tuple(_effect_row(effect) for effect in effects))


def _effect_row(effect: FoundEffect) -> Row:
    evidence = effect.evidence
    return (
        Cell(effect.label, "empirical" if evidence.empirical else "", "name"),
        Cell(f"+{significant(evidence.gain)}"),
        Cell(str(evidence.parameters)),
        Cell(probability(evidence.p_value)),
        Cell(significant(evidence.folds)),
        Cell(listed(effect.indistinguishable_from), mark="text"),
        Cell(effect.separated_by if effect.indistinguishable_from else "", mark="text"),
    )


def parameter_table(effects: Sequence[FoundEffect]) -> Table:
    """Every parameter of every effect."""
    bounded = any(item.interval is not None for effect in effects for item in effect.parameters)
    words = ("parameter", "value", "sigma", "unit", *(["95 %"] if bounded else []))
    head = tuple(Cell(word) for word in words)
    rows: list[Row] = []
    for effect in effects:
        rows.append(group_row(effect.label, len(head)))
        for item in effect.parameters:
            value, sigma = with_sigma(item.value, item.sigma)
            row = [Cell(item.name, mark="name"), Cell(value), Cell(sigma), Cell(item.unit, mark="quiet")]
            between = "" if item.interval is None else "{:.4g} to {:.4g}".format(*item.interval)
            rows.append((*row, *([Cell(between)] if bounded else [])))
    caption = "Parameters of the effects, with one sigma."
    if bounded:
        caption += " 95 %: by the likelihood, where sigma says little."
    return Table(caption, (head,), tuple(rows))


# ---- errors ----------------------------------------------------------------------------------------------------------


def hold_out_table(made: Diagnosis) -> Table:
    """Errors of hub loads by component, rms over the runs; of responses run by run."""
    rows: list[Row] = []
    for kind in KINDS:
        rows += _kind_rows(kind, *(pooled(made, stage, kind) for stage in STAGES))
    rows.append(group_row(RESPONSES, len(ERROR_HEAD)))
    rows += [_error_row(name, *_responses(errors)) for name, errors in made.hold_out.items()]
    caption = (
        f"Percent; hub loads as rms over the hold-out runs ({', '.join(made.hold_out)}). Noise: what the noise of the "
        "records alone would leave. Shaded: within twice the noise."
    )
    return Table(caption, (tuple(Cell(word) for word in ERROR_HEAD),), tuple(rows))


def run_tables(made: Diagnosis) -> Iterator[Table]:
    """The same for every run by itself."""
    for name, errors in made.hold_out.items():
        rows: list[Row] = []
        for kind in KINDS:
            rows += _kind_rows(kind, *(run_errors(errors, stage, kind) for stage in STAGES))
        rows.append(_error_row("response", *_responses(errors)))
        yield Table(f"{name}: percent.", (tuple(Cell(word) for word in ERROR_HEAD),), tuple(rows))


def _responses(errors: HoldOut) -> tuple[Error, Error]:
    return response_error(errors, "before"), response_error(errors, "after")


def _kind_rows(kind: str, before: Mapping[str, Error], after: Mapping[str, Error]) -> Iterator[Row]:
    if not after:
        return
    yield group_row(TITLES[kind], len(ERROR_HEAD))
    yield from (_error_row(name, before[name], error) for name, error in after.items())


def _error_row(name: str, before: Error, after: Error) -> Row:
    ratio = after.value / after.noise if after.noise > 0 else float("nan")
    return (
        Cell(name, mark="name"),
        Cell(percent(before.value), mark="good" if before.is_noise else ""),
        Cell(percent(after.value), mark="best good" if after.is_noise else "best"),
        Cell(percent(after.noise), mark="quiet"),
        Cell(significant(ratio, 2)),
    )


# ---- modes -----------------------------------------------------------------------------------------------------------


def mode_table(made: Diagnosis) -> Table:
    """Frequencies and damping ratios of the modes, paired by their shapes; those that came in have no partner."""
    before = _widened(made.modes_before, made.chi2_per_dof_before)
    after = _widened(made.modes_after, made.chi2_per_dof_after)
    pairs = matched_modes([before, after]).index
    rows = [(Cell(str(r + 1), mark="name"), *_mode_cells(before, after, *pair)) for r, pair in enumerate(pairs)]
    words = ("mode", "before [Hz]", "after [Hz]", "change", "damping before [%]", "damping after [%]")
    caption = (
        "Eigenfrequencies and damping ratios before and after closing, with sigma widened by the misfit, paired by "
        "their shapes; a mode without a partner belongs to a part that the model lacked."
    )
    return Table(caption, (tuple(Cell(word) for word in words),), tuple(rows))


def _widened(modes: ModeTable, chi2_per_dof: float) -> ModeTable:
    """The modes with the sigmas that the misfit leaves (Birge ratio)."""
    scale = float(np.sqrt(chi2_per_dof)) if chi2_per_dof > 1.0 else 1.0
    frequency, damping = scale * modes.sigma_frequency, scale * modes.sigma_damping_ratio
    return replace(modes, sigma_frequency=frequency, sigma_damping_ratio=damping)


def _mode_cells(before: ModeTable, after: ModeTable, i: int | None, j: int | None) -> Row:
    change = None if i is None or j is None else float(after.frequency[j] / before.frequency[i]) - 1.0
    mark = "bad" if change is not None and abs(change) > CONSIDERABLE else ""
    words = Cell("" if change is None else signed_percent(change), mark=mark)
    return (_frequency(before, i), _frequency(after, j), words, _damping(before, i), _damping(after, j))


def _frequency(modes: ModeTable, i: int | None) -> Cell:
    if i is None:
        return Cell("")
    return Cell(f" {PLUS_MINUS} ".join(with_sigma(float(modes.frequency[i]), float(modes.sigma_frequency[i]))))


def _damping(modes: ModeTable, i: int | None) -> Cell:
    if i is None:
        return Cell("")
    ratio, sigma = 100 * float(modes.damping_ratio[i]), 100 * float(modes.sigma_damping_ratio[i])
    return Cell(f" {PLUS_MINUS} ".join(with_sigma(ratio, sigma)), mark="bad" if ratio < 0 else "")
