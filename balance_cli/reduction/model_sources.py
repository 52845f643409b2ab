"""Load-to-channel responses of models: the physical form, or the form of the paper."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.estimation.choices import GOOD_FIT_CHI2_PER_DOF
from balance_cli.estimation.identified_model import IdentifiedModel, identified_system
from balance_cli.estimation.nonlinear_contribution import remove_nonlinear_contribution
from balance_cli.estimation.response_error import ResponseError
from balance_cli.model.exciter_loads import recorded_over_load
from balance_cli.model.modes import overdamped_decay_rates
from balance_cli.model.response_jacobian import output_jacobian
from balance_cli.model.system import System
from balance_cli.model.system_response import load_response, response, solve
from balance_cli.reduction.response_description import ResponseDescription, ResponseKind, response_text
from balance_cli.reduction.response_sources import ChannelCombination, ResponseSource, select_channels
from balance_cli.signals.anti_alias import is_filter_contradicted

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class ModelSource:
    """The response of a computed or identified model.

    Its error is that of the parameters, times the misfit of the model to its data.
    """

    model: IdentifiedModel

    def __getstate__(self) -> dict[str, IdentifiedModel]:
        return {"model": self.model}  # the system holds functions, which have no pickle

    @property
    def description(self) -> str:
        """Form, method and effects of the model."""
        effects = tuple(dict.fromkeys(effect.name for effect in self.model.geometry.effects))
        return response_text(
            ResponseDescription(ResponseKind.PHYSICAL_MODEL, method=self.model.method, effects=effects)
        )

    @property
    def swept_band(self) -> tuple[float, float] | None:
        """Band [Hz] of the sweeps that the model was identified from."""
        return self.model.swept_band

    @property
    def response_error(self) -> ResponseError | None:
        """What the model misses of the responses that it was identified from."""
        return self.model.response_error

    @property
    def is_contradicted(self) -> bool:
        """Whether the sweeps contradict the filter, or the model its data and nobody recorded by how much (0.1)."""
        is_misfit = self.model.response_error is None and self.model.quality.chi2_per_dof > GOOD_FIT_CHI2_PER_DOF
        return is_misfit or is_filter_contradicted(self.model.consistency)

    @property
    def untrusted_channels(self) -> dict[str, str]:
        """Channels without which the diagnosis fitted the model."""
        return self.model.untrusted_channels

    @cached_property
    def system(self) -> System:
        """The equations of motion of the model at its estimate, the same for all runs."""
        return identified_system(self.model)

    @property
    def poles(self) -> tuple[complex, ...]:
        """None: the equations of motion tell the modes at each rotor speed."""
        return ()

    @cached_property
    def slowest_decay(self) -> float:
        """1 / (zeta omega) of the slowest mode [s], or the time constant of a slower motion that does not oscillate."""
        modes = self.model.modes
        rates = np.append(2 * np.pi * modes.frequency * modes.damping_ratio, overdamped_decay_rates(self.system))
        return float(1.0 / rates.min())

    def channel_combination(self, frequency: Array, live: tuple[str, ...]) -> ChannelCombination:
        """Return the rows, which are the channels."""
        return select_channels(self.model.geometry.channel_names, live, len(frequency))

    def at(self, frequency: Array, spin: float) -> ComplexArray:
        """Return T of the model."""
        return load_response(self.system, frequency, spin)

    def remove_nonlinear_contribution(self, run: Run, live: tuple[str, ...]) -> Run:
        """Return the run without the contribution of nonlinear cell forces to its channels."""
        return remove_nonlinear_contribution(run, self.system, self.model.geometry, live)

    def covariance(self, frequency: Array, spin: float, loads: ComplexArray) -> Array:
        """Return J Cov J' with J = d(T f)/d(parameters), and the errors of the gain and of a lag of all channels."""
        solution = solve(self.system, frequency, spin)
        jacobian = output_jacobian(self.system, solution, np.arange(len(solution.frequency)), loads)
        J = np.concatenate([jacobian.real, jacobian.imag], axis=1)
        covariance = J @ self.parameter_covariance @ J.swapaxes(1, 2)
        errors = [] if not self.model.gain_error else [self.model.gain_error * loads]
        if self.model.channels_may_lag:
            errors.append(self._common_lag(solution.frequency) * loads)
        for error in errors:
            off = response(self.system, solution) @ error[:, :, None]
            off = np.concatenate([off.real, off.imag], axis=1)
            covariance = covariance + off @ off.swapaxes(1, 2)
        return np.asarray(covariance)

    def _common_lag(self, frequency: Array) -> ComplexArray:
        """What channels that lag as recorded loads do make of loads (h, 6), those without a lag as the largest."""
        lag = recorded_over_load(self.system.equations, frequency) - 1.0
        most = np.take_along_axis(lag, np.argmax(np.abs(lag), axis=1)[:, None], axis=1)
        return np.where(lag == 0.0, most, lag)

    @property
    def parameter_covariance(self) -> Array:
        """Covariance (p, p) of the free parameters, times the misfit of the model to its data."""
        free = self.model.parameters.declared_sigma > 0
        return np.asarray(self.model.covariance[np.ix_(free, free)] * self.model.misfit_scale**2)


def model_source(model: IdentifiedModel) -> ResponseSource:
    """Return the response of a model of either form."""
    if model.paper is None:
        return ModelSource(model)
    from balance_cli.reduction.paper_source import PaperSource  # with the fit of the paper's form, which others lack

    return PaperSource(model, model.paper)
