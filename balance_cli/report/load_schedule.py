"""The load schedule on the page: loads and combinations, condition, variance inflation, and what it cannot tell."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from balance_cli.calibration.load_schedule import (
    HIGH_CORRELATION,
    HIGH_INFLATION,
    LoadSchedule,
    review_load_schedule,
)
from balance_cli.calibration.result import Calibration
from balance_cli.campaign.rig.load_components import component_units
from balance_cli.report.blocks import BulletList, Details, Heading, PageBlock, Paragraph, Table, TableCell, plain_row
from balance_cli.report.load_series_rows import split_load_series
from balance_cli.report.number_format import MISSING_VALUE, format_significant


def load_schedule_blocks(calibration: Calibration) -> Iterator[PageBlock]:
    """The review of the load schedule; nothing for a calibration without rows."""
    all_trims = calibration.all_trims
    if all_trims is None or not len(all_trims.loads):
        return
    number = np.zeros(len(all_trims.loads), np.intp)
    for n, entry in enumerate(split_load_series(all_trims)):
        number[entry.rows] = n
    schedule = review_load_schedule(all_trims, number)
    yield Heading("Load schedule")
    yield Paragraph(
        f"{schedule.rows} points in {schedule.series_count} load series. Condition of the linear design, with one zero "
        f"for each series: {_number(schedule.condition)}. At most {schedule.combined} loads at a time; the largest sum "
        f"of the loads of a point is {format_significant(schedule.load_sum)} times the calibrated range. Beyond these "
        "combinations the model extrapolates, even where each load is within its range."
    )
    yield component_table(schedule, component_units(calibration.geometry))
    yield Details("Pairs of loads", (pair_table(schedule),))
    aliased = [name for name, reason in all_trims.model.unsupported_terms.items() if "does what" in reason]
    questions = list(schedule.open_questions)
    if aliased:
        questions.append(f"Terms that these loads do not separate from others: {', '.join(aliased)}.")
    if questions:
        yield Paragraph("What this schedule cannot determine:")
        yield BulletList(tuple(questions))


def component_table(schedule: LoadSchedule, units: Mapping[str, str]) -> Table:
    """Points, levels, limits and variance inflation of each load."""
    words = ("load", "points", "alone", "levels", "load series", "smallest", "largest", "inflation")
    rows = []
    for j, name in enumerate(schedule.components):
        inflation = float(schedule.inflation[j])
        counts = (schedule.applied[j], schedule.alone[j], schedule.levels[j], schedule.series[j])
        limits = (float(schedule.smallest[j]), float(schedule.largest[j]))
        rows.append(
            (
                TableCell(name, mark="name"),
                *(TableCell(str(int(count))) for count in counts),
                *(TableCell(f"{format_significant(value, 4)} {units[name]}") for value in limits),
                TableCell(_number(inflation), mark="bad" if inflation > HIGH_INFLATION else ""),
            )
        )
    caption = (
        "Points with each load, with this load alone, distinct levels, load series that vary it, limits, and variance "
        f"inflation by the other loads (marked: more than {HIGH_INFLATION:.0f})."
    )
    return Table(caption, (plain_row(*words),), tuple(rows))


def pair_table(schedule: LoadSchedule) -> Table:
    """Points with both loads of a pair, and the correlation of the two."""
    head = plain_row("", *schedule.components)
    rows = []
    for i, name in enumerate(schedule.components):
        cells = []
        for j in range(len(schedule.components)):
            correlation = float(schedule.correlation[i, j])
            mark = "bad" if i != j and abs(correlation) > HIGH_CORRELATION else ""
            note = "" if i == j else format_significant(correlation, 2)
            cells.append(TableCell(str(int(schedule.together[i, j])), note, mark))
        rows.append((TableCell(name, mark="name"), *cells))
    caption = (
        "Points in which both loads are applied; small: correlation of the two within the load series (marked: beyond "
        f"{HIGH_CORRELATION:g})."
    )
    return Table(caption, (head,), tuple(rows))


def _number(value: float) -> str:
    return format_significant(value, 3) if np.isfinite(value) else MISSING_VALUE
