"""Gains and covariances of the steady-state Kalman filter and smoother of a sampled model.

Anderson and Moore, Optimal Filtering, 1979, chapters 4 and 7; de Jong, J. Am. Stat. Assoc. 84, 1989, 1085.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman.discretization import SampledModel
from balance_cli.reduction.kalman.riccati import discrete_gramian, inverse_sum, positive_root, steady_covariance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SteadyMatrices:
    """Steady matrices of a `model` whose channels are in units of their noise; N states, c channels.

    P (N, N) covariance of the prediction; S (c, c) = H P H' + 1 of an innovation; `update_gain` (N, c) = P H' S^-1; K
    (N, c) = F P H' S^-1 gain of the prediction; L (N, N) = F - K H transition of the error; `weighted_output_matrix`
    (c, N) = S^-1 H; `information` (N, N) = H' S^-1 H of one innovation about the state at its sample;
    `all_information` (N, N) = sum L^j' H' S^-1 H L^j of all innovations about the state at the first.
    """

    model: SampledModel
    P: Array
    S: Array
    update_gain: Array
    K: Array
    L: Array
    weighted_output_matrix: Array
    information: Array
    all_information: Array

    @property
    def outputs(self) -> Array:
        """The matrix U (o, N) from the state to the outputs."""
        return self.model.U

    @cached_property
    def future_information(self) -> Array | None:
        """Return the information (N, N) of all samples from one on about the state there, whatever its prior.

        It solves the equation of P with F', H'H and a root of Q in the places of F, Q and H'. None where there is none.
        """
        try:
            return steady_covariance(self.model.F.T, self.model.H.T @ self.model.H, positive_root(self.model.Q).T)
        except np.linalg.LinAlgError:
            return None

    @cached_property
    def _filtered_root(self) -> Array:
        """A root (N, N) of the covariance of the state given the samples up to its own."""
        return inverse_sum(self.P, self.model.H.T @ self.model.H)

    @cached_property
    def _smoothed_root(self) -> Array | None:
        """A root (N, N) of the covariance of the state given all samples; None where later ones tell without limit."""
        return None if self.future_information is None else inverse_sum(self.P, self.future_information)

    def output_variances(self, rows: Array) -> tuple[Array, Array]:
        """Return the variances (q,) of outputs with these rows (q, N), of the filter and of the smoother.

        They are sums of squares. The difference rows (P - P O P) rows' loses all digits where the channels are 1e5
        times their noise.
        """
        filtered = np.sum((rows @ self._filtered_root) ** 2, axis=1)
        if self._smoothed_root is not None:
            return filtered, np.sum((rows @ self._smoothed_root) ** 2, axis=1)
        spread = rows @ self.P
        return filtered, np.sum(spread * rows, axis=1) - np.sum((spread @ self.all_information) * spread, axis=1)


def steady_matrices(model: SampledModel) -> SteadyMatrices:
    """Solve the Riccati equation of a model. LinAlgError where it has no steady solution."""
    H = model.H
    P = steady_covariance(model.F, model.Q, H)
    S = np.asarray(H @ P @ H.T + np.eye(len(H)))
    update_gain = np.asarray(np.linalg.solve(S, H @ P).T)
    K = np.asarray(model.F @ update_gain)
    L = np.asarray(model.F - K @ H)
    weighted_output_matrix = np.asarray(np.linalg.solve(S, H))
    information = np.asarray(H.T @ weighted_output_matrix)
    all_information = discrete_gramian(L, information)
    return SteadyMatrices(model, P, S, update_gain, K, L, weighted_output_matrix, information, all_information)
