"""How well the noise is known that a score is judged by.

A score's variance V is a sum over runs, and of a run's noise over parts of which some are known from a few readings
only. With v_i what a part gives to V and var v_i the doubt about it, V is as good as an estimate with

    2 V^2 / sum var v_i

degrees of freedom (Satterthwaite, Biometrics Bulletin 2 (1946) 110).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.likelihood import BatchDerivatives
from balance_cli.estimation.measurements import Batch

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

MIN_SCORE_NOISE_DOF = 1.0
"""Of a noise of which nothing is known: against F with so many no gain says much."""


@dataclass(frozen=True)
class RunInformation:
    """What one run tells: half the `gradient` (p,) of chi-square, and of its information rows `cross` (f, p) for the

    fitted parameters and `blocks` (q, q) for those of each candidate.
    `weighted`: the slopes P dY (K, c, p), kept where the noise has parts.
    """

    batch: Batch
    gradient: Array
    cross: Array
    blocks: tuple[Array, ...]
    weighted: ComplexArray | None

    @classmethod
    def from_batch(cls, batch: Batch, slopes: BatchDerivatives, fitted: Index, own: Sequence[Index]) -> RunInformation:
        """Of a batch of one run."""
        weighted = slopes.weighted()
        blocks = tuple(slopes.diagonal_blocks(weighted, own))
        cross = slopes.information(weighted, fitted, slice(None))
        return cls(batch, slopes.gradient(), cross, blocks, weighted if batch.noise_parts[0] else None)

    def variance(self, fitted: Index, tested: Index, projection: Array) -> Array:
        """What the run gives to the variance (n,) of each score, whose parameters take `along` (f, n) with them.

        `tested` (n,): the parameters of all candidates in turn.
        """
        diagonal = np.concatenate([np.diag(block) for block in self.blocks])
        own = diagonal - 2.0 * np.sum(projection * self.cross[:, tested], axis=0)
        return np.asarray(np.maximum(own + np.sum(projection * (self.cross[:, fitted] @ projection), axis=0), 0.0))

    def variance_uncertainty(self, fitted: Index, tested: Index, projection: Array) -> Array:
        """The relative variance (n,) of that, as the noise was estimated."""
        parts = self.batch.noise_parts[0]
        if self.weighted is None:
            return np.full(len(tested), 2.0 / self.batch.noise_dof[0])
        influence = self.weighted[:, :, tested] - self.weighted[:, :, fitted] @ projection
        power = np.array([_weighted_power(influence, part.shape, part.share) for part in parts])
        size, error = (np.array([getattr(part, name) for part in parts]) for name in ("size", "error"))
        whole = np.maximum(size @ power, np.finfo(float).tiny)
        return np.asarray(np.sum((error[:, None] * power / whole) ** 2, axis=0))


def _weighted_power(influence: ComplexArray, shape: Array, share: Array) -> Array:
    """Sum of share (k,) g* shape g over the lines of an influence (k, c, n): (n,)."""
    felt = np.einsum("cd,kdn->kcn", shape, influence)
    return np.asarray(np.einsum("k,kcn,kcn->n", share, influence.conj(), felt, optimize=True).real)


def noise_dof(
    runs: Sequence[RunInformation], fitted: Index, own: Sequence[Index], projection: Sequence[Array]
) -> Array:
    """Degrees of freedom (n,) of the noise for each of n candidates with parameters `own` (q,), `along` (f, q).

    The parameters of one candidate count alike, each by what it tells.
    """
    tested, joined = np.concatenate(own), np.hstack(projection)
    variance = np.array([run.variance(fitted, tested, joined) for run in runs])
    variance_uncertainty = np.array([run.variance_uncertainty(fitted, tested, joined) for run in runs])
    whole = variance.sum(axis=0)
    share = variance / np.where(whole > 0.0, whole, 1.0)
    edges = np.cumsum([0, *(len(each) for each in own)])[:-1]
    gathered = np.add.reduceat(share, edges, axis=1)
    spread = np.sum(gathered * np.add.reduceat(share * variance_uncertainty, edges, axis=1), axis=0)
    total = gathered.sum(axis=0)
    found = np.where(spread > 0.0, 2.0 * total**2 / np.where(spread > 0.0, spread, 1.0), np.inf)
    return np.asarray(np.maximum(found, MIN_SCORE_NOISE_DOF))
