"""Degrees of freedom of the measured noise against which a score is tested.

The variance V of a score is a sum over runs, and within a run over parts of the noise, of which some are known from a
few readings only. With the contribution v_i of a part and the variance var v_i of its estimate, V is as well known as
an estimate with

    2 V^2 / sum var v_i

degrees of freedom (Satterthwaite, Biometrics Bulletin 2 (1946) 110). The noise of the channels of a static run is known
from the rows in which no noise of a load hides it, and in some combinations of channels these are few.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.estimation.likelihood import BatchDerivatives
from balance_cli.estimation.noise_uncertainty import line_uncertainty, noise_uncertainty

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class StaticLines:
    """Derivatives dY (K, c, p) of lines whose noise has parts, and their weighted residual P r (K, c).

    `of_fitted` and `weighted_of_fitted` (K, c, f): dY and P dY of the fitted parameters alone, of which each candidate
    takes all.
    """

    derivatives: ComplexArray
    weighted_residual: ComplexArray
    of_fitted: ComplexArray
    weighted_of_fitted: ComplexArray


@dataclass(frozen=True)
class RunInformation:
    """Half the `gradient` (p,) of chi-square of one run, and parts of its information matrix.

    `cross` (f, p): rows of the fitted parameters; `blocks`: the elements of the diagonal blocks (q, q) of all
    candidates in turn, of which `diagonal` (n,) are on the diagonal. `weighted`: the weighted derivatives P dY (K, c,
    p), and `lines`, kept only where the noise has parts.
    """

    batch: Batch
    gradient: Array
    cross: Array
    blocks: Array
    diagonal: Array
    weighted: ComplexArray | None
    lines: StaticLines | None = None

    @classmethod
    def from_batch(
        cls, batch: Batch, derivatives: BatchDerivatives, fitted: Index, tested: Sequence[Index]
    ) -> RunInformation:
        """Return the information of a batch of one run."""
        blocks, cross = derivatives.diagonal_blocks(tested), derivatives.cross_information(fitted)
        elements = np.concatenate([block.reshape(-1) for block in blocks])
        diagonal = np.concatenate([block.reshape(-1)[:: len(block) + 1] for block in blocks])
        if not batch.runs[0].noise_parts:
            return cls(batch, derivatives.gradient(), cross, elements, diagonal, None)
        of_all, weighted = derivatives.derivatives, derivatives.weighted()
        lines = StaticLines(of_all, derivatives.fit.weighted, of_all[:, :, fitted], weighted[:, :, fitted])
        return cls(batch, derivatives.gradient(), cross, elements, diagonal, weighted, lines)

    def variance(self, fitted: Index, tested: Index, projection: Array) -> Array:
        """Return the run's contribution (n,) to the variance of each score.

        `tested` (n,): parameters of all candidates in turn; `projection` (f, n): change of the fitted ones with them.
        """
        variance = self.diagonal - 2.0 * np.sum(projection * self.cross[:, tested], axis=0)
        variance += np.sum(projection * (self.cross[:, fitted] @ projection), axis=0)
        return np.asarray(np.maximum(variance, 0.0))

    def variance_uncertainty(self, fitted: Index, tested: Index, projection: Array) -> Array:
        """Return the relative variance (n,) of that contribution, since the noise was estimated."""
        if self.weighted is None:
            return np.full(len(tested), 2.0 / self.batch.runs[0].noise_dof)
        return self.uncertainty(self.weighted[:, :, tested] - self.weighted[:, :, fitted] @ projection)

    def uncertainty(self, influence: ComplexArray) -> Array:
        """Return the relative variance (n,) of the estimated variance of n scores, on which `influence` (K, c, n)."""
        return self._by_efficiency(noise_uncertainty(self.batch.runs[0].noise_parts, influence))

    def line_uncertainty(self, influence: ComplexArray) -> Array:
        """Return the same (K,) of the variance of each line alone, with `influence` (K, c)."""
        return self._by_efficiency(line_uncertainty(self.batch.runs[0].noise_parts, influence))

    def _by_efficiency(self, uncertainty: Array) -> Array:
        # The combinations were chosen by an inverse of the same estimate, which costs it that share of its dof.
        return uncertainty / float(self.batch.lines.efficiency[self.batch.runs[0].lines].mean())


def noise_dof(
    runs: Sequence[RunInformation],
    fitted: Index,
    tested: Sequence[Index],
    projections: Sequence[Array],
    min_dof: float,
) -> Array:
    """Return the degrees of freedom (n,) of the noise for each of n candidates, at least `min_dof`.

    Each candidate has parameters `tested` (q,) and a projection (f, q). Its parameters count by their information.
    """
    parameters, projection = np.concatenate(tested), np.hstack(projections)
    variance = np.array([run.variance(fitted, parameters, projection) for run in runs])
    uncertainty = np.array([run.variance_uncertainty(fitted, parameters, projection) for run in runs])
    return np.maximum(pooled_dof(variance, uncertainty, [len(each) for each in tested]), min_dof)


def pooled_dof(variance: Array, uncertainty: Array, lengths: Sequence[int]) -> Array:
    """Return the degrees of freedom (n,) of sums over runs, of which each part is known with its own uncertainty.

    `variance` (r, q): contribution of each run to each parameter; `uncertainty` (r, q): its relative variance. The
    parameters of a candidate follow each other, so many as `lengths` (n,) says. Infinite where no run contributes.
    """
    total = variance.sum(axis=0)
    share = variance / np.where(total > 0.0, total, 1.0)
    edges = np.cumsum([0, *lengths])[:-1]
    by_candidate = np.add.reduceat(share, edges, axis=1)
    spread = np.sum(by_candidate * np.add.reduceat(share * uncertainty, edges, axis=1), axis=0)
    whole = by_candidate.sum(axis=0)
    return np.where(spread > 0.0, 2.0 * whole**2 / np.where(spread > 0.0, spread, 1.0), np.inf)
