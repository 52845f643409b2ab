"""The picture before and after model updating: known loads over one revolution, as two models reduce them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.reduction.result import HubLoads, RunLoads
from balance_cli.report.azimuth import DEGREES, waveform
from balance_cli.report.blocks import Chart, PageBlock
from balance_cli.report.check_errors import check_runs
from balance_cli.report.figure_style import BLACK, PURPLE, VERMILION
from balance_cli.report.number_format import format_percent
from balance_cli.report.plots import Plot, Trace
from balance_cli.report.source_roles import SourceRole
from balance_cli.report.sources import Source, Sources

BEFORE_ROLES = (SourceRole.IDENTIFIED, SourceRole.LS, SourceRole.COMPUTED)
"""Loads that stand for the model before updating, the first that is given."""


@dataclass(frozen=True)
class KnownLoad:
    """A component of a check run as two models reduce it; errors relative to the applied load."""

    component: str
    before: RunLoads
    after: RunLoads
    error_before: float
    error_after: float


def before_after_blocks(sources: Sources) -> Iterator[PageBlock]:
    """Yield the chart of known loads before and after updating; nothing without loads by both models."""
    after = next((source for source in sources.loads if source.role is SourceRole.UPDATED), None)
    before = next(
        (
            source
            for role in BEFORE_ROLES
            for source in sources.loads
            if source.role is role and check_runs(source.content)
        ),
        None,
    )
    if after is None or before is None:
        return
    known = list(_known_loads(before, after))
    if known:
        caption = (
            f"Before and after model updating: known harmonic loads over one revolution, reduced by {before.label} and "
            f"by {after.label}. Each component is that of the check run with the largest error before; percent: "
            "error of its harmonics."
        )
        yield Chart.single("before-after", caption, tuple(_plot(item) for item in known), link="azimuth")


def _known_loads(before: Source[HubLoads], after: Source[HubLoads]) -> Iterator[KnownLoad]:
    """Yield each component that was applied, in the check run in which the first model misses it most."""
    runs = check_runs(after.content)
    for component in COMPONENTS:
        pairs = [
            KnownLoad(component, run, runs[name], run.check.load_error[component], later.load_error[component])
            for name, run in check_runs(before.content).items()
            if name in runs and run.check is not None and component in run.check.load_error
            for later in [runs[name].check]
            if later is not None and component in later.load_error
        ]
        if pairs:
            yield max(pairs, key=lambda item: item.error_before)


def _plot(item: KnownLoad) -> Plot:
    assert item.before.check is not None
    m = item.before.components.index(item.component)
    count = min(len(item.before.check.applied), len(item.before.amplitude), len(item.after.amplitude))
    curves = [
        ("applied", BLACK, (), 3.0, item.before.check.applied[:count, m]),
        ("before updating", VERMILION, (4.0, 2.0), 1.6, item.before.amplitude[:count, m]),
        ("after updating", PURPLE, (), 1.4, item.after.amplitude[:count, item.after.components.index(item.component)]),
    ]
    traces = tuple(
        Trace(label, waveform(np.asarray(amplitude), mean=False), color, dashes=dashes, width=width)
        for label, color, dashes, width, amplitude in curves
    )
    errors = f"{format_percent(item.error_before)} % before, {format_percent(item.error_after)} % after"
    return Plot(
        f"{item.component}, {item.before.run}: {errors}",
        DEGREES,
        traces,
        x_label="azimuth [°]",
        y_label=f"{item.component} [{UNIT_OF[item.component]}]",
    )
