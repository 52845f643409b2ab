"""The first screen: the hub loads of each run, which method they come from, and whether to use them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.reduction.choices import FREQUENCIES
from balance_cli.reduction.flags import NOT_MEASURED, SEPARATOR, TRUSTED, trust_text, trust_word
from balance_cli.reduction.polar import polar_sigma
from balance_cli.reduction.result import HubLoads, RunLoads
from balance_cli.reduction.run_verdict import DO_NOT_USE, USE, run_verdict
from balance_cli.report.blocks import Card, CardGrid, PageBlock, Paragraph, Row, TableCell
from balance_cli.report.number_format import MISSING_VALUE, value_and_sigma_text
from balance_cli.report.recommendation import reason_sentence, recommend
from balance_cli.report.run_index import run_index
from balance_cli.report.sources import Source

MOST_CARDS = 6
"""Runs whose loads stand on the first screen; where there are more, all are in the index below it."""
MOST_MULTIPLES = 2
"""Multiples of the blade harmonic that are shown; the table of all harmonics is below."""
MOST_TONES = 3
"""Of loads at given frequencies, those that are shown."""
CARD_MARKS = {USE: "good", DO_NOT_USE: "bad"}
TRUST_MARKS = {TRUSTED: "good", "contradicted": "bad"}


def answer_blocks(sources: Sequence[Source[HubLoads]]) -> Iterator[PageBlock]:
    """Yield the recommended method, a card of loads for each run, and an index of all runs where there are many."""
    if not sources:
        return
    recommendations = recommend(sources)
    shown = [(item.source, run) for item in recommendations for run in item.runs.values()]
    for recommendation in recommendations:
        yield Paragraph(reason_sentence(recommendation, sources), "lead")
    yield CardGrid(tuple(_card(source, run) for source, run in shown[:MOST_CARDS]))
    if len(shown) > MOST_CARDS:
        yield run_index(recommendations)


def shown_rows(loads: HubLoads, run: RunLoads) -> tuple[int, ...]:
    """Return the harmonics of the first screen: mean, 1/rev and the blade harmonics that were reduced."""
    last = len(run.frequency_hz) - 1
    if loads.method == FREQUENCIES:
        return tuple(range(min(last, MOST_TONES) + 1))
    blades = loads.geometry.rotor.blades if loads.geometry.rotor else 0
    multiples = range(blades, last + 1, blades) if blades else range(2, last + 1)
    return tuple(dict.fromkeys(n for n in (0, 1, *list(multiples)[:MOST_MULTIPLES]) if n <= last))


def row_name(loads: HubLoads, run: RunLoads, n: int) -> str:
    """Return the heading of harmonic n, or of tone n of loads at given frequencies."""
    if n == 0:
        return "mean"
    return f"{run.frequency_hz[n]:.5g} Hz" if loads.method == FREQUENCIES else f"{n}/rev"


def _card(source: Source[HubLoads], run: RunLoads) -> Card:
    loads = source.content
    verdict = run_verdict(run)
    rows = shown_rows(loads, run)
    head = (TableCell(""), *(TableCell(row_name(loads, run, n)) for n in rows), TableCell("trust", mark="text"))
    sigma = _amplitude_sigma(run)
    body = tuple(_component_row(loads, run, m, rows, sigma) for m in _component_order(run))
    speed = f"1/rev {run.frequency_hz[1]:.4g} Hz, " if len(run.frequency_hz) > 1 and loads.method != FREQUENCIES else ""
    interval = f"{speed}{run.interval[0]:.1f} to {run.interval[1]:.1f} s, {source.label}"
    return Card(run.run, interval, verdict.word, CARD_MARKS.get(verdict.word, "care"), verdict.sentence, (head,), body)


def _component_order(run: RunLoads) -> list[int]:
    known = [run.components.index(name) for name in COMPONENTS if name in run.components]
    return known + [m for m, name in enumerate(run.components) if name not in COMPONENTS]


def _amplitude_sigma(run: RunLoads) -> NDArray[np.float64]:
    return polar_sigma(run.amplitude, run.sigma_cosine, run.sigma_sine)[0]


def _component_row(loads: HubLoads, run: RunLoads, m: int, rows: Sequence[int], sigma: NDArray[np.float64]) -> Row:
    name = run.components[m]
    cells = [TableCell(name, UNIT_OF.get(name, ""), "name"), *(_load_cell(run, n, m, float(sigma[n, m])) for n in rows)]
    return (*cells, trust_cell(loads, run, m, rows))


def _load_cell(run: RunLoads, n: int, m: int, sigma: float) -> TableCell:
    flags = run.flags[n][m]
    if NOT_MEASURED in flags.split(SEPARATOR):
        return TableCell(MISSING_VALUE, title=flags)
    amplitude = complex(run.amplitude[n, m])
    size, spread = (abs(amplitude), sigma) if n else (amplitude.real, float(run.sigma_cosine[n, m]))
    value, spread_text = value_and_sigma_text(size, spread)
    mark = "bad" if trust_word(flags) in ("contradicted", "doubtful") else ""
    return TableCell(value, f"\N{PLUS-MINUS SIGN} {spread_text}", mark, title=flags)


def trust_cell(loads: HubLoads, run: RunLoads, m: int, rows: Sequence[int]) -> TableCell:
    """Return the trust in one component: the phrase that holds for most rows, and in small print the exceptions."""
    groups: dict[str, list[str]] = {}
    for n in rows:
        groups.setdefault(trust_text(run.flags[n][m]), []).append(row_name(loads, run, n))
    words = [trust_word(run.flags[n][m]) for n in rows]
    mark = TRUST_MARKS.get(words[0], "") if len(set(words)) == 1 else "bad" if "contradicted" in words else ""
    most = max(groups, key=lambda phrase: len(groups[phrase]))
    exceptions = [f"{', '.join(names)}: {phrase}" for phrase, names in groups.items() if phrase != most]
    full = "; ".join(f"{', '.join(names)}: {phrase}" for phrase, names in groups.items())
    return TableCell(most, "; ".join(exceptions), f"text {mark}".strip(), title=full)
