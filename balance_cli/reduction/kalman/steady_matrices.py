"""Gains and covariances of the steady-state Kalman filter and smoother of a sampled model.

Anderson and Moore, Optimal Filtering, 1979, chapters 4 and 7; de Jong, J. Am. Stat. Assoc. 84, 1989, 1085.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman.discretization import SampledModel
from balance_cli.reduction.kalman.riccati import discrete_gramian, steady_covariance

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

    def output_variances(self, rows: Array) -> tuple[Array, Array]:
        """Return the variances (q,) of outputs with these rows (q, N), of the filter and of the smoother."""
        spread = rows @ self.P
        reductions = [np.sum((spread @ J) * spread, axis=1) for J in (self.information, self.all_information)]
        predicted = np.sum(spread * rows, axis=1)
        return predicted - reductions[0], predicted - reductions[1]


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
