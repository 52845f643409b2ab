"""Section of loads in time: tests of the filter, harmonics from revolution to revolution, noise of the channels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from balance_cli.reduction.choices import LOAD_MODEL_TEXTS
from balance_cli.reduction.kalman.innovations import (
    LARGEST_AUTOCORRELATION,
    LARGEST_NIS,
    LARGEST_SLOW_POWER,
    SMALLEST_NIS,
    InnovationTests,
)
from balance_cli.reduction.kalman.load_history import LoadTrack
from balance_cli.reduction.result import HubLoads, RunLoads, TimeDomainResult
from balance_cli.report.blocks import (
    Chart,
    Details,
    Heading,
    PageBlock,
    Paragraph,
    Row,
    Section,
    Table,
    TableCell,
    group_heading_row,
    plain_row,
)
from balance_cli.report.innovation_chart import innovation_chart
from balance_cli.report.number_format import MISSING_VALUE, format_fixed, format_significant
from balance_cli.report.sources import Source, Sources
from balance_cli.report.track_plots import HARMONICS_SHOWN, track_plots


def section(sources: Sources) -> Section | None:
    """Return the section of runs reduced by a filter or smoother; None where there are none."""
    load_sources = tuple(source for source in sources.loads if runs_in_time(source.content))
    if not load_sources:
        return None
    blocks: list[PageBlock] = [
        Paragraph(
            "A Kalman filter estimates the loads at each sample from the samples before it, a smoother from the whole "
            "record. Both predict each sample of each channel from the samples before it; the innovations, measured "
            "less predicted, test the filter. The normalized innovation squared (NIS) is 1 if the innovations have the "
            "covariance that the filter computes, and then sigma is right. The whiteness is 1 if the innovations are "
            "not correlated. The small figures are the standard deviations of both for a consistent filter."
        ),
        innovation_tests_table(load_sources),
        *([chart] if (chart := innovation_chart(load_sources)) is not None else []),
        *_track_pictures(load_sources),
        *(channel_noise_table(source) for source in load_sources),
        *_gap_note_texts(load_sources),
    ]
    return Section("in-time", "Loads in time", tuple(blocks))


def runs_in_time(loads: HubLoads) -> dict[str, TimeDomainResult]:
    """Return the runs that were reduced in time."""
    return {name: run.in_time for name, run in loads.runs.items() if run.in_time is not None}


def innovation_tests_table(load_sources: Sequence[Source[HubLoads]]) -> Table:
    """Return the table of NIS and whiteness of every run and method."""
    head = ("", "NIS", "whiteness", "rms autocorrelation", "slow power", "samples")
    rows: list[Row] = []
    for source in load_sources:
        runs = runs_in_time(source.content)
        for heading in dict.fromkeys(_filter_text(run) for run in runs.values()):
            rows.append(group_heading_row(f"{source.label}: {heading}", len(head)))
            rows += [
                innovation_tests_row(name, run.innovations)
                for name, run in runs.items()
                if _filter_text(run) == heading
            ]
    caption = (
        "Innovations of all channels together; small: one standard deviation for a consistent filter. Marked, and the "
        f"loads flagged `filter contradicted`: NIS not within {SMALLEST_NIS:g} to {LARGEST_NIS:g} (below, where loads "
        "of any size within a band are assumed, it means that they are smaller), an rms "
        f"autocorrelation over {LARGEST_AUTOCORRELATION:g} beyond chance, or a slow power over {LARGEST_SLOW_POWER:g}. "
        "That is the spectral density of a channel toward zero frequency over that of white innovations. Unlike the "
        "whiteness, these do not grow with the record."
    )
    return Table(caption, (plain_row(*head),), tuple(rows))


def _filter_text(run: TimeDomainResult) -> str:
    lag = f", lag {format_significant(run.lag, 2)} s" if run.lag is not None else ""
    return f"load model: {LOAD_MODEL_TEXTS.get(run.load_model, run.load_model)}{lag}"


def innovation_tests_row(name: str, tests: InnovationTests | None) -> Row:
    """Return the row of a run in the table; what contradicts the filter is marked."""
    if tests is None:
        return (
            TableCell(name, mark="name"),
            TableCell(MISSING_VALUE, title="no part of the record has all channels"),
        )
    size = "bad" if tests.wrong_size else ""
    correlated = "bad" if tests.correlated else ""
    return (
        TableCell(name, mark="name"),
        TableCell(format_fixed(tests.nis, 3), format_fixed(tests.nis_sigma, 3), size),
        TableCell(format_significant(tests.whiteness), format_significant(tests.whiteness_sigma, 1), correlated),
        TableCell(format_significant(tests.rms_autocorrelation, 2), mark=correlated),
        TableCell(format_fixed(tests.slow_power, 2), mark=correlated),
        TableCell(str(tests.samples)),
    )


def _track_pictures(load_sources: Sequence[Source[HubLoads]]) -> Iterator[PageBlock]:
    """Yield the picture of the first run; those of the other runs are folded."""
    first = True
    for source, run, track in _tracks(load_sources):
        title = f"{run.run} by {source.label}"
        name = f"in-time-{load_sources.index(source) + 1}-{run.run}"
        caption = (
            f"{title}. Mean of each revolution, with one sigma of the load at an instant; then amplitudes of the "
            f"{HARMONICS_SHOWN} strongest harmonics of each component with one sigma, less their means, which the "
            "legend states. Dashed: limits of the steady part, to which the table of loads refers."
        )
        picture = Chart.single(name, caption, track_plots(run, track), f"time-{run.run}")
        if first:
            yield Heading("Loads from revolution to revolution")
        yield picture if first else Details(title, (picture,))
        first = False


def _tracks(load_sources: Sequence[Source[HubLoads]]) -> Iterator[tuple[Source[HubLoads], RunLoads, LoadTrack]]:
    for source in load_sources:
        for run in source.content.runs.values():
            if run.in_time is not None and run.in_time.track is not None:
                yield source, run, run.in_time.track


def channel_noise_table(source: Source[HubLoads]) -> Table:
    """Return the table of the noise of each channel and of the mean square of its innovations, run by run."""
    runs = runs_in_time(source.content)
    names = dict.fromkeys(name for run in runs.values() for name in run.noise)
    head = plain_row("", *runs)
    rows = [(TableCell(name, mark="name"), *(_channel_cell(run, name) for run in runs.values())) for name in names]
    caption = (
        f"{source.label}: noise of one sample of each channel [mV], from frequencies above all loads; small: mean "
        "square of its innovations, 1 for a consistent filter."
    )
    return Table(caption, (head,), tuple(rows))


def _channel_cell(run: TimeDomainResult, name: str) -> TableCell:
    if name not in run.noise:
        return TableCell(MISSING_VALUE, title="not used")
    square = run.innovations.channels.get(name) if run.innovations else None
    return TableCell(format_significant(1e3 * run.noise[name]), format_fixed(square, 2) if square is not None else "")


def _gap_note_texts(load_sources: Sequence[Source[HubLoads]]) -> Iterator[PageBlock]:
    runs = [item for source in load_sources for item in runs_in_time(source.content).items()]
    for name, note in dict.fromkeys((name, note) for name, run in runs for note in run.gap_notes):
        yield Paragraph(f"{name}: {note}.")
