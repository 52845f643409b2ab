"""Residuals of a run against the predictions of its forces, weighted by what is usual."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.consistency.evidence import Evidence, predictions, zero_where_missing

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Bools = NDArray[np.bool_]

CHANNEL_ERROR = 0.01
"""Relative difference of two channels of a cell, and of two runs, that is usual: sensitivities and amplitudes."""
CHECK_ERROR = 0.3
"""Relative error of a response from sweeps at the lines of a check run: bands are as wide as half of a mode, few lines
near a mode decide, and the rotor turns. Signs, units and exchanges are seen nevertheless."""
LEAST_CHECK_ERROR = 0.1
"""The same where the run itself shows that most of its channels are as the sweeps predict."""
CHANNELS_ALIKE = 3.0
"""Error that is usual for any channel of a check run over that of its median channel."""
SIGNIFICANT = 9.0
"""Sum of squares of a column of residuals from which it contradicts: three times the usual error."""
REMAINING_SHARE = 0.05
"""Of the sum of squares of all columns that a mistake concerns: what may remain once it is undone."""
NEGLIGIBLE_ENERGY = 1e-4
"""Of the strongest channel of a run: below it (1 % in amplitude) the pair of a channel is not compared."""


@dataclass(frozen=True)
class Residuals:
    """Weighted residuals of a run: by the geometry (l, c), by other runs (k, c), of pairs of channels (k, p).

    Each is divided by its usual error, so that a column with a sum of squares below 9 is as good as can be expected.
    """

    geometry: ComplexArray
    runs: ComplexArray
    pairs: ComplexArray

    @property
    def energy(self) -> Array:
        """Sums of squares of all columns, (2 c + p,)."""
        parts = (self.geometry, self.runs, self.pairs)
        return np.concatenate([np.einsum("kc,kc->c", part, part.conj()).real for part in parts])

    def with_weights(self, weights: Weights) -> Residuals:
        """Return the residuals without those that these weights do not compare."""
        runs = self.runs if np.isfinite(weights.runs) else np.zeros_like(self.runs)
        return Residuals(self.geometry, runs, np.where(np.isfinite(weights.pairs), self.pairs, 0.0))

    @property
    def vector(self) -> ComplexArray:
        """All residuals in one vector."""
        return np.concatenate([self.geometry.ravel(), self.runs.ravel(), self.pairs.ravel()])


@dataclass(frozen=True)
class Weights:
    """Divisors of the residuals of a run: scalars for geometry and runs, (p,) for pairs; infinite: not compared."""

    geometry: float
    runs: float
    pairs: Array


def residual_weights(run: Evidence) -> Weights:
    """Return what the residuals of a run are divided by, from what is predicted for its recorded loads."""
    by_runs = np.where(np.isfinite(run.forces), run.predicted[1], np.nan)
    size = _size(by_runs)
    energy = np.nansum(np.abs(run.forces) ** 2, axis=0)
    # Where the forces of summed cells cancel, the errors of their stiffness do not.
    return Weights(
        run.geometry_error * _size(run.predicted_parts[:, _has_channels(run.forces)]),
        size * (CHANNEL_ERROR if run.rows.kind == "sweep" else _check_error(run.forces - by_runs, size)),
        CHANNEL_ERROR * np.sqrt(_pair_energies(energy, run.pairs)),
    )


def _check_error(difference: ComplexArray, size: float) -> float:
    """Return the relative error of the responses of a check run, by its median channel, from (k, c) differences.

    Two exchanged channels among six, or a reversed one, leave the others as they are.
    """
    known = ~np.isnan(difference).all(axis=0)
    if not known.any():
        return CHECK_ERROR
    median = float(np.sqrt(np.median(np.nansum(np.abs(difference[:, known]) ** 2, axis=0)))) / size
    return float(np.clip(CHANNELS_ALIKE * median, LEAST_CHECK_ERROR, CHECK_ERROR))


def _has_channels(forces: ComplexArray) -> Bools:
    return np.asarray(np.isfinite(forces).all(axis=0))


def _size(predicted: ComplexArray | Array) -> float:
    """Return the root of the summed squares of a channel of average size; infinite where nothing is predicted."""
    per_channel = np.nansum(np.abs(predicted) ** 2, axis=0)
    strong = per_channel[per_channel > 0]
    return float(np.sqrt(strong.mean())) if len(strong) else np.inf


def _pair_energies(energy: Array, pairs: tuple[tuple[int, int], ...]) -> Array:
    """Return the smaller energy of the channels of each pair; infinite where that is next to none, or one is absent.

    The strongest channel is found among the smaller ones of pairs and those without a pair, so that one channel in
    another unit does not silence the others.
    """
    smaller = np.array([min(energy[first], energy[second]) for first, second in pairs])
    single = np.delete(energy, sorted({index for pair in pairs for index in pair}))
    strongest = np.concatenate([smaller, single]).max(initial=0.0)
    return np.where(smaller > NEGLIGIBLE_ENERGY * strongest, smaller, np.inf)


def residuals(run: Evidence, forces: ComplexArray, loads: ComplexArray, weights: Weights) -> Residuals:
    """Return the residuals of a run whose true forces (k, c) and loads (k, 6) are these."""
    # Most mistakes leave the loads as they are.
    by_geometry, by_runs = run.predicted if loads is run.loads else predictions(run, loads)
    first, second = np.array(run.pairs, int).reshape(-1, 2).T
    with np.errstate(invalid="ignore"):
        pairs = (forces[:, second] - forces[:, first]) / weights.pairs
    return Residuals(
        zero_where_missing((forces[run.low] - by_geometry) / weights.geometry),
        zero_where_missing((forces - by_runs) / weights.runs),
        zero_where_missing(pairs),
    )
