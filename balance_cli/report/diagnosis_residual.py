"""What the residual of a diagnosis looked like: by channel, excited component and frequency, before and after."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.result import Diagnosis, ResidualMap
from balance_cli.estimation.choices import GOOD_FIT_CHI2_PER_DOF
from balance_cli.report.blocks import (
    Chart,
    PageBlock,
    Paragraph,
    PlotGroup,
    Row,
    Table,
    group_heading_row,
    plain_row,
    row_with_name,
)
from balance_cli.report.figure_style import BLUE, GRAY, VERMILION
from balance_cli.report.number_format import format_fixed, format_significant, join_names
from balance_cli.report.plots import Plot, Trace

Array = NDArray[np.float64]

MOST_ROWS = 4
"""Channels and bands of the table: those with the largest share of the residual; the map shows all."""
WHITE_LIMIT = 0.05
"""Share of correlations of white residuals that lie above the line in the picture."""
DOMINANT_SHARE = 0.5
"""Share of the residual above which one place is named as the main one."""


@dataclass(frozen=True)
class Share:
    """One part of the residual: rms over the noise before and after, and share of the excess before over the noise."""

    name: str
    before: float
    after: float
    share: float


def residual_blocks(diagnosis: Diagnosis, suffix: str) -> Iterator[PageBlock]:
    """Yield the sentence, the table of shares, and the charts of size and correlation of the residual."""
    residual = diagnosis.residual
    groups = residual_shares(residual)
    yield Paragraph(_sentence(diagnosis, groups))
    if any(groups.values()) and _exceeds_noise(residual):
        yield _share_table(groups)
    if np.isfinite(residual.before).any():
        yield _frequency_chart(residual, suffix)
    if residual.correlation_before is not None and residual.pairs is not None and np.any(residual.pairs > 0):
        yield _whiteness_chart(residual, suffix)


def residual_shares(residual: ResidualMap) -> dict[str, list[Share]]:
    """Return the parts of the residual {`channel`, `excited component`, `frequency`: parts, the largest first}."""
    groups = {
        "channel": _shares(residual, 2, residual.channels, _single(len(residual.channels))),
        "frequency": _shares(residual, 1, _band_names(residual.edges), _single(len(residual.edges) - 1)),
    }
    if residual.excited is not None:
        names = tuple(dict.fromkeys(residual.excited))
        members = [[i for i, name in enumerate(residual.excited) if name == wanted] for wanted in names]
        labels = tuple(name or "static runs" for name in names)
        groups["excited component"] = _shares(residual, 0, labels, members)
    return groups


def _single(count: int) -> list[list[int]]:
    return [[i] for i in range(count)]


def _shares(residual: ResidualMap, axis: int, names: Sequence[str], members: Sequence[list[int]]) -> list[Share]:
    excess = np.nansum(np.maximum(residual.before**2 - 1.0, 0.0))
    parts = []
    for name, index in zip(names, members, strict=True):
        before, after = residual.before.take(index, axis), residual.after.take(index, axis)
        if np.isfinite(before).any() and excess > 0:
            share = float(np.nansum(np.maximum(before**2 - 1.0, 0.0)) / excess)
            parts.append(Share(name, _rms(before), _rms(after), share))
    return sorted(parts, key=lambda part: -part.share)


def _rms(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


def _band_names(edges: Array) -> tuple[str, ...]:
    return tuple("at rest" if low == 0.0 else f"{low:.4g} to {high:.4g} Hz" for low, high in pairwise(edges))


def _sentence(diagnosis: Diagnosis, groups: dict[str, list[Share]]) -> str:
    before, after = _rms(diagnosis.residual.before), _rms(diagnosis.residual.after)
    words = (
        f"Before updating the rms residual was {format_significant(before)} times the noise; after it, "
        f"{format_significant(after)} times."
    )
    main = [_main_text(kind, parts) for kind, parts in groups.items() if parts]
    named = [text for text in main if text]
    if not _exceeds_noise(diagnosis.residual):
        return f"{words} There was nothing beyond the noise to explain."
    return f"{words} Most of it was {join_names(named)}." if named else words


def _exceeds_noise(residual: ResidualMap) -> bool:
    """Whether the residual before is more than noise; shares of noise would name places by chance."""
    return _rms(residual.before) ** 2 > GOOD_FIT_CHI2_PER_DOF


def _main_text(kind: str, parts: Sequence[Share]) -> str:
    """The few parts that hold more than half of the residual; empty where it is spread."""
    names: list[str] = []
    total = 0.0
    for part in parts[:2]:
        names.append(part.name)
        total += part.share
        if total >= DOMINANT_SHARE:
            place = {"channel": "in", "frequency": "at", "excited component": "with the excitation"}[kind]
            return f"{place} {join_names(names)} ({100 * total:.0f} %)"
    return ""


def _share_table(groups: dict[str, list[Share]]) -> Table:
    head = ("", "rms before / noise", "share of the excess", "rms after / noise")
    rows: list[Row] = []
    for kind, parts in groups.items():
        if not parts:
            continue
        more = f", the {MOST_ROWS} largest of {len(parts)}" if len(parts) > MOST_ROWS else ""
        rows.append(group_heading_row(f"by {kind}{more}", len(head)))
        for part in parts[:MOST_ROWS]:
            values = (format_significant(part.before), f"{100 * part.share:.0f} %", format_significant(part.after, 3))
            rows.append(row_with_name(part.name, *values))
    caption = (
        "Where the residual was: rms over its noise before and after updating (the noise alone gives 1), and the share "
        "of the squared residual before that exceeds the noise."
    )
    return Table(caption, (plain_row(*head),), tuple(rows))


def _frequency_chart(residual: ResidualMap, suffix: str) -> Chart:
    """The rms over frequency: all runs, then the runs of each excited component."""
    groups = [("all runs", list(range(len(residual.runs))))]
    if residual.excited is not None:
        for name in dict.fromkeys(name for name in residual.excited if name):
            groups.append((name, [i for i, other in enumerate(residual.excited) if other == name]))
    plot_groups = tuple(PlotGroup(label, (_frequency_plot(residual, label, index),)) for label, index in groups)
    caption = (
        "Residual over its noise, rms over channels and runs in each frequency band, before and after updating. White "
        "residuals lie at 1 everywhere."
    )
    return Chart(f"residual-frequency{suffix}", caption, plot_groups, "frequency", wide=True)


def _frequency_plot(residual: ResidualMap, label: str, runs: list[int]) -> Plot:
    moving = residual.edges[:-1] > 0
    middle = (0.5 * (residual.edges[:-1] + residual.edges[1:]))[moving]
    before, after = (
        np.array([_rms(stage[runs][:, band]) for band in np.flatnonzero(moving)])
        for stage in (residual.before, residual.after)
    )
    traces = (
        Trace("before updating", before, VERMILION, (4.0, 2.0)),
        Trace("after updating", after, BLUE),
        Trace("noise alone", np.ones(len(middle)), GRAY, (2.0, 2.0), 1.0),
    )
    return Plot(f"Residual, {label}", middle, traces, "frequency [Hz]", "rms residual / noise", True)


def _whiteness_chart(residual: ResidualMap, suffix: str) -> Chart:
    """Correlation between lines for each channel, with the limit for white residuals."""
    assert residual.correlation_before is not None and residual.correlation_after is not None
    assert residual.pairs is not None
    lags = np.arange(1.0, residual.pairs.shape[1] + 1.0)
    limit = np.sqrt(-np.log(WHITE_LIMIT) / np.maximum(residual.pairs, 1.0))
    plots = []
    above = total = 0
    for i, name in enumerate(residual.channels):
        if not residual.pairs[i].any():
            continue
        known = residual.pairs[i] > 0
        above += int(np.count_nonzero(residual.correlation_after[i][known] > limit[i][known]))
        total += int(np.count_nonzero(known))
        traces = (
            Trace("before updating", residual.correlation_before[i], VERMILION, (4.0, 2.0)),
            Trace("after updating", residual.correlation_after[i], BLUE),
            Trace("95 % limit, white", np.where(known, limit[i], np.nan), GRAY, (2.0, 2.0), 1.0),
        )
        plots.append(Plot(name, lags, traces, "lines apart", "correlation [1]", False, (), (0.0, 1.0), 150))
    percent = format_fixed(100.0 * above / max(total, 1), 1)
    caption = (
        "Whiteness of the residuals: size of the correlation of the residuals of lines 1, 2 and so on apart, each "
        "channel over all sweeps. White residuals lie below the dashed line in 95 % of all places; after updating "
        f"{above} of {total} ({percent} %) lie above it. Residuals that are alike from line to line are an error of "
        "the model, not noise."
    )
    return Chart(f"whiteness{suffix}", caption, (PlotGroup("", tuple(plots)),), "")
