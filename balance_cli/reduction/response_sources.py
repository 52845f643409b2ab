"""The load-to-channel response at rotor harmonics, with its own uncertainty: from a model, or from measurement.

What `reduce` inverts. Each kind answers two questions: T (h, c, 6) at h frequencies, and the covariance of T f for the
loads f that were found (a response error acts in proportion to the load).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Channel, Geometry
from balance_cli.estimation.identified_model import IdentifiedModel, identified_system
from balance_cli.estimation.nonlinear_contribution import remove_nonlinear_contribution
from balance_cli.estimation.paper.fit import response as paper_response
from balance_cli.estimation.paper.fit import response_jacobian
from balance_cli.estimation.paper.result import PaperFit
from balance_cli.estimation.paper.spectra import channel_response
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.plate import moment_reference_length
from balance_cli.model.system import output_jacobian, response, solve
from balance_cli.signals.response.interpolation import interpolate_response, interpolate_values
from balance_cli.signals.response.transfer import Transfer, response_to_component
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class ChannelCombination:
    """Which rows of a response the live channels serve: row indices (r,), and how they are formed from them,

    `combination` (h, r, c) at h frequencies for c live channels.
    """

    rows: list[int]
    combination: ComplexArray


class ResponseSource(Protocol):
    """A response that can be asked at any frequency. Its rows are channels, or sensors formed from channels."""

    @property
    def description(self) -> str:
        """What the response is, in a few words."""
        ...

    @property
    def slowest_decay(self) -> float:
        """Time constant [s] of the slowest decay that is known of the balance."""
        ...

    def channel_combination(self, frequency: Array, live: tuple[str, ...]) -> ChannelCombination:
        """How the rows come from the live channels at `frequency` (h,) [Hz]."""
        ...

    def at(self, frequency: Array, spin: float) -> ComplexArray:
        """The response (h, rows, 6) at `frequency` (h,) [Hz] and rotor speed `spin` [Hz]."""
        ...

    def covariance(self, frequency: Array, spin: float, loads: ComplexArray) -> Array:
        """Covariance (h, 2 rows, 2 rows) of [Re, Im] of T f for loads (h, 6), from the error of T."""
        ...


def select_channels(names: Sequence[str], live: Sequence[str], count: int) -> ChannelCombination:
    """Rows that are channels themselves: those of the live ones that the response knows, at `count` frequencies."""
    known = [name for name in live if name in names]
    pick = np.zeros((len(known), len(live)))
    pick[np.arange(len(known)), [list(live).index(name) for name in known]] = 1.0
    combination = np.broadcast_to(pick.astype(complex), (count, *pick.shape))
    return ChannelCombination([list(names).index(name) for name in known], combination)


def stacked_real(matrix: ComplexArray) -> Array:
    """[[Re, -Im], [Im, Re]] of complex matrices (..., a, b): (..., 2a, 2b)."""
    upper = np.concatenate([matrix.real, -matrix.imag], axis=-1)
    return np.concatenate([upper, np.concatenate([matrix.imag, matrix.real], axis=-1)], axis=-2)


def circular_real(covariance: ComplexArray) -> Array:
    """Covariance of [Re, Im] of circular noise with E[x x*] = `covariance` (..., c, c)."""
    return np.asarray(0.5 * stacked_real(covariance))


@dataclass(frozen=True)
class ModelSource:
    """The response of a computed or identified model; its error is that of the parameters, widened by the misfit."""

    model: IdentifiedModel

    @property
    def description(self) -> str:
        """Form, method and effects of the model."""
        effects = ", ".join(dict.fromkeys(effect.name for effect in self.model.geometry.effects))
        words = f"{self.model.form} model ({self.model.method})"
        return f"{words} with {effects}" if effects else words

    @property
    def slowest_decay(self) -> float:
        """1 / (zeta omega) of the slowest mode [s]."""
        modes = self.model.modes
        rate = 2 * np.pi * modes.frequency * modes.damping_ratio
        return float(1.0 / rate.min())

    def channel_combination(self, frequency: Array, live: tuple[str, ...]) -> ChannelCombination:
        """Rows are the channels."""
        return select_channels(self.model.geometry.channel_names, live, len(frequency))

    def at(self, frequency: Array, spin: float) -> ComplexArray:
        """T of the model."""
        system = identified_system(self.model)
        return response(system, solve(system, frequency, spin))

    def remove_nonlinear_contribution(self, run: Run, live: tuple[str, ...]) -> Run:
        """The run without what forces along the cells that are not linear did to its channels."""
        return remove_nonlinear_contribution(run, identified_system(self.model), self.model.geometry, live)

    def covariance(self, frequency: Array, spin: float, loads: ComplexArray) -> Array:
        """J Cov J' with J = d(T f)/d(parameters)."""
        system = identified_system(self.model)
        solution = solve(system, frequency, spin)
        slopes = output_jacobian(system, solution, np.arange(len(solution.frequency)), loads)
        J = np.concatenate([slopes.real, slopes.imag], axis=1)
        free = self.model.parameters.declared_sigma > 0
        covariance = self.model.covariance[np.ix_(free, free)] * self.model.misfit_scale**2
        return np.asarray(J @ covariance @ J.swapaxes(1, 2))


@dataclass(frozen=True)
class PaperSource:
    """The paper's form: six sensor forces for Fx to My, and the torque by the computed shaft beside them."""

    model: IdentifiedModel
    fit: PaperFit

    @property
    def description(self) -> str:
        """Form, damping and method."""
        return f"paper form ({self.model.method}, {self.fit.options.damping} damping)"

    @property
    def slowest_decay(self) -> float:
        """1 / (zeta omega) of the slowest decaying mode [s]."""
        modes = self.model.modes
        return float(1.0 / np.abs(2 * np.pi * modes.frequency * modes.damping_ratio).min())

    @property
    def _torque_channel(self) -> str | None:
        return next((channel.name for channel in self.model.geometry.channels if channel.torque_meter), None)

    def channel_combination(self, frequency: Array, live: tuple[str, ...]) -> ChannelCombination:
        """Sensor forces from the live channels of each cell, and the torque channel."""
        rule, geometry = self.fit.rule, self.model.geometry
        n = len(rule.names)
        combination = np.zeros((len(frequency), n + 1, len(live)), complex)
        for j, cell in enumerate(rule.cells):
            channel = _live_channel_of_cell(geometry, cell, live)
            gain = channel_response(channel, frequency)
            combination[:, :n, live.index(channel.name)] += rule.matrix[:, j] / gain[:, None]
        if self._torque_channel is None or self._torque_channel not in live:
            return ChannelCombination(list(range(n)), combination[:, :n])
        combination[:, n, live.index(self._torque_channel)] = 1.0
        return ChannelCombination(list(range(n + 1)), combination)

    def at(self, frequency: Array, spin: float) -> ComplexArray:
        """G(w) B_F for the plate, k / (k + jwd - w^2 J) for the torque."""
        n = len(self.fit.rule.names)
        value = np.zeros((len(frequency), n + 1, 6), complex)
        value[:, :n, self._columns] = paper_response(self.fit, frequency)
        if self._torque_channel is not None:
            system = balance_model(self.model.geometry).system()
            row = system.channel_names.index(self._torque_channel)
            value[:, n, 5] = response(system, solve(system, frequency, spin))[:, row, 5]
        return value

    def covariance(self, frequency: Array, spin: float, loads: ComplexArray) -> Array:
        """J Cov J' of the sensor rows; Cov comes from the residuals and holds the misfit already."""
        slopes = np.einsum("hnmp,hm->hnp", response_jacobian(self.fit, frequency), loads[:, self._columns])
        n, p = slopes.shape[1:]
        wide = np.zeros((len(frequency), n + 1, p), complex)
        wide[:, :n] = slopes
        J = np.concatenate([wide.real, wide.imag], axis=1)
        return np.asarray(J @ self.fit.covariance @ J.swapaxes(1, 2))

    @property
    def _columns(self) -> list[int]:
        return [COMPONENTS.index(name) for name in self.fit.inputs]


def _live_channel_of_cell(geometry: Geometry, cell: str, live: tuple[str, ...]) -> Channel:
    """The live channel that reads `cell`, piezo before strain; UserError where there is none."""
    there = [channel for channel in geometry.channels if channel.cell == cell and channel.name in live]
    if not there:
        raise UserError(f"no live channel of cell {cell}", remedy="The paper's form needs every cell; use another form")
    return min(there, key=lambda channel: channel.measures_dc)


@dataclass(frozen=True)
class TransferSource:
    """Measured responses, one per component, interpolated; `interpolation` as in `signals.interpolation`."""

    channel_names: tuple[str, ...]
    responses: tuple[FrequencyResponse, ...]
    interpolation: str
    slowest_decay: float = 3.0

    @property
    def description(self) -> str:
        """Kind of interpolation."""
        return f"measured response ({self.interpolation})"

    def channel_combination(self, frequency: Array, live: tuple[str, ...]) -> ChannelCombination:
        """Rows are the channels."""
        return select_channels(self.channel_names, live, len(frequency))

    def at(self, frequency: Array, spin: float) -> ComplexArray:
        """T of the measured lines, column by column."""
        value = np.zeros((len(frequency), len(self.channel_names), 6), complex)
        for measured in self.responses:
            columns = [COMPONENTS.index(name) for name in measured.components]
            rows = [self.channel_names.index(name) for name in measured.channel_names]
            found = interpolate_values(measured, frequency, self.interpolation)
            value[:, np.array(rows)[:, None], columns] = found
        return value

    def covariance(self, frequency: Array, spin: float, loads: ComplexArray) -> Array:
        """Sum over the responses of f' cov(loads) f* times the channels' covariance: each was measured by itself."""
        count = len(self.channel_names)
        total = np.zeros((len(frequency), count, count), complex)
        for measured in self.responses:
            columns = [COMPONENTS.index(name) for name in measured.components]
            rows = np.array([self.channel_names.index(name) for name in measured.channel_names])
            at = interpolate_response(measured, frequency, self.interpolation)
            mine = loads[:, columns]
            size = np.real(np.einsum("hi,hij,hj->h", mine.conj(), at.load_covariance, mine))
            total[:, rows[:, None], rows] += size[:, None, None] * at.channel_covariance
        return circular_real(total)


@dataclass(frozen=True)
class StaticSource:
    """The static matrix C0 at every frequency, as if the balance had no dynamics (what the paper set out to mend)."""

    channel_names: tuple[str, ...]
    C0: Array
    slowest_decay: float = 3.0

    @property
    def description(self) -> str:
        """What it is."""
        return "static matrix"

    def channel_combination(self, frequency: Array, live: tuple[str, ...]) -> ChannelCombination:
        """Rows are the strain and torque channels."""
        return select_channels(self.channel_names, live, len(frequency))

    def at(self, frequency: Array, spin: float) -> ComplexArray:
        """C0, the same at every frequency."""
        return np.broadcast_to(self.C0.astype(complex), (len(frequency), *self.C0.shape))

    def covariance(self, frequency: Array, spin: float, loads: ComplexArray) -> Array:
        """None: what this matrix neglects is no noise."""
        count = 2 * len(self.channel_names)
        return np.zeros((len(frequency), count, count))


def load_scale(hub: Sequence[float]) -> Array:
    """Factors (6,) that make moments comparable with forces: one over the height of the hub [1, 1/m]."""
    arm = moment_reference_length(hub)
    return np.array([1.0, 1.0, 1.0, 1.0 / arm, 1.0 / arm, 1.0 / arm])


def model_source(model: IdentifiedModel) -> ResponseSource:
    """The response of a model of either form."""
    return ModelSource(model) if model.paper is None else PaperSource(model, model.paper)


def transfer_source(transfer: Transfer, interpolation: str) -> ResponseSource:
    """Measured responses, for each component that of its highest level."""
    components = dict.fromkeys(name for response in transfer.responses for name in response.components)
    chosen = tuple(response_to_component(transfer, name) for name in components)
    return TransferSource(transfer.geometry.channel_names, chosen, interpolation)


def static_source(calibration: Calibration) -> ResponseSource:
    """C0 of the first trim over the strain and torque channels."""
    trim = next(iter(calibration.trims.values()))
    C0 = np.zeros((len(trim.channel_names), 6))
    C0[:, [COMPONENTS.index(name) for name in trim.components]] = trim.C0
    return StaticSource(trim.channel_names, C0)
