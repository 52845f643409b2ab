"""Which channels may have been exchanged: proportional ones, unless geometry or their partners contradict it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.consistency.evidence import Evidence, correlated_channels
from balance_cli.diagnosis.consistency.residuals import REMAINING_SHARE, SIGNIFICANT, Weights

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Exchanges:
    """Pairs (c, c) of channels: proportional, and those of which the exchange may be accepted by itself."""

    correlated: Bools
    possible: Bools


@dataclass(frozen=True)
class RunExchanges:
    """Pairs (c, c) of channels of one run: proportional; not worse, and nearly perfect, once exchanged."""

    correlated: Bools
    allowed: Bools
    explained: Bools


def find_exchanges(run: Evidence, weights: Weights, energy: Array) -> RunExchanges:
    """Return which channels may have been exchanged in a run with these energies (2 c + p,) of its residuals."""
    after, before = _energy_of_exchanged(run, weights), _energy_of_channels(run, energy)
    before = before[:, None] + before
    return RunExchanges(correlated_channels(run), after <= before + SIGNIFICANT, after <= REMAINING_SHARE * before)


def exchanges_in_all(runs: Sequence[RunExchanges]) -> Exchanges:
    """Return which channels may have been exchanged in all these runs: a quick test before each is tried.

    They are proportional in one of the runs, and two of them allow it: exchanges that fewer runs allow are never
    accepted. In one run alone the exchange must explain nearly all.
    """
    correlated = np.any([run.correlated for run in runs], axis=0)
    allowed = np.sum([run.allowed for run in runs], axis=0) >= 2 if len(runs) > 1 else runs[0].explained
    return Exchanges(correlated, np.asarray(correlated & allowed))


def _energy_of_exchanged(run: Evidence, weights: Weights) -> Array:
    """Return the squared residuals (c, c) of two exchanged channels by the geometry and by their partners."""
    computed, volts = run.predicted[0], run.forces * run.gains
    after = _squared_differences(volts[run.low], run.gains[run.low], computed) / weights.geometry**2
    for channels in (np.array(run.pairs, int).reshape(-1, 2), np.array(run.pairs, int).reshape(-1, 2)[:, ::-1]):
        first, second = channels.T
        by_pair = _squared_differences(volts, run.gains[:, first], run.forces[:, second]) / weights.pairs[:, None] ** 2
        by_pair[np.arange(len(first)), second] = 0.0  # of two channels of a cell their difference remains
        np.add.at(after, first, by_pair)
    return np.asarray(after + after.T)


def _squared_differences(volts: ComplexArray, gains: ComplexArray, forces: ComplexArray) -> Array:
    """Return the sums of squares (m, c) of forces (k, m) less the volts (k, c) over gains (k, m); 0 where unknown.

    The square is expanded, so that all combinations are two products of matrices.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / gains
        power = (np.abs(inverse) ** 2).T @ np.abs(volts) ** 2
        product = ((forces.conj() * inverse).T @ volts).real
        total = power - 2.0 * product + np.sum(np.abs(forces) ** 2, axis=0)[:, None]
    return np.where(np.isfinite(total), np.maximum(total, 0.0), 0.0)


def _energy_of_channels(run: Evidence, energy: Array) -> Array:
    """Return the squared residuals (c,) of every kind in which a channel takes part."""
    c = run.forces.shape[1]
    total = energy[:c] + energy[c : 2 * c]
    for pair, value in zip(run.pairs, energy[2 * c :], strict=True):
        total[list(pair)] += value
    return np.asarray(total)
