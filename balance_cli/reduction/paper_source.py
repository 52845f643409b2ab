"""Load-to-channel response of a model in the paper's form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.channel import Channel
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.choices import GOOD_FIT_CHI2_PER_DOF
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.paper.fit import response_jacobian
from balance_cli.estimation.paper.result import PaperFit
from balance_cli.estimation.paper.spectra import channel_response
from balance_cli.estimation.paper_rows import row_names, row_response, torque_channel
from balance_cli.estimation.response_error import ResponseError
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.response_jacobian import output_jacobian
from balance_cli.model.system import System
from balance_cli.model.system_response import solve
from balance_cli.reduction.response_description import ResponseDescription, ResponseKind, response_text
from balance_cli.reduction.response_sources import ASSUMED_DECAY, ChannelCombination
from balance_cli.signals.anti_alias import is_filter_contradicted

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class PaperSource:
    """The paper's form: six sensor forces for Fx to My; the torque goes through the computed shaft."""

    model: IdentifiedModel
    fit: PaperFit

    @property
    def description(self) -> str:
        """Form, damping and method."""
        return response_text(
            ResponseDescription(ResponseKind.PAPER_FORM, method=self.model.method, damping=self.fit.options.damping)
        )

    @property
    def swept_band(self) -> tuple[float, float] | None:
        """Band [Hz] of the sweeps that the model was identified from."""
        return self.model.swept_band

    @property
    def response_error(self) -> ResponseError | None:
        """What the form misses of the sensors and the torque in the sweeps."""
        return self.model.response_error

    @property
    def is_contradicted(self) -> bool:
        """Whether the sweeps contradict the filter, or the form its data and nobody recorded by how much (0.1)."""
        is_misfit = self.model.response_error is None and self.fit.misfit.chi2_per_dof > GOOD_FIT_CHI2_PER_DOF
        return is_misfit or is_filter_contradicted(self.model.consistency)

    @property
    def untrusted_channels(self) -> dict[str, str]:
        """Channels without which the diagnosis fitted the model."""
        return self.model.untrusted_channels

    @property
    def system(self) -> System | None:
        """None: the fit holds at frequencies, it has no equations in time."""
        return None

    @property
    def poles(self) -> tuple[complex, ...]:
        """Those of the modes that oscillate and decay."""
        modes = self.model.modes
        oscillating = np.sqrt(np.maximum(1.0 - modes.damping_ratio**2, 0.0))
        s = 2.0 * np.pi * modes.frequency * (1j * oscillating - modes.damping_ratio)
        return tuple(s[(s.real < 0.0) & (s.imag > 0.0)].tolist())

    @property
    def slowest_decay(self) -> float:
        """1 / (zeta omega) of the slowest decaying mode [s]."""
        modes = self.model.modes
        rates = np.abs(2 * np.pi * modes.frequency * modes.damping_ratio)
        return float(1.0 / rates.min()) if len(rates) else ASSUMED_DECAY

    def channel_combination(self, frequency: Array, live: tuple[str, ...]) -> ChannelCombination:
        """Form the sensor forces from the live channels of each cell, and append the torque channel."""
        rule, geometry = self.fit.rule, self.model.geometry
        torque = torque_channel(geometry)
        n = len(rule.names)
        combination = np.zeros((len(frequency), n + 1, len(live)), complex)
        for j, cell in enumerate(rule.cells):
            channel = _live_channel_of_cell(geometry, cell, live)
            gain = channel_response(channel, frequency)
            combination[:, :n, live.index(channel.name)] += rule.matrix[:, j] / gain[:, None]
        if torque is None or torque not in live:
            return ChannelCombination(list(range(n)), combination[:, :n])
        combination[:, n, live.index(torque)] = 1.0
        return ChannelCombination(list(range(n + 1)), combination)

    def at(self, frequency: Array, spin: float) -> ComplexArray:
        """Return the sensors and the torque that the loads give."""
        return row_response(self.fit, self.model.geometry, frequency, spin)

    def remove_nonlinear_contribution(self, run: Run, live: tuple[str, ...]) -> Run:
        """Return the run itself: the paper's form is linear."""
        return run

    def covariance(self, frequency: Array, spin: float, loads: ComplexArray) -> Array:
        """Return J Cov J' of the rows, whose Cov contains the misfit within the band of the fit.

        The row of the torque rests on the declared shaft, and has the error of its tolerances.
        """
        geometry = self.model.geometry
        columns = [COMPONENTS.index(name) for name in self.fit.inputs]
        jacobian = np.einsum("hnmp,hm->hnp", response_jacobian(self.fit, frequency), loads[:, columns])
        h, n, p = jacobian.shape
        rows = np.zeros((h, len(row_names(self.fit, geometry)), p), complex)
        rows[:, :n] = jacobian
        J = np.concatenate([rows.real, rows.imag], axis=1)
        total = np.asarray(J @ self.fit.covariance @ J.swapaxes(1, 2))
        torque = torque_channel(geometry)
        if torque is not None:
            total[:, n :: n + 1, n :: n + 1] += _declared_torque_covariance(geometry, torque, frequency, spin, loads)
        return total


def _declared_torque_covariance(
    geometry: Geometry, torque: str, frequency: Array, spin: float, loads: ComplexArray
) -> Array:
    """Return the covariance (h, 2, 2) of [Re, Im] of the torque channel by the tolerances of the declared rig."""
    model = balance_model(geometry)
    system, only_torque = model.system(), np.zeros_like(loads)
    only_torque[:, COMPONENTS.index("Mz")] = loads[:, COMPONENTS.index("Mz")]
    solution = solve(system, frequency, spin)
    jacobian = output_jacobian(system, solution, np.arange(len(solution.frequency)), only_torque)
    J = np.stack([part[:, system.channel_names.index(torque)] for part in (jacobian.real, jacobian.imag)], axis=1)
    return np.asarray((J * model.parameters.sigma[model.parameters.free] ** 2) @ J.swapaxes(1, 2))


def _live_channel_of_cell(geometry: Geometry, cell: str, live: tuple[str, ...]) -> Channel:
    """Return the live channel that reads `cell`, piezo before strain.

    Raises UserError where the cell has no live channel.
    """
    channels = [channel for channel in geometry.channels if channel.cell == cell and channel.name in live]
    if not channels:
        raise UserError(
            f"cell {cell} has no live channel", remedy="Use a model of the physical form: the paper's form needs all"
        )
    return min(channels, key=lambda channel: channel.measures_dc)
