"""Section of a plan: its runs, what they will find, the sigma of the hub loads, and effects that stay alike."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.planning.stored_forecast import StoredEffect, StoredForecast, StoredLoads, StoredPlan
from balance_cli.report.blocks import (
    Chart,
    Heading,
    KeyFigures,
    PageBlock,
    Paragraph,
    PlotGroup,
    Row,
    Section,
    Table,
    TableCell,
    plain_row,
    row_with_name,
)
from balance_cli.report.figure_style import BLUE, GRAY, ORANGE
from balance_cli.report.number_format import format_percent, format_significant, join_names
from balance_cli.report.plots import Plot, Trace
from balance_cli.report.sources import Sources


def section(sources: Sources) -> Section | None:
    """Return the plans with their forecasts; None without any."""
    if not sources.plans:
        return None
    blocks: list[PageBlock] = []
    for number, stored in enumerate(sources.plans, 1):
        if len(sources.plans) > 1:
            blocks.append(Heading(stored.file))
        blocks += _plan_blocks(stored, f"plan-{number}")
    return Section("plan", "Plan of a campaign", tuple(blocks))


def _plan_blocks(stored: StoredPlan, name: str) -> Iterator[PageBlock]:
    forecast = stored.forecast
    yield KeyFigures(tuple(_key_figures(stored)))
    earlier_runs = f" Already made: {join_names(list(forecast.made))}." if forecast.made else ""
    yield Paragraph(f"Noise of the plan: {forecast.noise}.{earlier_runs}")
    yield _run_table(stored)
    yield _effect_table(forecast)
    if forecast.effects:
        yield _size_chart(stored, f"{name}-sizes")
    if forecast.loads is not None:
        yield _load_table(forecast.loads)
        yield _load_chart(forecast.loads, f"{name}-loads")
    if forecast.confusion:
        yield _confusion_table(forecast)
    if forecast.not_predicted:
        names = [f"{item['name']} ({item['why']})" for item in forecast.not_predicted]
        yield Paragraph(f"Not predicted: {'; '.join(names)}.")


def _key_figures(stored: StoredPlan) -> Iterator[tuple[str, str, str]]:
    forecast = stored.forecast
    yield str(len(stored.plan.runs)), "runs", ""
    yield f"{forecast.minutes:.0f} min", "of hall time, changes of set-up included", ""
    shown = sum(1 for item in forecast.effects if item.after and item.after[-1])
    yield f"{shown} of {len(forecast.effects)}", "kinds of effects that the runs show", ""
    shares = [item.load_share for item in forecast.effects if item.load_share is not None]
    if shares:
        caption = "of the reference load: the most that an effect does to a hub load while it is not found"
        yield f"{format_percent(max(shares))} %", caption, ""


def _run_table(stored: StoredPlan) -> Table:
    # They need the simulation, which takes a twentieth of the start of a page without a plan.
    from balance_cli.planning.run_words import condition_words, excitation_words, level_words, record_words

    head = ("run", "excited", "level, rms", "rotor, loads", "record", "sigma of loads by parameters")
    loads = stored.forecast.loads
    rows: list[Row] = []
    for i, run in enumerate(stored.plan.runs):
        part = "" if loads is None else f"x {format_significant(loads.parameter_part_after_run[i])}"
        words = (excitation_words(run), level_words(run), condition_words(run), record_words(run))
        rows.append(row_with_name(run.run, *words, part))
    caption = (
        "Runs in their order. Last column: the part of the loads' sigma that the parameters make, over that before."
    )
    return Table(caption, (plain_row(*head),), tuple(rows))


def _effect_table(forecast: StoredForecast) -> Table:
    head = ("effect, hardest place", "now", "after", "unit", "easiest place", "error of a hub load meanwhile")
    rows = tuple(_effect_row(item) for item in forecast.effects)
    caption = (
        f"Smallest size that is found {100 * forecast.power:.0f} % of the time, at {100 * forecast.level:.2g} % false "
        "alarms for all candidates together. Last column: largest error of a harmonic load that an effect of this size "
        "makes while it is not found, over the reference load of its component."
    )
    return Table(caption, (plain_row(*head),), rows, sortable=True)


def _effect_row(item: StoredEffect) -> Row:
    easiest = f"{item.easiest.place}: {_size(item.easiest.size)}"
    share = "" if item.load_share is None else f"{format_percent(item.load_share)} %"
    last = item.after[-1] if item.after else None
    after = _size(last) if last or not item.shown_by else f"not shown; would be by {item.shown_by}"
    texts = (_size(item.before), after, item.unit, easiest, share)
    return row_with_name(f"{item.hardest} {item.parameter}", *texts)


def _size(value: float | None) -> str:
    """A size; a dash where no run shows the effect."""
    return format_significant(value) if value else "-"


def _size_chart(stored: StoredPlan, name: str) -> Chart:
    """Smallest sizes over the runs, relative to those after the last one."""
    x = np.arange(1.0, len(stored.plan.runs) + 1.0)
    groups = []
    for item in stored.forecast.effects:
        last = item.after[-1] if item.after else None
        if not last:
            continue
        sizes = np.array([size or np.nan for size in item.after])
        trace = Trace(f"{item.hardest} {item.parameter}", sizes, BLUE)
        plot = Plot(f"{item.hardest}", x, (trace,), "runs made", f"smallest size [{item.unit}]", log_y=True)
        groups.append(PlotGroup(item.name, (plot,)))
    return Chart(name, "Smallest size of an effect that is found, after each run.", tuple(groups), wide=True)


def _load_table(loads: StoredLoads) -> Table:
    head = ("load", "reference", "now", "after", "noise of a record", "at")
    rows = []
    for component, reference in loads.reference.items():
        parts = (loads.sigma_before, loads.sigma_after, loads.sigma_noise)
        before, after, noise = (np.array(part[component]) for part in parts)
        worst = int(after.argmax())
        numbers = [f"{format_percent(float(part[worst]) / reference)} %" for part in (before, after, noise)]
        place = f"{loads.frequency_hz[worst]:.4g} Hz"
        rows.append(row_with_name(component, f"{reference:.4g} {UNIT_OF[component]}", *numbers, place))
    caption = "Sigma of cosine and sine of each hub load over its reference, at the harmonic where it is largest."
    return Table(caption, (plain_row(*head),), tuple(rows))


def _load_chart(loads: StoredLoads, name: str) -> Chart:
    x = np.array(loads.frequency_hz)
    groups = []
    for component in loads.reference:
        first = loads.sigma_after_run[component][0] if loads.sigma_after_run[component] else ()
        traces = [Trace("now", np.array(loads.sigma_before[component]), GRAY)]
        traces += [Trace("after the first run", np.array(first), ORANGE, (4, 3))] if first else []
        traces.append(Trace("after all runs", np.array(loads.sigma_after[component]), BLUE))
        traces.append(Trace("noise of a record", np.array(loads.sigma_noise[component]), GRAY, (1, 3)))
        unit = UNIT_OF[component]
        plot = Plot(component, x, tuple(traces), "frequency [Hz]", f"sigma [{unit}]", log_y=True)
        groups.append(PlotGroup(component, (plot,)))
    return Chart(name, "Sigma of the hub loads at the harmonics of the rotor, now and after the runs.", tuple(groups))


def _confusion_table(forecast: StoredForecast) -> Table:
    head = ("cosine", "first", "second", "run that separates them best", "cosine with it")
    rows = []
    for pair in forecast.confusion:
        other = f" (and {pair.places - 1} other places)" if pair.places > 1 else ""
        remedy = pair.run or (f"none of this hall; {pair.further}" if pair.further else f"no run; {pair.otherwise}")
        cosine = pair.cosine_with_run if pair.run else min(pair.cosine, pair.cosine_with_further)
        cells = [TableCell(text, mark="text") for text in (pair.first, pair.second + other, remedy)]
        rows.append((TableCell(f"{pair.cosine:.4f}"), *cells, TableCell(f"{cosine:.4f}")))
    caption = "Effects that change the data in nearly the same way (cosine of their angle; 1: indistinguishable)."
    return Table(caption, (plain_row(*head),), tuple(rows))
