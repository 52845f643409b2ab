"""Sensor forces s and inputs u of the paper's equations, from the lines of sweep runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.channel import Channel
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.paper.sensors import SensorRule
from balance_cli.io.errors import UserError
from balance_cli.model.plate import plate_matrices
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class SensorSpectra:
    """Sensor forces and inputs of all runs at N lines, one after the other.

    `frequency` (N,) [Hz], `s` (N, n) [N], `u` (N, m) [N, N m], `covariance` (N, n+m, n+m) of the noise of [s, u];
    `run` (N,) index into `runs`; `dof` (N,) complex degrees of freedom behind the covariance.
    """

    sensors: tuple[str, ...]
    inputs: tuple[str, ...]
    runs: tuple[str, ...]
    run: NDArray[np.intp]
    frequency: Array
    s: ComplexArray
    u: ComplexArray
    covariance: ComplexArray
    dof: Array

    def in_band(self, band: tuple[float, float]) -> SensorSpectra:
        """The lines from band[0] to band[1] [Hz], both included."""
        return self.subset((self.frequency >= band[0]) & (self.frequency <= band[1]))

    def subset(self, mask: NDArray[np.bool_]) -> SensorSpectra:
        """The lines (N,) in the mask."""
        return replace(
            self,
            run=self.run[mask],
            frequency=self.frequency[mask],
            s=self.s[mask],
            u=self.u[mask],
            covariance=self.covariance[mask],
            dof=self.dof[mask],
        )


def plate_inputs(geometry: Geometry, runs: Sequence[RunSpectrum]) -> tuple[str, ...]:
    """The excited components that act on the plate, in the order of the hub loads (Mz acts on the shaft instead)."""
    excited = {component for run in runs for component in run.components}
    acts_on_plate = np.any(plate_matrices(geometry).F != 0.0, axis=0)
    return tuple(name for name, acts in zip(COMPONENTS, acts_on_plate, strict=True) if acts and name in excited)


def sensor_spectra(geometry: Geometry, rule: SensorRule, runs: Sequence[RunSpectrum]) -> SensorSpectra:
    """Compute sensor forces and inputs of the runs that excite the plate; other runs are left out.

    Each cell is read by its piezo channel, or by its strain channel where the run has no usable piezo channel of it.
    Sensitivity and declared channel dynamics are divided out; the anti-alias filter is the same in s and u.

    Raises UserError where nothing excites the plate, or a run lacks every channel of a cell.
    """
    inputs = plate_inputs(geometry, runs)
    used = [run for run in runs if set(run.components) & set(inputs)]
    if not used:
        raise UserError("no run excites the plate", remedy="Give sweeps of Fx, Fy, Fz, Mx and My")
    parts = [_sensor_forces(geometry, rule, inputs, run) for run in used]
    lengths = [len(run.frequency) for run in used]
    z = np.concatenate([part[0] for part in parts])
    n = len(rule.names)
    return SensorSpectra(
        sensors=rule.names,
        inputs=inputs,
        runs=tuple(run.run for run in used),
        run=np.repeat(np.arange(len(used)), lengths),
        frequency=np.concatenate([run.frequency for run in used]),
        s=z[:, :n],
        u=z[:, n:],
        covariance=np.concatenate([part[1] for part in parts]),
        dof=np.repeat([run.dof for run in used], lengths),
    )


def _sensor_forces(
    geometry: Geometry, rule: SensorRule, inputs: tuple[str, ...], run: RunSpectrum
) -> tuple[ComplexArray, ComplexArray]:
    """Z = [s, u] (k, n+m) of one run and its noise covariance: both linear in [channels, loads]."""
    k, c, n = len(run.frequency), len(run.channel_names), len(rule.names)
    L = np.zeros((k, n + len(inputs), c + len(run.components)), complex)
    L[:, :n, :c] = _sensor_combination(geometry, rule, run)
    for j, component in enumerate(run.components):
        if component in inputs:
            L[:, n + inputs.index(component), c + j] = 1.0
    # Unused channels are removed, not multiplied by zero: 0 times a non-finite value is not zero.
    raw = np.concatenate([run.channels, run.loads], axis=1)
    read = np.any(L != 0.0, axis=(0, 1))
    L, raw, noise = L[:, :, read], raw[:, read], run.covariance[:, read][:, :, read]
    return (L @ raw[:, :, None])[:, :, 0], L @ noise @ np.conj(np.swapaxes(L, 1, 2))


def sensor_combination(geometry: Geometry, rule: SensorRule, run: RunSpectrum) -> ComplexArray | None:
    """Return how the sensor forces (k, n, c) are formed from the channels of a run; None where it lacks a cell."""
    if not all(any(ch.cell == cell and _is_usable(run, ch.name) for ch in geometry.channels) for cell in rule.cells):
        return None
    return _sensor_combination(geometry, rule, run)


def _sensor_combination(geometry: Geometry, rule: SensorRule, run: RunSpectrum) -> ComplexArray:
    L = np.zeros((len(run.frequency), len(rule.names), len(run.channel_names)), complex)
    for j, cell in enumerate(rule.cells):
        channel = _select_channel(geometry, cell, run)
        gain = channel_response(channel, run.frequency)
        L[:, :, run.channel_names.index(channel.name)] += rule.matrix[:, j] / gain[:, None]
    return L


def _select_channel(geometry: Geometry, cell: str, run: RunSpectrum) -> Channel:
    """The channel that reads `cell`: a piezo channel before a strain channel."""
    of_cell = [ch for ch in geometry.channels if ch.cell == cell]
    if not of_cell:
        fault = f"the paper's form needs a channel of each cell, and no channel reads cell {cell} alone"
        raise UserError(fault, "--form", remedy="Use `physical`")
    usable = [ch for ch in of_cell if _is_usable(run, ch.name)]
    if not usable:
        raise UserError(
            f"no usable channel of cell {cell}", file=run.run, place="channels", remedy="Leave this run out"
        )
    return min(usable, key=lambda channel: channel.measures_dc)


def _is_usable(run: RunSpectrum, name: str) -> bool:
    return name in run.channel_names and bool(np.all(np.isfinite(run.channels[:, run.channel_names.index(name)])))


def channel_response(channel: Channel, frequency: Array) -> ComplexArray:
    """Volts per newton (k,) at `frequency` (k,) [Hz]: sensitivity, first-order high-pass and low-pass as declared."""
    H = np.full(frequency.shape, channel.sensitivity, complex)
    if channel.time_constant is not None:
        jwt = 2j * np.pi * frequency * channel.time_constant
        H *= jwt / (1.0 + jwt)
    if channel.lowpass is not None:
        H /= 1.0 + 1j * frequency / channel.lowpass
    return H
