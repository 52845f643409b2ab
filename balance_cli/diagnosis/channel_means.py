"""Means of sweeps in each channel, and their regression on what all runs or single ones may have in common."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.estimation.cell_forces import record_force_histories
from balance_cli.estimation.channel_distortions import channel_distortions
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.mechanics.cell_force import CellForce
from balance_cli.model.system import System
from balance_cli.model.system_response import Solution, volts_of_forces
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ChannelMeans:
    """Means of R runs in C channels [V] and their variance (NaN and infinite where there is none), and loads (R, 6).

    `applied` (R, 6): which loads were applied; `power` (R, C) of the channels about their means; `noise_dof` of the
    noise that is known least.
    """

    volts: Array
    variance: Array
    loads: Array
    applied: NDArray[np.bool_]
    power: Array
    noise_dof: float


def channel_means(runs: Sequence[RunSpectrum], names: Sequence[str]) -> ChannelMeans:
    """Return the means of the runs that have them, in the channels of these names."""
    with_mean = [run for run in runs if (run.frequency == 0).any()]
    shape = (len(with_mean), len(names))
    volts, variance, power = np.zeros(shape), np.full(shape, np.inf), np.zeros(shape)
    loads = np.zeros((len(with_mean), len(COMPONENTS)))
    applied = np.zeros(loads.shape, bool)
    for r, run in enumerate(with_mean):
        line = int(np.flatnonzero(run.frequency == 0)[-1])
        channels = [names.index(name) for name in run.channel_names]
        components = [COMPONENTS.index(name) for name in run.components]
        # A line at frequency zero is twice the mean.
        volts[r, channels] = 0.5 * run.channels[line].real
        variance[r, channels] = 0.25 * np.diag(run.covariance[line]).real[: len(channels)]
        power[r, channels] = 0.5 * np.sum(np.abs(run.channels[run.frequency > 0]) ** 2, axis=0)
        loads[r, components] = 0.5 * run.loads[line].real
        applied[r, components] = True
    noise_dof = min((2.0 * max(run.dof, 1.0) for run in with_mean), default=np.inf)
    return ChannelMeans(volts, variance, loads, applied, power, noise_dof)


def shared_columns(T: Array, means: ChannelMeans, tested: NDArray[np.bool_]) -> Array:
    """What all runs share (p, R, C): a zero of each channel tested, and an offset of each load that was applied."""
    shape = means.volts.shape
    channels = [np.broadcast_to(np.eye(shape[1])[i], shape) for i in np.flatnonzero(tested)]
    loads = [np.outer(means.applied[:, j], T[:, j]) for j in np.flatnonzero(means.applied.any(axis=0))]
    columns = [*channels, *loads]  # none of measured responses, which have no means
    return np.array(columns).reshape(len(columns), *shape)


@dataclass(frozen=True)
class MeanRegression:
    """Weighted least squares of means on columns: values and sigma (p,), residual (n,) over its sigma where `used`.

    `variance` and `used` (R, C); `basis` (n, q) spans the weighted columns.
    """

    values: Array
    sigma: Array
    residual: Array
    basis: Array
    variance: Array

    @classmethod
    def of(cls, columns: Array, volts: Array, variance: Array) -> MeanRegression:
        """The regression of volts (R, C) of a variance (infinite: not used) on columns (p, R, C)."""
        used = np.isfinite(variance)
        weight = 1.0 / np.sqrt(variance[used])
        A, y = columns[:, used].T * weight[:, None], volts[used] * weight
        left, size, right = np.linalg.svd(A, full_matrices=False)
        is_significant = size > np.finfo(float).eps * len(y) * size.max(initial=0.0)
        left, size, right = left[:, is_significant], size[is_significant], right[is_significant]
        values = right.T @ ((left.T @ y) / size)
        sigma = np.sqrt(np.sum((right / size[:, None]) ** 2, axis=0))
        return cls(values, sigma, y - left @ (left.T @ y), left, variance)

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which means take part (R, C)."""
        return np.isfinite(self.variance)

    @property
    def channel_chi2(self) -> Array:
        """Chi-square (C,) of each channel."""
        squares = np.zeros(self.variance.shape)
        squares[self.used] = self.residual**2
        return np.asarray(squares.sum(axis=0), float)

    def largest_share(self, patterns: Sequence[Array]) -> float:
        """The largest share of the squared residual that one pattern (R, C) describes."""
        shares = [0.0]
        for pattern in patterns:
            column = pattern[self.used] / np.sqrt(self.variance[self.used])
            column = column - self.basis @ (self.basis.T @ column)
            size = float(column @ column)
            if size > 0.0:
                shares.append(float(column @ self.residual) ** 2 / size)
        return max(shares) / max(float(self.residual @ self.residual), np.finfo(float).tiny)


def nonlinear_means(runs: Sequence[RunSpectrum], system: System, at_rest: Solution) -> Array:
    """Return what nonlinear terms add to the means (R, C) [V] of the runs that have them.

    These are the forces that the motion determines, and channels that are not linear.
    """
    with_mean = [run for run in runs if (run.frequency == 0).any()]
    shift = np.zeros((len(with_mean), len(system.channel_names)))
    if not system.equations.has_nonlinear_terms:
        return shift
    acting, read = (each[0].real for each in volts_of_forces(system, at_rest))
    for row, run in zip(shift, with_mean, strict=True):
        (batch,) = stack_runs((run,), (), system.channel_names)
        waveform = batch.runs[0].waveform
        if waveform is None:
            continue
        for distortions in channel_distortions(batch, system, derivatives=False):
            row += 0.5 * distortions.volts(system)[-1].real
        for force, _, through_time in record_force_histories(waveform, system, batch.spin):
            if force.held is None:
                # The last bin is twice the mean.
                mean = 0.5 * waveform.to_bins(through_time)[-1].real
                row += mean * (acting[:, force.spring] + (read[:, force.spring] if force.read else 0.0))
    return shift


def curvature_columns(means: ChannelMeans, tested: NDArray[np.bool_]) -> Array:
    """What curvature of each channel tested does to its means (p, R, C): in proportion to the power of its reading."""
    return np.stack([means.power * np.eye(means.volts.shape[1])[i] for i in np.flatnonzero(tested)])


def contact_columns(system: System, means: ChannelMeans, at_rest: Solution, contacts: Sequence[CellForce]) -> Array:
    """What one newton along the springs of contacts does to the means of each run alone (p, R, C)."""
    acting, read = (each[0].real for each in volts_of_forces(system, at_rest))
    runs = np.eye(len(means.volts))
    volts = [acting[:, force.spring] + (read[:, force.spring] if force.read else 0.0) for force in contacts]
    return np.stack([np.outer(run, each) for each in volts for run in runs])


def cell_patterns(system: System, means: ChannelMeans, at_rest: Solution) -> Iterator[Array]:
    """What the mean force of each cell does to the means (R, C), as its motion squared or its size, read or not."""
    acting, read = (each[0].real for each in volts_of_forces(system, at_rest))
    springs = np.array(system.springs_of_channels)
    for spring in range(acting.shape[1]):
        of_spring = np.flatnonzero(springs == spring)
        if not len(of_spring):
            continue
        power = means.power[:, of_spring[0]]
        for volts in (acting[:, spring], acting[:, spring] + read[:, spring]):
            yield np.outer(power, volts)
            yield np.outer(np.sqrt(power), volts)
