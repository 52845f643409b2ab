"""Channels that read nothing of what the loads make in a run: a cable that came off, or an input that was not recorded.

Their noise keeps them from being dead by their samples alone, and a fit bends the whole rig to explain one of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.consistency.evidence import Evidence, with_references, zero_where_missing
from balance_cli.diagnosis.consistency.findings import FAULT, SILENT_CHANNEL, ConsistencyFinding
from balance_cli.diagnosis.consistency.residuals import SIGNIFICANT, residual_weights

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

LARGEST_FACTOR = 0.03
"""Of what the loads make, that a silent channel still follows. A gain of 0.001 (volts for millivolts) is silent only
where the noise hides it."""
LARGEST_SHARE = 0.1
"""Of the predicted sum of squares, that the noise of a silent channel has at the lines of the response."""
NOISE_SHARE = 2.0
"""Times what a silent channel follows of the loads, the rest of what it reads has at least, or it has a small gain."""


def silent_channels(
    runs: Sequence[Evidence], names: Sequence[str]
) -> tuple[list[ConsistencyFinding], Sequence[Evidence]]:
    """Return a finding for each channel that is silent in some runs, and the runs without these channels."""
    silent, expected = (np.array(part) for part in zip(*map(_silent_and_expected, runs), strict=True))
    if not silent.any():
        return [], runs
    findings = list(_describe(runs, names, silent, expected))
    heard = [
        replace(run, forces=np.where(missing, np.nan, run.forces)) for run, missing in zip(runs, silent, strict=True)
    ]
    return findings, with_references(heard)


def _describe(
    runs: Sequence[Evidence], names: Sequence[str], silent: Bools, expected: Bools
) -> Iterator[ConsistencyFinding]:
    """A finding for each channel that is `silent` (r, c) in a run, or in all runs in which it is `expected`."""
    for i in map(int, np.flatnonzero(silent.any(axis=0))):
        shown = tuple(run.run for run, is_silent in zip(runs, silent[:, i], strict=True) if is_silent)
        everywhere = bool(np.all(silent[:, i] | ~expected[:, i]))
        text = f"{names[i]} reads nothing of what the loads make: disconnected, or another input?"
        yield ConsistencyFinding(SILENT_CHANNEL, FAULT, text, shown, everywhere, channels=(names[i],))


def _silent_and_expected(run: Evidence) -> tuple[Bools, Bools]:
    """Whether channels (c,) of a run are silent, and whether their reading is expected to be well above any error."""
    by_geometry, by_runs = run.predicted
    weights = residual_weights(run)
    silent, expected = np.zeros((2, run.forces.shape[1]), bool)
    for forces, predicted, error in (
        (run.forces[run.low], by_geometry, weights.geometry),
        (run.forces, by_runs, weights.runs),
    ):
        known = np.isfinite(forces) & np.isfinite(predicted)
        read, made = (zero_where_missing(np.where(known, part, np.nan)) for part in (forces, predicted))
        power = np.sum(np.abs(made) ** 2, axis=0)
        is_strong = power > SIGNIFICANT * error**2
        product = np.abs(np.sum(made.conj() * read, axis=0))
        total = np.sum(np.abs(read) ** 2, axis=0)
        followed = product**2 / np.maximum(power, np.finfo(float).tiny)
        is_quiet = (product < LARGEST_FACTOR * power) & (total < LARGEST_SHARE * power)
        expected |= is_strong
        silent |= is_strong & is_quiet & (total > (1.0 + NOISE_SHARE) * followed)
    return silent, expected
