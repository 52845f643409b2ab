"""Identification: fit of each run, parameters with their source of information, and unidentifiable directions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from balance_cli.estimation.choices import GOOD_FIT_CHI2_PER_DOF
from balance_cli.estimation.fit_quality import FRF_BAND
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.report.blocks import (
    BulletList,
    Details,
    Heading,
    PageBlock,
    Paragraph,
    Row,
    Section,
    Table,
    TableCell,
    WarningText,
    plain_row,
)
from balance_cli.report.force_responses import band_text
from balance_cli.report.frequencies import sigma_scale
from balance_cli.report.number_format import (
    capitalize_first,
    format_fixed,
    format_percent,
    format_significant,
    value_and_sigma_text,
)
from balance_cli.report.sources import Source, Sources

PARAMETER_HEADER = ("parameter", "unit", "value", "sigma", "declared", "tolerance", "deviation", "informed by")
LARGE_DEVIATION = 3.0
"""Deviation from the declared value, in declared sigmas, beyond which it is marked (p = 0.0027)."""
LOW_CHI2_PER_DOF, LOW_CHI2_SIGMAS = 0.8, 5.0
"""Chi-square per degree of freedom below both limits means that the noise is stated too large: by 12 % at least, and
not by chance (with n degrees of freedom it scatters by sqrt(2 / n))."""


def is_good_fit(model: IdentifiedModel) -> bool:
    """Whether a fitted model describes its data to within the noise."""
    return model.quality.chi2_per_dof <= GOOD_FIT_CHI2_PER_DOF


def is_noise_overstated(model: IdentifiedModel) -> bool:
    """Whether chi-square is lower than noise of the stated size can make it: the noise is stated too large."""
    quality = model.quality
    limit = min(LOW_CHI2_PER_DOF, 1.0 - LOW_CHI2_SIGMAS * np.sqrt(2.0 / max(quality.dof, 1.0)))
    return bool(quality.chi2_per_dof < limit)


def section(sources: Sources) -> Section | None:
    """Fit of every run by every model, then the parameters of each fitted model; None where there is no model."""
    models = [source for source in sources.models if source.content.quality.runs or source.content.iterations]
    if not models:
        return None
    blocks: list[PageBlock] = [
        Paragraph(
            "Chi-square is taken against the noise measured in the runs, not against one estimated from residuals. "
            "Near 1 per degree of freedom the model describes the data. Well above 1, the uncertainties of the "
            "parameters are underestimated, because they include the noise alone."
        )
    ]
    blocks += [warning for source in models for warning in _fit_warnings(source)]
    blocks.append(quality_table(models))
    for source in models:
        if source.content.method != "computed":
            blocks += _parameter_blocks(source)
    return Section("parameters", "Identification: fit and parameters", tuple(blocks))


def _fit_warnings(source: Source[IdentifiedModel]) -> Iterator[PageBlock]:
    model, quality = source.content, source.content.quality
    if quality.runs and np.isfinite(quality.chi2_per_dof) and not is_good_fit(model) and model.method != "computed":
        yield WarningText(
            f"{capitalize_first(source.label)} does not describe these data: chi2/dof is "
            f"{format_significant(quality.chi2_per_dof)}. "
            "The model lacks at least one effect, and its parameters absorb part of it."
        )
    if not model.converged:
        yield WarningText(f"{capitalize_first(source.label)}: the fit did not converge.")
    for run, channels in model.channels_left_out.items():
        for channel, reason in channels.items():
            yield WarningText(f"{capitalize_first(source.label)}: run {run}, channel {channel} left out: {reason}.")


def quality_table(models: Sequence[Source[IdentifiedModel]]) -> Table:
    """Chi2/dof and relative response error, run by run and overall, of every model."""
    model_sources = [source for source in models if source.content.quality.runs]
    names = list(dict.fromkeys(name for source in model_sources for name in source.content.quality.runs))
    labels = (
        TableCell(""),
        *(TableCell(source.label, span=2, title=source.file) for source in model_sources),
        TableCell("noise"),
    )
    units = (
        TableCell("run"),
        *(TableCell(text) for _ in model_sources for text in ("chi2/dof", "error %")),
        TableCell("%"),
    )
    rows: list[Row] = [_run_row(name, model_sources) for name in names]
    total: list[TableCell] = [TableCell("all", mark="name total")]
    for source in model_sources:
        quality = source.content.quality
        total += [
            _ratio_cell(quality.chi2_per_dof, "total"),
            TableCell(format_percent(quality.frf_error), mark="total"),
        ]
    rows.append((*total, TableCell("", mark="total")))
    stated = dict.fromkeys(source.content.quality.frf_band or FRF_BAND for source in model_sources)
    bands = " or ".join(band_text(band) for band in stated)
    caption = (
        "Fit of every run. Error: rms of model less measured response over rms of the measured one, "
        f"{bands}; noise: the part of it that is due to the noise of the measurement. Static runs have no such error."
    )
    return Table(caption, (labels, units), tuple(rows))


def _run_row(name: str, models: Sequence[Source[IdentifiedModel]]) -> Row:
    cells = [TableCell(name, mark="name")]
    noise = float("nan")
    for source in models:
        fit = source.content.quality.runs.get(name)
        if fit is None:
            cells += [TableCell(""), TableCell("")]
            continue
        noise = fit.frf_noise_floor if np.isfinite(fit.frf_noise_floor) else noise
        cells += [
            _ratio_cell(fit.chi2 / fit.dof if fit.dof > 0 else float("nan")),
            TableCell(format_percent(fit.frf_error)),
        ]
    return (*cells, TableCell(format_percent(noise), mark="quiet"))


def _ratio_cell(ratio: float, mark: str = "") -> TableCell:
    style = "good" if ratio <= GOOD_FIT_CHI2_PER_DOF else ""
    return TableCell(format_significant(ratio), mark=f"{mark} {style}".strip())


def _parameter_blocks(source: Source[IdentifiedModel]) -> Iterator[PageBlock]:
    model = source.content
    yield Heading(f"Parameters of {source.label}")
    sources_of_information = model.parameters.informed_by
    counts = {word: sources_of_information.count(word) for word in ("data", "prior", "exact")}
    factor = format_significant(sigma_scale(model), 2)
    scale = f" Sigmas are those of the noise; to include the misfit, multiply them by {factor}."
    sentence = (
        f"{counts['data']} parameters are informed by the data, {counts['prior']} by the declared tolerances (more "
        f"than half of the information), {counts['exact']} are declared exact."
    )
    if counts["data"] == len(sources_of_information):
        sentence = f"All {len(sources_of_information)} parameters are informed by the data."
    yield Paragraph(f"{sentence} {_fit_history_text(model)}{scale if sigma_scale(model) > 1.05 else ''}")
    if model.unidentifiable:
        yield Paragraph("The data alone do not determine:")
        yield BulletList(model.unidentifiable)
    fitted = [i for i, word in enumerate(sources_of_information) if word != "exact"]
    exact = [i for i, word in enumerate(sources_of_information) if word == "exact"]
    table = parameter_table(source, fitted)
    yield table if model.form == "physical" else Details(f"{len(fitted)} coefficients", (table,))
    if exact:
        yield Details(f"{len(exact)} parameters declared exact", (parameter_table(source, exact),))


def _fit_history_text(model: IdentifiedModel) -> str:
    return f"Started from {model.start}, {model.iterations} iterations." if model.iterations else "One linear solution."


def parameter_table(source: Source[IdentifiedModel], index: Sequence[int]) -> Table:
    """Value and sigma, declared value and tolerance, their deviation, and what informs the value."""
    head = plain_row(*PARAMETER_HEADER)
    rows = tuple(_parameter_row(source.content, i) for i in index)
    caption = (
        "Identified and declared values with one sigma each; deviation in units of the declared sigma "
        "(marked above three); small: relative."
    )
    return Table(caption, (head,), rows)


def _parameter_row(model: IdentifiedModel, i: int) -> Row:
    table = model.parameters
    value, sigma = value_and_sigma_text(float(table.value[i]), float(table.sigma[i]))
    tolerance, change = float(table.declared_sigma[i]), float(table.value[i] - table.declared[i])
    is_declared = bool(np.isfinite(table.declared[i]))
    declared, width = value_and_sigma_text(float(table.declared[i]), tolerance) if is_declared else ("", "")
    deviation = change / tolerance if np.isfinite(tolerance) and tolerance > 0 else float("nan")
    # A relative change is meaningful only for a declared value that is far from zero.
    sizeable = is_declared and abs(table.declared[i]) > LARGE_DEVIATION * tolerance
    relative = f"{format_fixed(100 * change / float(table.declared[i]), 1)} %" if sizeable and table.declared[i] else ""
    far = "bad" if abs(deviation) > LARGE_DEVIATION else ""
    return (
        TableCell(table.names[i], mark="name"),
        TableCell(table.units[i], mark="quiet"),
        TableCell(value),
        TableCell(sigma),
        TableCell(declared),
        TableCell(width),
        TableCell(format_fixed(deviation, 1), relative, far),
        TableCell(table.informed_by[i], mark="" if table.informed_by[i] == "data" else "quiet"),
    )
