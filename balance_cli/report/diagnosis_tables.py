"""Tables of a diagnosis: effects with evidence and parameters, errors on the hold-out runs, modes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from balance_cli.diagnosis.result import Diagnosis, FoundEffect, HoldOut
from balance_cli.estimation.identified_model import ModeTable
from balance_cli.report.blocks import Row, Table, TableCell, group_heading_row, plain_row
from balance_cli.report.check_errors import ERROR_KINDS, ERROR_TITLES, RelativeError
from balance_cli.report.diagnosis_errors import STAGES, hold_out_errors_of_run, pooled_hold_out_errors, response_error
from balance_cli.report.frequencies import LARGE_FREQUENCY_DEVIATION, match_modes, signed_percent
from balance_cli.report.number_format import (
    MISSING_VALUE,
    format_percent,
    format_significant,
    join_names,
    value_and_sigma_text,
)

SMALLEST_P_VALUE = 1e-99
"""Smaller p-values are shown as a bound: three digits of exponent would widen the column and mean nothing more."""
RESPONSE_TITLE = "Response: % of what the channels read"
ERROR_HEADER = ("", "before", "after", "noise", "after / noise")
PLUS_MINUS = "\N{PLUS-MINUS SIGN}"


def format_p_value(value: float) -> str:
    """A p-value to two digits, or an upper bound where it is extremely small."""
    if not np.isfinite(value):
        return MISSING_VALUE
    return f"<{SMALLEST_P_VALUE:.0e}" if value < SMALLEST_P_VALUE else format_significant(value, 2)


def effect_table(effects: Sequence[FoundEffect]) -> Table:
    """Each effect with its evidence, and the effects that it cannot be distinguished from."""
    columns = (
        *("effect", "worth", "chi2 without it", "parameters", "p", "cross-validation"),
        *("indistinguishable from", "separated by"),
    )
    head = tuple(TableCell(name, mark="text" if i > 5 else "") for i, name in enumerate(columns))
    caption = (
        "Effects found. Worth: the largest error of a harmonic load at the rotor speed without the effect, over its "
        "sigma; below 0.1 the effect is of no consequence. Chi2 without it: increase of chi-square when the effect is "
        "removed and all else is refitted; p: of that, corrected for the number of candidates; cross-validation: gain "
        "on lines that the fit had not used."
    )
    return Table(caption, (head,), tuple(_effect_row(effect) for effect in effects))


def _effect_row(effect: FoundEffect) -> Row:
    evidence = effect.evidence
    return (
        TableCell(effect.label, "empirical" if evidence.empirical else "", "name"),
        TableCell(_worth_text(effect)),
        TableCell(f"+{format_significant(evidence.gain)}"),
        TableCell(str(evidence.parameters)),
        TableCell(format_p_value(evidence.p_value)),
        TableCell(format_significant(evidence.cross_validation_gain)),
        TableCell(join_names(effect.indistinguishable_from), mark="text"),
        TableCell(effect.separated_by if effect.indistinguishable_from else "", mark="text"),
    )


def _worth_text(effect: FoundEffect) -> str:
    """The largest worth and its component; a dash where it cannot be told."""
    if not effect.worth:
        return "\N{EN DASH}"
    name = max(effect.worth, key=lambda component: (effect.worth or {})[component])
    return f"{format_significant(effect.worth[name])} ({name})"


def parameter_table(effects: Sequence[FoundEffect]) -> Table:
    """Every parameter of every effect."""
    bounded = any(item.interval is not None for effect in effects for item in effect.parameters)
    words = ("parameter", "value", "sigma", "unit", *(["95 %"] if bounded else []))
    head = plain_row(*words)
    rows: list[Row] = []
    for effect in effects:
        rows.append(group_heading_row(effect.label, len(head)))
        for item in effect.parameters:
            value, sigma = value_and_sigma_text(item.value, item.sigma)
            row = [
                TableCell(item.name, mark="name"),
                TableCell(value),
                TableCell(sigma),
                TableCell(item.unit, mark="quiet"),
            ]
            interval = "" if item.interval is None else "{:.4g} to {:.4g}".format(*item.interval)
            rows.append((*row, *([TableCell(interval)] if bounded else [])))
    caption = "Parameters of the effects, with one sigma."
    if bounded:
        caption += " 95 %: interval by the likelihood, for parameters that are far from normally distributed."
    return Table(caption, (head,), tuple(rows))


# ---- errors ----------------------------------------------------------------------------------------------------------


def hold_out_table(diagnosis: Diagnosis) -> Table:
    """Errors of hub loads by component, rms over the runs; of responses run by run."""
    rows: list[Row] = []
    for kind in ERROR_KINDS:
        rows += _kind_rows(kind, *(pooled_hold_out_errors(diagnosis, stage, kind) for stage in STAGES))
    rows.append(group_heading_row(RESPONSE_TITLE, len(ERROR_HEADER)))
    rows += [_error_row(name, *_response_errors(errors)) for name, errors in diagnosis.hold_out.items()]
    caption = (
        f"Percent; hub loads as rms over the hold-out runs ({', '.join(diagnosis.hold_out)}). Noise: the error that "
        "the noise of the records alone causes. Shaded: within twice the noise."
    )
    return Table(caption, (plain_row(*ERROR_HEADER),), tuple(rows))


def run_tables(diagnosis: Diagnosis) -> Iterator[Table]:
    """The same errors, one table per run."""
    for name, errors in diagnosis.hold_out.items():
        rows: list[Row] = []
        for kind in ERROR_KINDS:
            rows += _kind_rows(kind, *(hold_out_errors_of_run(errors, stage, kind) for stage in STAGES))
        rows.append(_error_row("response", *_response_errors(errors)))
        yield Table(f"{name}: percent.", (plain_row(*ERROR_HEADER),), tuple(rows))


def _response_errors(errors: HoldOut) -> tuple[RelativeError, RelativeError]:
    return response_error(errors, "before"), response_error(errors, "after")


def _kind_rows(kind: str, before: Mapping[str, RelativeError], after: Mapping[str, RelativeError]) -> Iterator[Row]:
    if not after:
        return
    yield group_heading_row(ERROR_TITLES[kind], len(ERROR_HEADER))
    yield from (_error_row(name, before[name], error) for name, error in after.items())


def _error_row(name: str, before: RelativeError, after: RelativeError) -> Row:
    ratio = after.value / after.noise if after.noise > 0 else float("nan")
    return (
        TableCell(name, mark="name"),
        TableCell(format_percent(before.value), mark="good" if before.is_noise else ""),
        TableCell(format_percent(after.value), mark="best good" if after.is_noise else "best"),
        TableCell(format_percent(after.noise), mark="quiet"),
        TableCell(format_significant(ratio, 2)),
    )


# ---- modes -----------------------------------------------------------------------------------------------------------


def mode_table(diagnosis: Diagnosis) -> Table:
    """Frequencies and damping ratios of the modes, paired by their shapes; added modes have no partner."""
    before = _widen_sigmas(diagnosis.modes_before, diagnosis.chi2_per_dof_before)
    after = _widen_sigmas(diagnosis.modes_after, diagnosis.chi2_per_dof_after)
    pairs = match_modes([before, after]).index
    rows = [(TableCell(str(r + 1), mark="name"), *_mode_cells(before, after, *pair)) for r, pair in enumerate(pairs)]
    words = ("mode", "before [Hz]", "after [Hz]", "change", "damping before [%]", "damping after [%]")
    caption = (
        "Eigenfrequencies and damping ratios before and after updating, with sigma widened by the misfit, paired "
        "by their shapes; a mode without a partner belongs to a part that the model lacked."
    )
    return Table(caption, (plain_row(*words),), tuple(rows))


def _widen_sigmas(modes: ModeTable, chi2_per_dof: float) -> ModeTable:
    """The modes with sigmas widened by the misfit (Birge ratio)."""
    scale = float(np.sqrt(chi2_per_dof)) if chi2_per_dof > 1.0 else 1.0
    frequency, damping = scale * modes.sigma_frequency, scale * modes.sigma_damping_ratio
    return replace(modes, sigma_frequency=frequency, sigma_damping_ratio=damping)


def _mode_cells(before: ModeTable, after: ModeTable, i: int | None, j: int | None) -> Row:
    change = None if i is None or j is None else float(after.frequency[j] / before.frequency[i]) - 1.0
    mark = "bad" if change is not None and abs(change) > LARGE_FREQUENCY_DEVIATION else ""
    words = TableCell("" if change is None else signed_percent(change), mark=mark)
    return (
        _mode_frequency_cell(before, i),
        _mode_frequency_cell(after, j),
        words,
        _mode_damping_cell(before, i),
        _mode_damping_cell(after, j),
    )


def _mode_frequency_cell(modes: ModeTable, i: int | None) -> TableCell:
    if i is None:
        return TableCell("")
    return TableCell(
        f" {PLUS_MINUS} ".join(value_and_sigma_text(float(modes.frequency[i]), float(modes.sigma_frequency[i])))
    )


def _mode_damping_cell(modes: ModeTable, i: int | None) -> TableCell:
    if i is None:
        return TableCell("")
    ratio, sigma = 100 * float(modes.damping_ratio[i]), 100 * float(modes.sigma_damping_ratio[i])
    return TableCell(f" {PLUS_MINUS} ".join(value_and_sigma_text(ratio, sigma)), mark="bad" if ratio < 0 else "")
