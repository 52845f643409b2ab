"""Wind-on loads: harmonics with sigma, and the residual test of the redundant channels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.reduction.choices import FREQUENCIES
from balance_cli.reduction.flags import REDUNDANCY
from balance_cli.reduction.reliability import SENSOR_ERROR
from balance_cli.reduction.result import HubLoads, RunLoads
from balance_cli.report.azimuth import azimuth_chart
from balance_cli.report.blocks import (
    BulletList,
    Details,
    Heading,
    PageBlock,
    Paragraph,
    Picture,
    Row,
    Section,
    Table,
    TableCell,
    WarningText,
    group_heading_row,
    plain_row,
    row_with_name,
)
from balance_cli.report.figure_style import svg
from balance_cli.report.load_figures import (
    amplitude_sigma,
    harmonics_figure,
    redundancy_figure,
    wind_runs,
)
from balance_cli.report.number_format import (
    capitalize_first,
    format_fixed,
    format_significant,
    join_names,
    value_and_sigma_text,
)
from balance_cli.report.polar_picture import polar_picture
from balance_cli.report.recommendation import rank_methods, tested_harmonics
from balance_cli.report.sources import Source, Sources


def harmonics_above_limit(run: RunLoads) -> list[int]:
    """The harmonics that fail the residual test of the redundant channels."""
    return [int(n) for n in np.flatnonzero(run.redundancy > run.redundancy_limit)]


def section(sources: Sources) -> Section | None:
    """Loads of the wind-on runs, their residual test and condition; None without wind-on runs."""
    load_sources = tuple(source for source in sources.loads if wind_runs(source.content))
    if not load_sources:
        return None
    tested = _sources_by_harmonics(load_sources)
    shown = rank_methods(tested)[0]
    blocks: list[PageBlock] = [
        *_residual_test_blocks(tested, shown),
        Heading(f"Loads by {shown.label}"),
        *_azimuth_blocks(shown),
        Picture(
            "harmonics",
            f"Amplitude of the harmonics by {shown.label}, with one sigma. Open symbols: residual test failed.",
            svg("harmonics", "Harmonic hub loads by component", lambda: harmonics_figure(shown.content)),
        ),
        *_load_tables(shown.content),
        condition_table(tested),
        *_unnoticed_errors(shown),
        *(Paragraph(f"{name}: {note}.") for name, note in _undeclared_masses(shown)),
        *_left_out_blocks(load_sources),
    ]
    others = [source for source in load_sources if source is not shown]
    blocks += [Details(f"Loads by {source.label}", tuple(_load_tables(source.content))) for source in others]
    return Section("wind-on", "Wind-on loads", tuple(blocks))


def _residual_test_blocks(tested: Sequence[Source[HubLoads]], shown: Source[HubLoads]) -> Iterator[PageBlock]:
    """Yield the residual test of every method; where no sensor is redundant, that nothing tests the loads."""
    runs = [run for source in tested for run in wind_runs(source.content).values()]
    if not any(map(tested_harmonics, runs)):
        yield WarningText(
            "The true loads of these runs are not known, and there are no more cells than loads: no residual tests the "
            "response. Runs with known loads are the only evidence that it holds."
        )
        if not any(np.isfinite(run.redundancy).any() for run in runs):
            return
    yield Paragraph(
        "Redundant channels test the loads. Where there are more cells than loads, their residuals test the response; "
        "several channels in one cell test only each other. While the response holds, the residuals are within the "
        "noise, and chi2 per degree of freedom is near 1. Where chi2 exceeds its 99.9 % point, the row is flagged and "
        "its sigma is enlarged."
    )
    yield from _residual_test_verdicts(tested, shown)
    yield Picture(
        "redundancy",
        "Residual test: chi-square per degree of freedom of the redundant channels, by harmonic. Dashed: 99.9 % point.",
        svg("redundancy", "Redundancy by harmonic of every run and method", lambda: redundancy_figure(tested)),
    )


def _azimuth_blocks(shown: Source[HubLoads]) -> Iterator[PageBlock]:
    """Yield the loads over azimuth; loads at given frequencies have none."""
    if shown.content.method != FREQUENCIES:
        yield azimuth_chart(wind_runs(shown.content), shown.label)
        rotor = shown.content.geometry.rotor
        yield polar_picture(wind_runs(shown.content), rotor.blades if rotor else 1, shown.label)


def _sources_by_harmonics(load_sources: Sequence[Source[HubLoads]]) -> Sequence[Source[HubLoads]]:
    """The loads by harmonics, where there are any: loads in time have the same residual test and condition."""
    return [source for source in load_sources if source.content.method == "harmonic"] or load_sources


def _residual_test_verdicts(load_sources: Sequence[Source[HubLoads]], shown: Source[HubLoads]) -> Iterator[PageBlock]:
    """One sentence per method; a warning where the loads shown fail the residual test."""
    sentences = {source.label: _residual_test_sentence(source) for source in load_sources}
    if any(map(harmonics_above_limit, wind_runs(shown.content).values())):
        yield WarningText(f"{sentences.pop(shown.label)} The uncertainties of these loads may be underestimated.")
    yield BulletList(tuple(sentences.values()))


def _residual_test_sentence(source: Source[HubLoads]) -> str:
    runs = wind_runs(source.content).values()
    failing = sum(len(harmonics_above_limit(run)) for run in runs)
    values = [float(value) for run in runs for value in run.redundancy if np.isfinite(value)]
    if not values:
        return f"{capitalize_first(source.label)}: no redundant channel."
    if not failing and not any(map(tested_harmonics, runs)):
        name = capitalize_first(source.label)
        return f"{name}: in all {len(values)} harmonics the channels of each cell agree; nothing tests the response."
    if not failing:
        return f"{capitalize_first(source.label)}: all {len(values)} harmonics pass the residual test."
    largest = format_significant(max(values))
    name = capitalize_first(source.label)
    return f"{name}: {failing} of {len(values)} harmonics fail the residual test (chi2/dof up to {largest})."


def _load_tables(loads: HubLoads) -> Iterator[Table]:
    runs = list(wind_runs(loads).values())
    names = [name for name in COMPONENTS if any(name in run.components for run in runs)]
    head = (TableCell(""), *(TableCell(f"{name} [{UNIT_OF[name]}]") for name in names))
    mean_rows: list[Row] = [_mean_load_row(run, names) for run in runs]
    yield Table(
        "Mean loads (harmonic 0) with sigma, by the named model of the static calibration.", (head,), tuple(mean_rows)
    )
    rows: list[Row] = []
    for run in runs:
        rows.append(
            group_heading_row(f"{run.run}: 1/rev {run.frequency_hz[1]:.3f} Hz, {_interval_text(run)}", 1 + len(names))
        )
        rows += [_harmonic_row(run, n, names) for n in range(1, len(run.frequency_hz))]
    caption = (
        "Amplitude \N{PLUS-MINUS SIGN} sigma and phase in degrees (x = A cos(n psi + phase)). Marked rows: flagged."
    )
    yield Table(caption, (head,), tuple(rows))


def _interval_text(run: RunLoads) -> str:
    return f"{run.interval[0]:.2f} to {run.interval[1]:.2f} s"


def _mean_load_row(run: RunLoads, names: Sequence[str]) -> Row:
    cells = [TableCell(run.run, run.mean_loads_by, "name")]
    for name in names:
        if name not in run.components:
            cells.append(TableCell(""))
            continue
        m = run.components.index(name)
        value, sigma = value_and_sigma_text(float(run.amplitude[0, m].real), float(run.sigma_cosine[0, m]))
        cells.append(TableCell(f"{value} \N{PLUS-MINUS SIGN} {sigma}", run.flags[0][m]))
    return tuple(cells)


def _harmonic_row(run: RunLoads, n: int, names: Sequence[str]) -> Row:
    flagged = any(REDUNDANCY in flag for flag in run.flags[n])
    cells = [TableCell(f"{n}", f"{run.frequency_hz[n]:.2f} Hz", "name bad" if flagged else "name")]
    sigmas = amplitude_sigma(run)[n]
    for name in names:
        if name not in run.components:
            cells.append(TableCell(""))
            continue
        m = run.components.index(name)
        value, sigma = value_and_sigma_text(float(np.abs(run.amplitude[n, m])), float(sigmas[m]))
        phase = format_fixed(float(np.degrees(np.angle(run.amplitude[n, m]))), 1)
        mark = "bad" if run.flags[n][m] else ""
        cells.append(TableCell(f"{value} \N{PLUS-MINUS SIGN} {sigma}", f"{phase}°", mark, title=run.flags[n][m]))
    return tuple(cells)


def condition_table(load_sources: Sequence[Source[HubLoads]]) -> Table:
    """Condition number of the response by method, run and harmonic, with the residual test."""
    longest = max(len(run.condition) for source in load_sources for run in wind_runs(source.content).values())
    head = (TableCell(""), *(TableCell(str(n)) for n in range(longest)))
    rows: list[Row] = []
    for source in load_sources:
        rows.append(group_heading_row(source.label, 1 + longest))
        for run in wind_runs(source.content).values():
            rows.append(
                (TableCell(run.run, mark="name"), *(_condition_cell(run, n) for n in range(len(run.condition))))
            )
    caption = (
        "Condition number of the response by harmonic, loads against channels in units of their noise; small: "
        "chi2/dof of the residual test. Marked: above its limit."
    )
    return Table(caption, (head,), tuple(rows))


def _condition_cell(run: RunLoads, n: int) -> TableCell:
    above = bool(run.redundancy[n] > run.redundancy_limit[n])
    limit = f"limit {format_significant(float(run.redundancy_limit[n]))}"
    return TableCell(
        format_significant(float(run.condition[n])),
        format_significant(float(run.redundancy[n]), 2),
        "bad" if above else "",
        1,
        limit,
    )


def _unnoticed_errors(shown: Source[HubLoads]) -> Iterator[Table]:
    """Yield the table of the loads that rest on one sensor, where there are any."""
    rows: list[Row] = []
    for name, run in wind_runs(shown.content).items():
        for item in run.unnoticed_changes:
            unit = UNIT_OF[item.component]
            change = f"{format_significant(item.change, 2)} {unit}"
            load = f"{format_significant(item.load, 2)} {unit}"
            rows.append(row_with_name(name, item.sensor, item.component, str(item.harmonic), change, load))
    if rows:
        caption = (
            f"Loads by {shown.label} that rest on one sensor: an error of up to {100.0 * SENSOR_ERROR:g} % of this "
            "sensor changes the load, and the residual test does not show it. Of each load the harmonic that changes "
            "most."
        )
        yield Table(caption, (plain_row("", "sensor", "load", "harmonic", "change", "amplitude"),), tuple(rows))


def _undeclared_masses(shown: Source[HubLoads]) -> Iterator[tuple[str, str]]:
    """Yield the runs in which a mass that no channel shows changes loads, and which."""
    for name, run in wind_runs(shown.content).items():
        if run.undeclared_mass_note:
            yield name, run.undeclared_mass_note


def _left_out_blocks(load_sources: Sequence[Source[HubLoads]]) -> Iterator[PageBlock]:
    left_out: dict[tuple[str, str, str], list[str]] = {}
    notes: dict[tuple[str, str], list[str]] = {}
    for source in load_sources:
        for name, run in source.content.runs.items():
            for channel, reason in run.left_out.items():
                left_out.setdefault((name, channel, reason), []).append(source.label)
            for note in filter(None, run.notes):
                notes.setdefault((name, note), []).append(source.label)
    for (name, channel, reason), labels in left_out.items():
        where = "" if len(labels) == len(load_sources) else f" (by {join_names(labels)})"
        yield WarningText(f"{name}: channel {channel} left out: {reason}{where}.")
    for name, note in notes:
        yield Paragraph(f"{name}: {note}.")
    if not left_out:
        yield Paragraph("No channel was left out.")
