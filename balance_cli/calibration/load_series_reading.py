"""The load series of all runs, as their files state them or as the readings tell them.

Where the loads leave open to which of two load series a tare point belongs, each possible reading of the schedule is
fitted, with a zero for each series, and the one with the least misfit is taken. The misfits are compared robustly, so
that an outlier does not decide.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.load_series import (
    EACH_CLOSING,
    EACH_RETURN,
    EACH_SIGN,
    EACH_TARE,
    MIN_LOAD_CHANGE,
    SPLIT_FIRST,
    SPLIT_LAST,
    TARE_FIRST,
    TARE_LAST,
    TARE_POSITIONS,
    determines_loads,
    intruding_rows,
    split_rows,
)
from balance_cli.calibration.load_series_score import ReadingScore, ScheduleRows
from balance_cli.calibration.misplaced_loads import find_misplaced_loads

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

DECISIVE_SCORE_DIFFERENCE = 10.0
"""Difference of the Bayesian information criterion that is very strong evidence (Kass and Raftery, JASA 90, 1995)."""

_POSITION_WORDS = {
    TARE_LAST: "a tare point between two load series closes the earlier one",
    TARE_FIRST: "a tare point between two load series opens the later one",
    SPLIT_LAST: "load series open and close with a tare point",
    SPLIT_FIRST: "load series open and close with a tare point",
    EACH_TARE: "each return to the tare opens a load series",
    EACH_RETURN: "each return to the tare opens a load series",
    EACH_CLOSING: "each return to the tare closes a load series",
    EACH_SIGN: "each change of sign opens a load series",
}
_SPLIT_DIRECTIONS = (EACH_SIGN, EACH_RETURN, EACH_CLOSING)
"""Readings by which the two directions of a load are two series."""


@dataclass(frozen=True)
class SeriesReading:
    """Number (m,) of the load series of each row, and how it was found, in words.

    `misplaced`: rows whose loads stand in each other's row, or have the wrong sign; the series are those without it.
    """

    load_series: Index
    notes: tuple[str, ...]
    misplaced: tuple[int, ...] = ()


@dataclass(frozen=True)
class _Candidate:
    """One reading of the rows of a segment: position of the tare points, and number (r,) of the series of each row."""

    position: str
    local: Index


def read_load_series(rows: ScheduleRows) -> SeriesReading:
    """Find the load series of all rows: stated ones as they are, the others by the reading that fits best.

    A row that is not used belongs to the load series of the used row before it.
    """
    at = np.flatnonzero(rows.used)
    if len(at) == 0:
        return SeriesReading(np.unique(rows.segment, return_inverse=True)[1].astype(np.intp), ())
    used = ScheduleRows(
        x=rows.x[at],
        channels=rows.channels[at],
        segment=rows.segment[at],
        run=rows.run[at],
        run_names=rows.run_names,
        stated=tuple(rows.stated[row] for row in at.tolist()),
        tare=rows.tare[at],
        used=np.ones(len(at), bool),
    )
    misplaced = find_misplaced_loads(used)
    reading = _read_used_rows(used if misplaced is None else replace(used, x=misplaced.x))
    before = np.clip(np.searchsorted(at, np.arange(len(rows.x)), side="right") - 1, 0, None)
    misplaced_rows = () if misplaced is None else tuple(at[list(misplaced.rows)].tolist())
    return SeriesReading(reading.load_series[before], reading.notes, misplaced_rows)


def _read_used_rows(rows: ScheduleRows) -> SeriesReading:
    by_segment = {
        number: _candidates(rows, np.flatnonzero(rows.segment == number)) for number in np.unique(rows.segment).tolist()
    }
    selection = {number: candidates[0] for number, candidates in by_segment.items()}
    open_segments = [number for number, candidates in by_segment.items() if len(candidates) > 1]
    decided: dict[int, float] = {}
    if open_segments:
        selection, decided = _choose_readings(rows, by_segment, selection)
    load_series = _number_series(rows, selection)
    if not any(rows.stated) and not determines_loads(
        rows.x[rows.used], load_series[rows.used], rows.segment[rows.used]
    ):
        return SeriesReading(np.unique(rows.segment, return_inverse=True)[1].astype(np.intp), ())
    return SeriesReading(load_series, tuple(_reading_notes(rows, selection, open_segments, decided)))


def _candidates(rows: ScheduleRows, at: Index) -> list[_Candidate]:
    """Readings of the rows `at` of one segment, those that are equal only once, the default first."""
    stated = [rows.stated[row] for row in at.tolist()]
    if all(stated):
        numbers = {label: number for number, label in enumerate(dict.fromkeys(stated))}
        return [_Candidate("stated", np.array([numbers[label] for label in stated], np.intp))]
    x, tare = rows.x[at], rows.tare[at]
    inner_tares = np.any(tare[1:] & ~tare[:-1])
    if inner_tares:
        positions = [each for each in TARE_POSITIONS if each not in (EACH_TARE, *_SPLIT_DIRECTIONS)]
        by_tares = [(position, _split_at_tares(tare, position)) for position in positions]
        readings = [(position, _split_at_changes(x, local)) for position, local in by_tares] + by_tares
    else:
        readings = [(position, split_rows(x, position)) for position in TARE_POSITIONS]
    regular = _readings_without(x, ~intruding_rows(x)) if not inner_tares else []
    default = dict(regular or readings)[_default_position(x)]
    readings += regular
    different: list[_Candidate] = []
    for position, local in readings:
        if not any(np.array_equal(local, other.local) for other in different):
            different.append(_Candidate(position, local))
    return sorted(different, key=lambda candidate: not np.array_equal(candidate.local, default))


def _readings_without(x: Array, regular: Mask) -> list[tuple[str, Index]]:
    """Readings of the regular rows (r,) alone, to whose load series the others are assigned."""
    if regular.all() or np.count_nonzero(regular) < 2:
        return []
    return [(position, _assign_others(x, regular, split_rows(x[regular], position))) for position in TARE_POSITIONS]


def _assign_others(x: Array, regular: Mask, local: Index) -> Index:
    """Series (r,) of all rows, from those of the regular ones: of the regular row before or, by its loads, after it."""
    active = np.abs(x - x[0]) > MIN_LOAD_CHANGE
    loads = [active[regular][local == number].any(axis=0) for number in range(int(local.max()) + 1)]
    before = local[np.clip(np.cumsum(regular) - 1, 0, None)]
    after = local[np.clip(np.cumsum(regular), None, len(local) - 1)]
    series = np.array(before, np.intp)
    for row in np.flatnonzero(~regular).tolist():
        own = active[row]
        if not np.all(loads[before[row]][own]) and np.all(loads[after[row]][own]):
            series[row] = after[row]
    return series


def _default_position(x: Array) -> str:
    """The most plausible position of the tare points, from the first and the last row of a segment."""
    unloaded = np.all(np.abs(x) <= MIN_LOAD_CHANGE, axis=1)
    return SPLIT_FIRST if unloaded[0] and not unloaded[-1] else SPLIT_LAST


def _split_at_tares(tare: Mask, position: str) -> Index:
    """Number (r,) from 0 of the load series of each row, where the tare points (r,) are stated."""
    opens = np.flatnonzero(tare & ~np.r_[False, tare[:-1]])
    ends = np.flatnonzero(tare & ~np.r_[tare[1:], False])
    if position == TARE_LAST:
        starts = ends + 1
    elif position == TARE_FIRST:
        starts = opens
    else:
        alone = opens + 1 if position == SPLIT_LAST else opens
        starts = np.where(ends > opens, ends, alone)
    inner = starts[(starts > 0) & (starts < len(tare))]
    return np.asarray(np.searchsorted(inner, np.arange(len(tare)), side="right"), np.intp)


def _split_at_changes(x: Array, local: Index) -> Index:
    """Number (r,) of series that also end where no load goes on to the next row: a tare point may be missing there."""
    direction = np.where(np.abs(x) > MIN_LOAD_CHANGE, np.sign(x), 0.0)
    is_loaded = np.any(direction != 0, axis=1)
    goes_on = np.any((direction[1:] == direction[:-1]) & (direction[1:] != 0), axis=1)
    ends = (local[1:] != local[:-1]) | (is_loaded[1:] & is_loaded[:-1] & ~goes_on)
    return np.asarray(np.r_[0, np.cumsum(ends)], np.intp)


def _number_series(rows: ScheduleRows, selection: dict[int, _Candidate]) -> Index:
    """Number (m,) of the load series of each row, counted over all segments."""
    load_series, first = np.zeros(len(rows.x), np.intp), 0
    for number, candidate in selection.items():
        load_series[rows.segment == number] = first + candidate.local
        first += int(candidate.local.max()) + 1
    return load_series


def _choose_readings(
    rows: ScheduleRows, by_segment: dict[int, list[_Candidate]], default: dict[int, _Candidate]
) -> tuple[dict[int, _Candidate], dict[int, float]]:
    """Choose the reading of each segment: first one position for all, then segment by segment.

    Also returns by how much the score of the next best reading of a segment is worse, where that is decisive.
    """
    common = [default]
    for position in TARE_POSITIONS:
        common.append(
            {
                number: next((each for each in reversed(candidates) if each.position == position), candidates[0])
                for number, candidates in by_segment.items()
            }
        )
    numbered = [_number_series(rows, choice) for choice in common]
    scorer = ReadingScore(rows, numbered)
    scores = [scorer.score(series) for series in numbered]
    split = range(len(scores) - len(_SPLIT_DIRECTIONS), len(scores))
    unsplit = numbered[int(np.argmin(scores[: split.start]))]
    for place in split:
        scores[place] = scores[place] if scorer.is_general(unsplit, numbered[place]) else float("inf")
    best = int(np.argmin(scores))
    selection = common[best] if scores[best] < scores[0] - DECISIVE_SCORE_DIFFERENCE else default
    decided: dict[int, float] = {}
    for number, possible in by_segment.items():
        # A wrong gain in one segment resembles a shifted zero between its two directions: all segments must show it.
        candidates = [each for each in possible if each.position not in _SPLIT_DIRECTIONS or each is selection[number]]
        if len(candidates) < 2:
            continue
        alone = np.array([scorer.score(_number_series(rows, {**selection, number: each})) for each in candidates])
        order = np.argsort(alone)
        taken = next(i for i, each in enumerate(candidates) if each is selection[number])
        if alone[order[0]] < alone[taken] - DECISIVE_SCORE_DIFFERENCE:
            taken = int(order[0])
            selection = {**selection, number: candidates[taken]}
        margin = float(np.min(np.delete(alone, taken)) - alone[taken])
        if margin > DECISIVE_SCORE_DIFFERENCE:
            decided[number] = margin
    return selection, decided


def _reading_notes(
    rows: ScheduleRows, selection: dict[int, _Candidate], open_segments: Sequence[int], decided: dict[int, float]
) -> Iterator[str]:
    """How the tare points were read, for each run in which that was open."""
    runs: dict[tuple[str, str], list[str]] = {}
    for number in open_segments:
        name = rows.run_names[rows.run[np.argmax(rows.segment == number)]]
        how = "the readings decide it" if number in decided else "the zeros differ too little to decide it"
        names = runs.setdefault((_POSITION_WORDS[selection[number].position], how), [])
        names += [] if name in names else [name]
    for (words, how), names in runs.items():
        yield f"{', '.join(names)}: {words}; {how}"
