"""Computed and identified eigenfrequencies side by side (figure 13 of the paper)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from balance_cli.estimation.identified_model import IdentifiedModel, ModeTable
from balance_cli.model.mechanics.equations import SHAFT
from balance_cli.report.blocks import Details, PageBlock, Paragraph, Picture, Row, Section, Table, TableCell, plain_row
from balance_cli.report.figure_style import new_figure, svg
from balance_cli.report.number_format import MINUS, capitalize_first, format_fixed, value_and_sigma_text
from balance_cli.report.source_roles import PREFERRED_MODELS, SourceRole
from balance_cli.report.sources import Source, Sources

LARGE_FREQUENCY_DEVIATION = 0.05
"""Relative difference between a computed and an identified eigenfrequency beyond which it is marked."""
MIN_MODAL_ASSURANCE = 0.5
"""Least modal assurance of two shapes that count as one mode (1: equal, 0: orthogonal)."""


@dataclass(frozen=True)
class ModeMatch:
    """Modes of several models, row by row: `index[r][m]` is the mode of model m in row r, None where it has none."""

    index: tuple[tuple[int | None, ...], ...]


def shaft_mode(modes: ModeTable) -> int | None:
    """The mode in which the only shaft alone moves; None where there is no torque meter, several, or no such mode."""
    shafts = [i for i, name in enumerate(modes.coordinates) if name.split()[0] == SHAFT]
    if len(shafts) != 1 or not has_shapes(modes):
        return None
    share = np.abs(modes.shape) ** 2
    of_shaft = share[:, shafts[0]] / share.sum(axis=1)
    return int(np.argmax(of_shaft)) if of_shaft.max() > MIN_MODAL_ASSURANCE else None


def match_models(models: Sequence[IdentifiedModel]) -> ModeMatch:
    """Pair the modes of all models with those of the first model that has shapes."""
    return match_modes([model.modes for model in models])


def match_modes(tables: Sequence[ModeTable]) -> ModeMatch:
    """Pair modes by their shapes where the coordinates agree, else by their frequencies; the shaft mode apart."""
    first = next((modes for modes in tables if has_shapes(modes)), tables[0])
    columns = [_partner_indices(first, modes) for modes in tables]
    rows = [tuple(column[i] for column in columns) for i in range(len(first.frequency))]
    for m, (column, modes) in enumerate(zip(columns, tables, strict=True)):
        for extra in sorted(set(range(len(modes.frequency))) - set(column)):
            rows.append(tuple(extra if k == m else None for k in range(len(tables))))
    return ModeMatch(tuple(rows))


def _partner_indices(first: ModeTable, second: ModeTable) -> list[int | None]:
    """The partner in `second` of each mode of `first`."""
    shafts = (shaft_mode(first), shaft_mode(second))
    first_indices = [i for i in range(len(first.frequency)) if i != shafts[0]]
    second_indices = [i for i in range(len(second.frequency)) if i != shafts[1]]
    partners: list[int | None] = [None] * len(first.frequency)
    if shafts[0] is not None:
        partners[shafts[0]] = shafts[1]
    for i, j in _assign_modes(first, second, first_indices, second_indices):
        partners[i] = j
    return partners


def _assign_modes(
    first: ModeTable, second: ModeTable, first_indices: list[int], second_indices: list[int]
) -> list[tuple[int, int]]:
    """Pair modes for the largest total modal assurance; close frequencies decide between equal pairings.

    Without shapes in common coordinates the frequencies decide alone: in ascending order where the numbers agree.
    """
    from scipy.optimize import linear_sum_assignment

    log_ratio = np.abs(np.log(first.frequency[first_indices][:, None] / second.frequency[second_indices]))
    if has_shapes(first) and has_shapes(second) and set(first.coordinates) <= set(second.coordinates):
        common = [second.coordinates.index(name) for name in first.coordinates]
        assurance = modal_assurance(first.shape[first_indices], second.shape[np.ix_(second_indices, common)])
        rows, columns = linear_sum_assignment(assurance - 0.5 * np.tanh(log_ratio), maximize=True)
    elif len(first_indices) == len(second_indices):
        return list(zip(first_indices, second_indices, strict=True))
    else:
        rows, columns = linear_sum_assignment(log_ratio)
    return [(first_indices[i], second_indices[j]) for i, j in zip(rows, columns, strict=True)]


def has_shapes(modes: ModeTable) -> bool:
    """Whether the shapes of the modes are known."""
    return len(modes.shape) == len(modes.frequency) > 0


def modal_assurance(a: NDArray[np.complex128], b: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Modal assurance criterion (m, k) of shapes (m, n) and (k, n): |a* b|^2 / (a* a)(b* b) (Allemang, Brown 1982)."""
    sizes = np.outer(np.sum(np.abs(a) ** 2, axis=1), np.sum(np.abs(b) ** 2, axis=1))
    return np.asarray(np.abs(a.conj() @ b.T) ** 2 / np.where(sizes > 0, sizes, 1.0))


def sigma_scale(model: IdentifiedModel) -> float:
    """Factor by which the misfit widens the sigmas; 1 for the paper's form, whose sigmas come from the residuals."""
    return 1.0 if model.paper is not None else model.misfit_scale


def reference_model(models: Sequence[Source[IdentifiedModel]]) -> Source[IdentifiedModel] | None:
    """The identified model that others are compared with: the first of PREFERRED_MODELS that is given."""
    for role in PREFERRED_MODELS:
        for source in models:
            if source.role is role:
                return source
    return None


@dataclass(frozen=True)
class FrequencyDeviation:
    """Deviation of the computed eigenfrequencies.

    `count` of all pairs; `large_deviations`: computed and identified frequency [Hz] of those beyond the limit;
    `largest`: the largest relative deviation.
    """

    count: int
    large_deviations: tuple[tuple[float, float], ...]
    largest: float


def frequency_deviation(computed: IdentifiedModel, identified: IdentifiedModel) -> FrequencyDeviation:
    """Compare computed and identified eigenfrequencies over the modes that both models have."""
    pairs = [
        (float(computed.modes.frequency[i]), float(identified.modes.frequency[j]))
        for i, j in match_models([computed, identified]).index
        if i is not None and j is not None
    ]
    deviations = [(c / f - 1.0, (c, f)) for c, f in pairs]
    large_deviations = tuple(pair for relative, pair in deviations if abs(relative) > LARGE_FREQUENCY_DEVIATION)
    return FrequencyDeviation(
        len(pairs), large_deviations, max((abs(relative) for relative, _ in deviations), default=0.0)
    )


def section(sources: Sources) -> Section | None:
    """Picture and tables of the modes of all models; None without a model."""
    models = sources.models
    if not models:
        return None
    match = match_models([source.content for source in models])
    blocks: list[PageBlock] = [
        Picture(
            "eigenfrequencies",
            "Eigenfrequencies of all models with two sigma: of the computed model from the tolerances of the "
            "geometry, of the identified ones from the noise, widened by the misfit.",
            svg("eigenfrequencies", "Eigenfrequencies of each model", lambda: frequency_figure(models, match)),
        ),
        frequency_table(models, match),
        damping_table(models, match),
    ]
    statement = _deviation_sentence(models)
    if statement:
        blocks.insert(0, Paragraph(statement))
    shapes = [shape_table(source) for source in models if has_shapes(source.content.modes)]
    if shapes:
        blocks.append(Details("Shapes of the modes", tuple(shapes)))
    known = reference_model(models) is not None
    return Section("eigenfrequencies", f"Eigenfrequencies, computed{' and identified' if known else ''}", tuple(blocks))


def _deviation_sentence(models: Sequence[Source[IdentifiedModel]]) -> str:
    computed = next((source for source in models if source.role is SourceRole.COMPUTED), None)
    best = reference_model(models)
    if computed is None or best is None:
        return ""
    deviation = frequency_deviation(computed.content, best.content)
    if not deviation.large_deviations:
        return (
            f"All {deviation.count} computed eigenfrequencies lie within {100 * LARGE_FREQUENCY_DEVIATION:.0f} % of "
            f"{best.label}."
        )
    pairs = "; ".join(f"{c:.1f} against {f:.1f} Hz" for c, f in deviation.large_deviations)
    verb = "differs" if len(deviation.large_deviations) == 1 else "differ"
    return (
        f"{len(deviation.large_deviations)} of {deviation.count} computed eigenfrequencies {verb} by more than "
        f"{100 * LARGE_FREQUENCY_DEVIATION:.0f} % from those of {best.label}: {pairs}."
    )


def frequency_figure(models: Sequence[Source[IdentifiedModel]], match: ModeMatch) -> Figure:
    """One row per model, frequency to the right; thin lines join paired modes."""
    figure = new_figure(12.0, 0.75 + 0.36 * len(models))
    axes = figure.add_subplot()
    for row, source in enumerate(models):
        modes = source.content.modes
        axes.errorbar(
            modes.frequency,
            np.full(len(modes.frequency), row),
            xerr=2 * sigma_scale(source.content) * modes.sigma_frequency,
            linestyle="",
            marker=source.plot_style.marker,
            markersize=6,
            color=source.plot_style.color,
            elinewidth=1.4,
            capsize=3,
            zorder=3,
        )
    for partners in match.index:
        known = [(float(models[m].content.modes.frequency[i]), m) for m, i in enumerate(partners) if i is not None]
        axes.plot([x for x, _ in known], [y for _, y in known], color="#b0b0b0", linewidth=0.8, zorder=1)
    axes.set_yticks(range(len(models)), [source.label for source in models])
    axes.set_ylim(len(models) - 0.5, -0.5)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("eigenfrequency [Hz]")
    axes.tick_params(axis="y", length=0, labelsize=8)
    axes.grid(visible=False, axis="y")
    height = 0.75 + 0.36 * len(models)
    figure.subplots_adjust(left=0.16, right=0.99, top=1 - 0.08 / height, bottom=0.5 / height)
    return figure


def frequency_table(models: Sequence[Source[IdentifiedModel]], match: ModeMatch) -> Table:
    """Frequencies with sigma, and the difference from the reference model."""
    best = reference_model(models)
    column = None if best is None else models.index(best)
    rows = []
    for r, partners in enumerate(match.index):
        base = None if column is None else partners[column]
        value = None if base is None or best is None else float(best.content.modes.frequency[base])
        cells = [_frequency_cell(models[m].content, i, value) for m, i in enumerate(partners)]
        rows.append((TableCell(str(r + 1), mark="name"), *cells))
    less = f"; small: difference from {best.label}" if best is not None and len(models) > 1 else ""
    head = (TableCell("mode"), *(TableCell(source.label, title=source.file) for source in models))
    return Table(f"Eigenfrequencies [Hz] with sigma, widened by the misfit{less}.", (head,), tuple(rows))


def _frequency_cell(model: IdentifiedModel, i: int | None, base: float | None) -> TableCell:
    if i is None:
        return TableCell("")
    modes = model.modes
    value, sigma = value_and_sigma_text(float(modes.frequency[i]), sigma_scale(model) * float(modes.sigma_frequency[i]))
    text = f"{value} \N{PLUS-MINUS SIGN} {sigma}"
    relative = float(modes.frequency[i]) / base - 1.0 if base else 0.0
    if relative == 0.0:
        return TableCell(text)
    return TableCell(text, signed_percent(relative), "bad" if abs(relative) > LARGE_FREQUENCY_DEVIATION else "")


def signed_percent(relative: float) -> str:
    """A relative difference in percent, with its sign."""
    text = format_fixed(100 * relative, 2 if abs(relative) < 0.1 else 1)
    return f"{text} %" if text.startswith(MINUS) else f"+{text} %"


def damping_table(models: Sequence[Source[IdentifiedModel]], match: ModeMatch) -> Table:
    """Damping ratios with sigma."""
    rows: list[Row] = []
    for r, partners in enumerate(match.index):
        cells = [TableCell("") if i is None else _damping_cell(models[m].content, i) for m, i in enumerate(partners)]
        rows.append((TableCell(str(r + 1), mark="name"), *cells))
    head = (TableCell("mode"), *(TableCell(source.label, title=source.file) for source in models))
    return Table("Damping ratios [%] with sigma, widened by the misfit.", (head,), tuple(rows))


def _damping_cell(model: IdentifiedModel, i: int) -> TableCell:
    ratio = 100 * float(model.modes.damping_ratio[i])
    value, sigma = value_and_sigma_text(ratio, 100 * sigma_scale(model) * float(model.modes.sigma_damping_ratio[i]))
    return TableCell(f"{value} \N{PLUS-MINUS SIGN} {sigma}", mark="bad" if ratio < 0 else "")


def shape_table(source: Source[IdentifiedModel]) -> Table:
    """Real parts of the mode shapes, largest motion 1."""
    modes = source.content.modes
    head = plain_row("Hz", *modes.coordinates)
    rows = [
        (TableCell(f"{frequency:.2f}", mark="name"), *(_shape_cell(complex(value)) for value in shape))
        for frequency, shape in zip(modes.frequency, modes.shape, strict=True)
    ]
    motion = "motion of the centre of gravity [m] and angles [rad], largest 1; small: imaginary part"
    caption = f"{capitalize_first(source.label)}: {motion}."
    return Table(caption, (head,), tuple(rows))


def _shape_cell(value: complex) -> TableCell:
    imaginary = format_fixed(value.imag, 2) if abs(value.imag) >= 0.005 else ""
    return TableCell(format_fixed(value.real, 3), imaginary, "" if abs(value) >= 0.1 else "quiet")
