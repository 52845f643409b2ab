"""Loads in time: amplitudes that move, and whether the filter that found them is what it takes itself for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from matplotlib.figure import Figure

from balance_cli.reduction.kalman.load_history import LoadTrack
from balance_cli.reduction.result import InTime, Loads, RunLoads
from balance_cli.report.blocks import Block, Cell, Details, Heading, Picture, Row, Section, Table, Text, group_row
from balance_cli.report.figure_style import svg
from balance_cli.report.number_format import NONE, fixed, significant
from balance_cli.report.sources import Source, Sources
from balance_cli.report.track_figures import STRONGEST, track_figure

CONSIDERABLE = 1.25
"""Factor by which NIS may be off one before it is marked: sigma is off by an eighth then."""
WORDS = {
    "harmonics": "harmonics locked to the azimuth beside random loads",
    "random": "random loads",
    "free": "anything within the band",
}


def section(sources: Sources) -> Section | None:
    """Runs reduced by a filter or smoother; None where there are none."""
    having = tuple(source for source in sources.loads if followed(source.content))
    if not having:
        return None
    blocks: list[Block] = [
        Text(
            "A Kalman filter follows loads and balance from sample to sample, a smoother looks at what comes after, "
            "too. Either predicts each sample of each channel from those before it. What it is wrong by, the "
            "innovation, tests it: the normalised innovation squared (NIS) is 1 where the innovations are of the size "
            "that the filter states, and sigma is right then; the whiteness is 1 where nothing in them could have "
            "been foreseen. Chance alone leaves the small figures beside them."
        ),
        tests_table(having),
        *_pictures(having),
        *(channels_table(source) for source in having),
        *_bridged(having),
    ]
    return Section("in-time", "Loads in time", tuple(blocks))


def followed(loads: Loads) -> dict[str, InTime]:
    """The runs that were reduced in time."""
    return {name: run.in_time for name, run in loads.runs.items() if run.in_time is not None}


def tests_table(having: Sequence[Source[Loads]]) -> Table:
    """NIS and whiteness of every run and method."""
    head = ("", "NIS", "whiteness", "rms autocorrelation", "samples")
    rows: list[Row] = []
    for source in having:
        runs = followed(source.content)
        for words in dict.fromkeys(_how(run) for run in runs.values()):
            rows.append(group_row(f"{source.label}: {words}", len(head)))
            rows += [_tests_row(name, run) for name, run in runs.items() if _how(run) == words]
    caption = (
        "Innovations of all channels together; small: one standard deviation that chance gives it. Marked: NIS off by "
        f"more than a factor of {CONSIDERABLE:g}."
    )
    return Table(caption, (tuple(Cell(text) for text in head),), tuple(rows))


def _how(run: InTime) -> str:
    lag = f", each sample given {significant(run.lag, 2)} s after it" if run.lag is not None else ""
    return f"loads taken as {WORDS.get(run.loads_as, run.loads_as)}{lag}"


def _tests_row(name: str, run: InTime) -> Row:
    tests = run.innovations
    if tests is None:
        return (Cell(name, mark="name"), Cell(NONE, title="no stretch of the record has all channels"))
    off = max(tests.nis, 1.0 / tests.nis) if tests.nis > 0 else np.inf
    return (
        Cell(name, mark="name"),
        Cell(fixed(tests.nis, 3), fixed(tests.nis_sigma, 3), "bad" if off > CONSIDERABLE else ""),
        Cell(significant(tests.whiteness), significant(tests.whiteness_sigma, 1)),
        Cell(significant(float(np.sqrt(tests.whiteness / tests.samples)), 2)),
        Cell(str(tests.samples)),
    )


def _pictures(having: Sequence[Source[Loads]]) -> Iterator[Block]:
    """The first run of the first method, the others on demand."""
    first = True
    for source, run, track in _tracks(having):
        words = f"{run.run} by {source.label}"
        name = f"in-time-{having.index(source) + 1}-{run.run}"
        picture = Picture(
            name,
            f"{words}. Above: mean of each revolution, with one sigma of the load at an instant; below: amplitudes of "
            f"the {STRONGEST} strongest harmonics of each component, less their means, which stand beside their names, "
            "with one sigma. Dashed: the steady part, over which the table is averaged.",
            svg(name, f"Mean loads and amplitudes over time, {words}", _drawing(run, track)),
        )
        if first:
            yield Heading("Loads from revolution to revolution")
        yield picture if first else Details(words, (picture,))
        first = False


def _drawing(run: RunLoads, track: LoadTrack) -> Callable[[], Figure]:
    return lambda: track_figure(run, track)


def _tracks(having: Sequence[Source[Loads]]) -> Iterator[tuple[Source[Loads], RunLoads, LoadTrack]]:
    for source in having:
        for run in source.content.runs.values():
            if run.in_time is not None and run.in_time.track is not None:
                yield source, run, run.in_time.track


def channels_table(source: Source[Loads]) -> Table:
    """Noise of each channel and the mean square of its innovations, run by run."""
    runs = followed(source.content)
    names = dict.fromkeys(name for run in runs.values() for name in run.noise)
    head = (Cell(""), *(Cell(name) for name in runs))
    rows = [(Cell(name, mark="name"), *(_channel_cell(run, name) for run in runs.values())) for name in names]
    caption = (
        f"{source.label}: noise of a sample of each channel [mV], from where no load reaches; small: mean square of "
        "its innovations, 1 where they are of the size that the filter states."
    )
    return Table(caption, (head,), tuple(rows))


def _channel_cell(run: InTime, name: str) -> Cell:
    if name not in run.noise:
        return Cell(NONE, title="not used")
    square = run.innovations.channels.get(name) if run.innovations else None
    return Cell(significant(1e3 * run.noise[name]), fixed(square, 2) if square is not None else "")


def _bridged(having: Sequence[Source[Loads]]) -> Iterator[Block]:
    runs = [item for source in having for item in followed(source.content).items()]
    for name, note in dict.fromkeys((name, note) for name, run in runs for note in run.bridged):
        yield Text(f"{name}: {note}.")
