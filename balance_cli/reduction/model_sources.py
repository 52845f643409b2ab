"""Load-to-channel responses of models: the physical form, and the form of the paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Channel, Geometry
from balance_cli.estimation.choices import GOOD_FIT_CHI2_PER_DOF
from balance_cli.estimation.identified_model import IdentifiedModel, identified_system
from balance_cli.estimation.nonlinear_contribution import remove_nonlinear_contribution
from balance_cli.estimation.paper.fit import response as paper_response
from balance_cli.estimation.paper.fit import response_jacobian
from balance_cli.estimation.paper.result import PaperFit
from balance_cli.estimation.paper.spectra import channel_response
from balance_cli.estimation.response_error import ResponseError
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.response_jacobian import output_jacobian
from balance_cli.model.system import System
from balance_cli.model.system_response import response, solve
from balance_cli.reduction.response_description import ResponseDescription, ResponseKind, response_text
from balance_cli.reduction.response_sources import ChannelCombination, ResponseSource, select_channels

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class ModelSource:
    """The response of a computed or identified model.

    Its error is that of the parameters, times the misfit of the model to its data.
    """

    model: IdentifiedModel

    @property
    def description(self) -> str:
        """Form, method and effects of the model."""
        effects = tuple(dict.fromkeys(effect.name for effect in self.model.geometry.effects))
        return response_text(
            ResponseDescription(ResponseKind.PHYSICAL_MODEL, method=self.model.method, effects=effects)
        )

    @property
    def response_error(self) -> ResponseError | None:
        """What the model misses of the responses that it was identified from."""
        return self.model.response_error

    @property
    def is_contradicted(self) -> bool:
        """Whether the model does not fit its data and nobody recorded by how much, as in artefacts of version 0.1."""
        return self.model.response_error is None and self.model.quality.chi2_per_dof > GOOD_FIT_CHI2_PER_DOF

    @property
    def system(self) -> System | None:
        """The equations of motion of the model at its estimate."""
        return identified_system(self.model)

    @property
    def slowest_decay(self) -> float:
        """1 / (zeta omega) of the slowest mode [s]."""
        modes = self.model.modes
        rate = 2 * np.pi * modes.frequency * modes.damping_ratio
        return float(1.0 / rate.min())

    def channel_combination(self, frequency: Array, live: tuple[str, ...]) -> ChannelCombination:
        """Return the rows, which are the channels."""
        return select_channels(self.model.geometry.channel_names, live, len(frequency))

    def at(self, frequency: Array, spin: float) -> ComplexArray:
        """Return T of the model."""
        system = identified_system(self.model)
        return response(system, solve(system, frequency, spin))

    def remove_nonlinear_contribution(self, run: Run, live: tuple[str, ...]) -> Run:
        """Return the run without the contribution of nonlinear cell forces to its channels."""
        return remove_nonlinear_contribution(run, identified_system(self.model), self.model.geometry, live)

    def covariance(self, frequency: Array, spin: float, loads: ComplexArray) -> Array:
        """Return J Cov J' with J = d(T f)/d(parameters)."""
        system = identified_system(self.model)
        solution = solve(system, frequency, spin)
        jacobian = output_jacobian(system, solution, np.arange(len(solution.frequency)), loads)
        J = np.concatenate([jacobian.real, jacobian.imag], axis=1)
        free = self.model.parameters.declared_sigma > 0
        covariance = self.model.covariance[np.ix_(free, free)] * self.model.misfit_scale**2
        return np.asarray(J @ covariance @ J.swapaxes(1, 2))


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
    def response_error(self) -> ResponseError | None:
        """None: the misfit of the paper's form is known in its sensors, not in the channels."""
        return None

    @property
    def is_contradicted(self) -> bool:
        """Whether the form does not fit its data."""
        return self.fit.misfit.chi2_per_dof > GOOD_FIT_CHI2_PER_DOF

    @property
    def system(self) -> System | None:
        """None: the fit holds at frequencies, it has no equations in time."""
        return None

    @property
    def slowest_decay(self) -> float:
        """1 / (zeta omega) of the slowest decaying mode [s]."""
        modes = self.model.modes
        return float(1.0 / np.abs(2 * np.pi * modes.frequency * modes.damping_ratio).min())

    @property
    def _torque_channel(self) -> str | None:
        return next((channel.name for channel in self.model.geometry.channels if channel.torque_meter), None)

    def channel_combination(self, frequency: Array, live: tuple[str, ...]) -> ChannelCombination:
        """Form the sensor forces from the live channels of each cell, and append the torque channel."""
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
        """Return G(w) B_F for the plate and k / (k + jwd - w^2 J) for the torque."""
        n = len(self.fit.rule.names)
        value = np.zeros((len(frequency), n + 1, 6), complex)
        value[:, :n, self._columns] = paper_response(self.fit, frequency)
        if self._torque_channel is not None:
            system = balance_model(self.model.geometry).system()
            row = system.channel_names.index(self._torque_channel)
            value[:, n, 5] = response(system, solve(system, frequency, spin))[:, row, 5]
        return value

    def remove_nonlinear_contribution(self, run: Run, live: tuple[str, ...]) -> Run:
        """Return the run itself: the paper's form is linear."""
        return run

    def covariance(self, frequency: Array, spin: float, loads: ComplexArray) -> Array:
        """Return J Cov J' of the sensor rows; Cov comes from the residuals, so it contains the misfit already."""
        jacobian = np.einsum("hnmp,hm->hnp", response_jacobian(self.fit, frequency), loads[:, self._columns])
        n, p = jacobian.shape[1:]
        with_torque = np.zeros((len(frequency), n + 1, p), complex)
        with_torque[:, :n] = jacobian
        J = np.concatenate([with_torque.real, with_torque.imag], axis=1)
        return np.asarray(J @ self.fit.covariance @ J.swapaxes(1, 2))

    @property
    def _columns(self) -> list[int]:
        return [COMPONENTS.index(name) for name in self.fit.inputs]


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


def model_source(model: IdentifiedModel) -> ResponseSource:
    """Return the response of a model of either form."""
    return ModelSource(model) if model.paper is None else PaperSource(model, model.paper)
