"""A static run as lines at frequency zero, so that the estimators take it like any other run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.signals.run_spectrum import RunSpectrum, StaticPoints
from balance_cli.signals.static_waveform import StaticWaveform

Array = NDArray[np.float64]


def static_lines(points: StaticPoints) -> RunSpectrum:
    """A static run as lines at frequency zero: its regression coefficients, scaled to independent experiments.

    With the centered loads U = Q R the lines Q' Y are R C0' with noise `covariance` in each, so that the linear part of
    all rows is kept without loss. The noise is real: as circular noise it counts double. Where the noise differs
    between rows it differs between lines; the correlation of lines that follows from it is neglected. Where the points
    come with `share`, Q is complete: lines without load contain the nonlinear part of the rows.
    """
    channels = points.channels - points.channels.mean(axis=0)
    loads = points.loads - points.loads.mean(axis=0)
    is_varied = np.ptp(points.loads, axis=0) > 0
    Q, R = np.linalg.qr(loads[:, is_varied]) if points.share is None else _complete_qr(loads[:, is_varied])
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


def _complete_qr(loads: Array) -> tuple[Array, Array]:
    """Q (m, m-1) over all that is orthogonal to a constant, its first columns those of the centered loads, and R."""
    ones = np.ones((len(loads), 1))
    Q, R = np.linalg.qr(np.hstack([ones, loads]), "complete")
    return np.asarray(Q[:, 1:]), np.asarray(R[1:, 1:])


def _load_points(points: StaticPoints, projection: Array) -> StaticWaveform:
    share = np.broadcast_to(np.asarray(points.share), points.channels.shape)
    return StaticWaveform(points.channels.astype(complex), share, projection)
