"""Noise of the nonlinear forces that are computed from measured motion, as a part of the channels' covariance.

The force of a damper beside a cell is computed from the cell's own reading y + n, and so contains noise, which the
model takes through the rig to all channels:

    residual = n - R (f(y + n) - f(y)),        R: volts of the channels per unit of the force

At a resonance that the force itself limits the second part is as large as the first, and at a high level larger; it
grows with the force, so that records at a low level do not show it. By a few draws of the noise the change of the force
is split into what a spring and a damper of constant size make of the noise e of the elongation (equivalent
linearization; Caughey, J. Acoust. Soc. Am. 35 (1963) 1706), and a rest that is independent of n:

    f(y + n) - f(y) = (a + b d/dt) e + rest,        cov = (I - B) C (I - B)' + R cov(rest) R',    B n = R (a + j w b) e
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch, BatchRun
from balance_cli.estimation.cell_forces import RunCellForces, cell_forces
from balance_cli.estimation.shared_solutions import SharedSolutions
from balance_cli.model.channel_gains import channel_gains
from balance_cli.model.system import System
from balance_cli.model.system_response import Solution, SpringInputs, volts_of_forces
from balance_cli.signals.waveform_types import Waveform

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

DRAWS = 12
"""Draws of the noise: the variance of a line is then known to 30 %, as that of a channel from a dozen of periods."""


def add_force_noise(batches: Sequence[Batch], system: System) -> tuple[Batch, ...]:
    """Return the same lines with the noise of the nonlinear forces of a system in the channels' covariance.

    `batches` are weighted by the noise of their lines alone. Static runs, and channels whose noise is not known, are
    left as they are.
    """
    if not any(force.values.value[0] != 0.0 for force in system.equations.forces):
        return tuple(batches)
    shared, rng = SharedSolutions(system), np.random.default_rng(0)
    return tuple(_add_to_batch(batch, system, shared, rng) for batch in batches)


def _add_to_batch(batch: Batch, system: System, shared: SharedSolutions, rng: np.random.Generator) -> Batch:
    precision = batch.lines.precision.copy()
    for run in batch.runs:
        if batch.is_static or run.waveform is None or run.waveform.noise is None:
            continue
        forces = _RunForces(replace(batch, runs=(run,)), run, run.waveform, system, shared)
        coherent, rest = forces.split_noise([run.waveform.draw_noise(rng) for _ in range(DRAWS)])
        weight = _transform_precision(precision[run.lines], coherent)
        precision[run.lines] = weight - _lost_precision(weight, batch.lines.efficiency[run.lines], rest)
    return replace(batch, lines=replace(batch.lines, precision=precision))


@dataclass(frozen=True)
class _RunForces:
    """The nonlinear forces of a run, the only one of a batch, with noise added to its waveform."""

    batch: Batch
    run: BatchRun
    waveform: Waveform
    system: System
    shared: SharedSolutions

    def split_noise(self, draws: Sequence[ComplexArray]) -> tuple[ComplexArray, ComplexArray]:
        """B (k, c, c), and of each draw (F, c) of the noise what the rest makes in the channels (k, c, draws)."""
        true, inputs = self._forces(0.0)
        noisy = [self._forces(draw)[1] for draw in draws]
        acting = np.array([change.acting - inputs.acting for change in noisy])
        read = np.array([change.read - inputs.read for change in noisy])
        springs = np.flatnonzero(acting.any(axis=(0, 1)))
        per_volt = self._elongation_per_volt()[:, springs]
        e = np.array([self._at_bins(np.einsum("fsc,fc->fs", per_volt, draw)) for draw in draws])
        law = _equivalent_law(self.waveform.bin_frequency(), e, acting[:, :, springs])
        is_read = np.asarray(read[:, :, springs].any(axis=(0, 1)))
        coherent = _stiffness(law, self.waveform.bin_frequency()) * e
        acting[:, :, springs] -= coherent
        read[:, :, springs] -= np.where(is_read, coherent, 0.0)
        rest = [
            replace(true, inputs=SpringInputs(*parts)).volts(self.system) for parts in zip(acting, read, strict=True)
        ]
        return self._coherent_part(per_volt, springs, is_read, law), np.stack(rest, axis=2) / np.sqrt(len(draws))

    def _forces(self, noise: ComplexArray | float) -> tuple[RunCellForces, SpringInputs]:
        waveform = self.waveform.with_channels(self.waveform.volts + noise, self.waveform.share, self.waveform.noise)
        batch = replace(self.batch, runs=(replace(self.run, waveform=waveform),))
        (forces,) = cell_forces(batch, self.system, self._solution, False, self.shared)
        assert forces.inputs is not None
        return forces, forces.inputs

    @property
    def _solution(self) -> Solution:
        return self.shared.solution(self.batch.frequency, self.batch.spin)

    def _at_bins(self, amplitudes: ComplexArray) -> ComplexArray:
        return self.waveform.to_bins(self.waveform.to_time_domain(amplitudes))

    def _elongation_per_volt(self) -> ComplexArray:
        """Elongation (F, e, c) [m/V] of each spring by a volt in each channel, before the filter."""
        of_channels = self.system.springs_of_channels
        gains = channel_gains(self.system.equations.paths, self.waveform.frequency)
        k = self.system.equations.stiffness.value[of_channels]
        own = np.where(gains != 0.0, self.waveform.share / np.where(gains != 0.0, gains, 1.0), 0.0) / k
        is_own = np.arange(len(self.system.equations.springs))[:, None] == of_channels
        return np.asarray(own[:, None, :] * is_own)

    def _coherent_part(self, per_volt: ComplexArray, springs: Index, is_read: Mask, law: Array) -> ComplexArray:
        """B (k, c, c) at the lines."""
        frequency = self.batch.line_frequency[self.run.lines]
        acting, read = volts_of_forces(self.system, self._solution)
        volts = (acting[:, :, springs] + np.where(is_read, read[:, :, springs], 0.0))[
            self.batch.lines.index[self.run.lines]
        ]
        nearest = np.rint(frequency / self.waveform.frequency[1]).astype(int)
        return np.asarray(np.einsum("kcs,ks,ksd->kcd", volts, _stiffness(law, frequency), per_volt[nearest]))


def _equivalent_law(frequency: Array, elongation: ComplexArray, force: ComplexArray) -> Array:
    """Spring [N/m] and damper [N s/m] (2, s) that make the most of forces (d, R, s) by elongations (d, R, s)."""
    w = 2 * np.pi * frequency[:, None]
    power, cross = np.abs(elongation) ** 2, elongation.conj() * force
    sums = [np.sum(part, axis=(0, 1)) for part in (power, power * w**2, cross.real, w * cross.imag)]
    tiny = np.finfo(float).tiny
    return np.array([sums[2] / np.maximum(sums[0], tiny), sums[3] / np.maximum(sums[1], tiny)])


def _stiffness(law: Array, frequency: Array) -> ComplexArray:
    """Dynamic stiffness (K, s) [N/m] of springs and dampers (2, s)."""
    return np.asarray(law[0] + 2j * np.pi * frequency[:, None] * law[1])


def _transform_precision(S: ComplexArray, B: ComplexArray) -> ComplexArray:
    """The precision (k, n, n) of a noise of precision S after the channels (c of n) have become I - B times theirs."""
    c = B.shape[1]
    inverse = np.zeros(S.shape, complex)
    inverse[:] = np.eye(S.shape[1])
    inverse[:, :c, :c] = np.linalg.inv(np.eye(c) - B)
    return np.asarray(inverse.conj().swapaxes(1, 2) @ S @ inverse)


def _lost_precision(S: ComplexArray, efficiency: Array, A: ComplexArray) -> ComplexArray:
    """By how much S (k, n, n), e times the inverse of C, exceeds that of C + A A', for A (k, c, d) of the channels."""
    c = A.shape[1]
    SA = np.matmul(S[:, :, :c], A)
    inner = np.matmul(A.conj().swapaxes(1, 2), SA[:, :c]) + efficiency[:, None, None] * np.eye(A.shape[2])
    return np.asarray(SA @ np.linalg.solve(inner, SA.conj().swapaxes(1, 2)))
