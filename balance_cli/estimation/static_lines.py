"""A static run as lines at frequency zero, so that the estimators take it like any other run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.signals.run_spectrum import RunSpectrum, StaticPoints
from balance_cli.signals.static_waveform import StaticWaveform

Array = NDArray[np.float64]

COLLINEARITY_RATIO = 1e-6
"""Singular value over the largest below which loads are constant within their load series, but for rounding."""


def static_lines(points: StaticPoints) -> RunSpectrum:
    """A static run as lines at frequency zero: its regression coefficients, scaled to independent experiments.

    With the centered loads U = Q R the lines Q' Y are R C0' with noise `covariance` in each, so that the linear part of
    all rows is kept without loss. Loads are centered in each load series that the run states, so that its zero is in no
    line. The noise is real: as circular noise it counts double. Where the points come with
    `share`, Q is complete: lines without load contain the nonlinear part of the rows. Where the noise differs between
    rows, each of these lines is then one of rows with equal noise, but for the differences between their means. Lines
    count as independent, with a noise that is not smaller than that of the correlated ones (see `NoisePart.project`).
    """
    channels = points.channels - points.channels.mean(axis=0)
    loads = points.loads - points.loads.mean(axis=0)
    is_varied = np.ptp(points.loads, axis=0) > 0
    Q = _load_basis(points, is_varied) if points.share is None else _complete_basis(points, is_varied)
    R = Q.T @ loads[:, is_varied]
    components = tuple(name for name, used in zip(COMPONENTS, is_varied, strict=True) if used)
    count, c = len(R), len(points.channel_names)
    padded = np.zeros((count, c + count, c + count), complex)
    parts = tuple(part.project(Q) for part in points.noise_parts)
    padded[:, :c, :c] = 2.0 * (sum(part.covariance for part in parts) if parts else points.covariance)
    return RunSpectrum(
        run=points.run,
        channel_names=points.channel_names,
        components=components,
        frequency=np.zeros(count),
        channels=(Q.T @ channels).astype(complex),
        loads=R.astype(complex),
        covariance=padded,
        dof=points.dof,
        constant_loads=Q.T @ (points.loads[:, is_varied] != 0.0),
        waveform=None if points.share is None else _load_points(points, Q.T),
        noise_parts=parts,
    )


def _series_rows(points: StaticPoints) -> list[NDArray[np.intp]]:
    """Rows of each load series that has several; all rows where none are stated."""
    if points.series is None:
        return [np.arange(len(points.loads))]
    rows = [np.flatnonzero(points.series == number) for number in range(int(points.series.max()) + 1)]
    return [each for each in rows if len(each) > 1]


def _load_basis(points: StaticPoints, is_varied: NDArray[np.bool_]) -> Array:
    """Q (m, q) over the loads about the mean of their load series."""
    loads = np.zeros((len(points.loads), int(np.count_nonzero(is_varied))))
    for rows in _series_rows(points):
        loads[rows] = points.loads[rows][:, is_varied] - points.loads[rows][:, is_varied].mean(axis=0)
    # One line for each load where all of them vary within the series: each then has the noise of its own rows.
    Q, R = np.linalg.qr(loads)
    if np.min(np.abs(np.diag(R)) / np.linalg.norm(points.loads[:, is_varied], axis=0)) > COLLINEARITY_RATIO:
        return np.asarray(Q)
    U, s, _ = np.linalg.svd(loads / np.ptp(points.loads[:, is_varied], axis=0), full_matrices=False)
    return np.asarray(U[:, s > COLLINEARITY_RATIO * s[0]])


def _complete_basis(points: StaticPoints, is_varied: NDArray[np.bool_]) -> Array:
    """Q (m, m - s) over all that is orthogonal to a constant in each of s load series."""
    shares = [part.share for part in points.noise_parts] or [np.ones(len(points.loads))]
    blocks = []
    for rows in _series_rows(points):
        part = _basis_of_series(points.loads[rows][:, is_varied], np.stack(shares, axis=1)[rows])
        block = np.zeros((len(points.loads), part.shape[1]))
        block[rows] = part
        blocks.append(block)
    return np.hstack(blocks)


def _basis_of_series(loads: Array, shares: Array) -> Array:
    """Q (m, m-1) over all that is orthogonal to a constant, within each group of rows with equal noise first.

    In a group the first columns are those of its loads about their mean. The means of the groups are combined to
    differences by the Householder reflection of the constant on the group with the least noise: each remains nearly one
    group's own.
    """
    groups = np.unique(shares, axis=0, return_inverse=True)[1].reshape(-1)
    count = int(groups.max()) + 1
    within, means = [], np.zeros((len(loads), count))
    for number in range(count):
        rows = np.flatnonzero(groups == number)
        means[rows, number] = 1.0 / np.sqrt(len(rows))
        columns = np.zeros((len(loads), len(rows) - 1))
        columns[rows] = np.linalg.qr(np.hstack([np.ones((len(rows), 1)), loads[rows]]), "complete")[0][:, 1:]
        within.append(columns)
    return np.hstack([*within, means @ _differences_of_means(np.bincount(groups) / len(loads))])


def _differences_of_means(share: Array) -> Array:
    """Orthonormal columns (g, g-1) orthogonal to the constant, of groups with these shares (g,) of the rows."""
    normal = np.sqrt(share)
    normal[0] += 1.0
    reflection = np.eye(len(share)) - 2.0 * np.outer(normal, normal) / (normal @ normal)
    return np.asarray(reflection[:, 1:], float)


def _load_points(points: StaticPoints, projection: Array) -> StaticWaveform:
    share = np.broadcast_to(np.asarray(points.share), points.channels.shape)
    return StaticWaveform(points.channels.astype(complex), share, projection)
