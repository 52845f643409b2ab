"""Measured and modeled responses in common terms: the force in a cell per unit of hub load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.channel import Channel
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.fit_quality import frf_band_of_lines
from balance_cli.estimation.identified_model import IdentifiedModel, identified_system
from balance_cli.estimation.paper.fit import response as paper_response
from balance_cli.estimation.paper.spectra import channel_response
from balance_cli.io.errors import UserError
from balance_cli.model.system_response import response, solve
from balance_cli.report.number_format import format_significant
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

Values = TypeVar("Values", Array, ComplexArray)

TORQUE_METER = "torque meter"


@dataclass(frozen=True)
class Sensor:
    """A cell, the torque meter, or the resultant of two cells: the signed sum of its channels."""

    name: str
    channels: Mapping[str, float]

    def weights(self, geometry: Geometry, frequency: Array) -> ComplexArray:
        """Force per volt (k, n) of its n channels: declared sensitivity and dynamics divided out."""
        declared = {channel.name: channel for channel in geometry.channels}
        gains = [channel_response(declared[name], frequency) for name in self.channels]
        return np.asarray(np.array(list(self.channels.values())) / np.stack(gains, axis=1), complex)


@dataclass(frozen=True)
class Curve:
    """A response over frequency (k,) [Hz], with the standard deviation (k,) of real and imaginary part together."""

    frequency: Array
    value: ComplexArray
    sigma: Array


def excitation_level(response: FrequencyResponse) -> float:
    """Highest level of the excitation [N, N m rms] of its components; 0 where none is given."""
    return max((float(value) for value in response.level if np.isfinite(value)), default=0.0)


Band = tuple[float, float]
"""Lowest and highest frequency [Hz]."""


def error_band(responses: Sequence[FrequencyResponse], geometry: Geometry) -> Band:
    """Return the band [Hz] of the relative errors of responses, the same that models state (`frf_band`)."""
    lines = np.concatenate([response.frequency for response in responses])
    try:
        return frf_band_of_lines(lines, geometry)
    except UserError:  # the geometry declares no masses, so that its modes are not known
        return float(lines.min()), float(lines.max())


def lines_within(band: Band, frequency: Array) -> NDArray[np.bool_]:
    """Which lines (k,) lie in a band."""
    return (frequency >= band[0]) & (frequency <= band[1])


def band_text(band: Band) -> str:
    """A band in words, such as `5 to 150 Hz`."""
    return f"{format_significant(band[0])} to {format_significant(band[1], 4)} Hz"


def best_channel(response: FrequencyResponse) -> tuple[Array, Array]:
    """Coherence (k,) and relative sigma (k,) of the channel that responds best at each line; one component."""
    coherence = response.coherence[:, :, 0]
    best, lines = np.argmax(coherence, axis=1), np.arange(len(coherence))
    variance = np.real(response.channel_covariance[lines, best, best] * response.load_covariance[:, 0, 0])
    return coherence[lines, best], quotient(np.sqrt(variance), np.abs(response.response[lines, best, 0]))


def force_response(response: FrequencyResponse, geometry: Geometry) -> tuple[ComplexArray, Array]:
    """Response (k, c) of every channel to one component, over the sensitivity, and its standard deviation (k, c)."""
    sensitivity = {channel.name: channel.sensitivity for channel in geometry.channels}
    weights = np.array([1.0 / sensitivity[name] for name in response.channel_names])
    variance = np.real(np.diagonal(response.channel_covariance, axis1=1, axis2=2))
    sigma = np.sqrt(variance * np.real(response.load_covariance[:, 0, 0])[:, None]) * np.abs(weights)
    return response.response[:, :, 0] * weights, sigma


def sensors(
    geometry: Geometry, responses: Sequence[FrequencyResponse], models: Sequence[IdentifiedModel]
) -> tuple[Sensor, ...]:
    """All sensors that the figures show.

    Every cell by the channel with the least noise relative to its sensitivity, the torque meters, sums of cells by the
    name of their channel, and the resultants that a model in the paper's form uses. Accelerations of a rig without any
    of them.
    """
    present = {name for response in responses for name in response.channel_names}
    measured = [channel for channel in geometry.channels if channel.name in present]
    order = [f"cell {name}" for name in geometry.cell_names]
    order += [channel.source for channel in measured if channel.torque_meter or channel.cells]
    shown = {}
    for source in dict.fromkeys(order):
        channels = [channel for channel in measured if channel.source == source]
        if channels:
            best = min(channels, key=lambda channel: median_force_noise(channel, responses))
            name = best.cell or (source if best.torque_meter else best.name)
            shown[name] = Sensor(name, {best.name: 1.0})
    if not shown:
        return tuple(Sensor(channel.name, {channel.name: 1.0}) for channel in measured)
    return (*shown.values(), *_resultants(shown, models))


def _resultants(cells: Mapping[str, Sensor], models: Sequence[IdentifiedModel]) -> tuple[Sensor, ...]:
    resultants: dict[str, Sensor] = {}
    for model in models:
        rule = None if model.paper is None else model.paper.rule
        for i, name in enumerate(rule.names if rule else ()):
            assert rule is not None
            parts = {cell: sign for cell, sign in zip(rule.cells, rule.matrix[i], strict=True) if sign}
            if name not in cells and set(parts) <= set(cells):
                resultants[name] = Sensor(
                    name, {next(iter(cells[cell].channels)): float(parts[cell]) for cell in parts}
                )
    return tuple(resultants.values())


def median_force_noise(channel: Channel, responses: Sequence[FrequencyResponse]) -> float:
    """Median standard deviation of a channel's response, as a force, over all lines of all responses."""
    values = [
        np.sqrt(np.real(response.channel_covariance[:, i, i] * response.load_covariance[:, 0, 0]))
        for response in responses
        if channel.name in response.channel_names
        for i in [response.channel_names.index(channel.name)]
    ]
    return float(np.median(np.concatenate(values))) / abs(channel.sensitivity)


def measured_curve(response: FrequencyResponse, sensor: Sensor, component: str, geometry: Geometry) -> Curve | None:
    """The sensor's measured response to a component; None where one of its channels is missing."""
    if not set(sensor.channels) <= set(response.channel_names):
        return None
    j = response.components.index(component)
    rows = [response.channel_names.index(name) for name in sensor.channels]
    weights = sensor.weights(geometry, response.frequency)
    covariance = response.channel_covariance[:, rows][:, :, rows]
    variance = np.real(np.einsum("ki,kij,kj->k", weights, covariance, weights.conj()))
    sigma = np.sqrt(np.maximum(variance * np.real(response.load_covariance[:, j, j]), 0.0))
    return Curve(response.frequency, np.sum(response.response[:, rows, j] * weights, axis=1), sigma)


@dataclass(frozen=True)
class ModelResponse:
    """Responses of a model at `frequency` (k,) [Hz]: volts of each channel and force of each sensor, (k, 6) each.

    A model of the paper's form has no channels, and its own sensors only; other models lack the sensors of channels
    that their geometry does not have.
    """

    frequency: Array
    channels: dict[str, ComplexArray]
    sensors: dict[str, ComplexArray]


def model_response(
    model: IdentifiedModel, frequency: Array, spin: float, shown_sensors: Sequence[Sensor], geometry: Geometry
) -> ModelResponse:
    """All responses of a model of either form, to compare with those measured on a rig of this geometry.

    There are none where the model is of another rig: equal names do not mean equal cells.
    """
    if model.geometry.rig != geometry.rig:
        return ModelResponse(frequency, {}, {})
    if model.paper is not None:
        value = np.zeros((len(frequency), len(model.paper.rule.names), 6), complex)
        value[:, :, [COMPONENTS.index(name) for name in model.paper.inputs]] = paper_response(model.paper, frequency)
        return ModelResponse(frequency, {}, {name: value[:, i] for i, name in enumerate(model.paper.rule.names)})
    system = identified_system(model)
    T = response(system, solve(system, frequency, spin))
    channels = {name: T[:, i] for i, name in enumerate(system.channel_names)}
    forces = {}
    for sensor in shown_sensors:
        if not set(sensor.channels) <= set(channels):
            continue
        weights = sensor.weights(geometry, frequency)
        forces[sensor.name] = sum(
            (weights[:, i, None] * channels[name] for i, name in enumerate(sensor.channels)), np.zeros_like(T[:, 0])
        )
    return ModelResponse(frequency, channels, forces)


def quotient(a: Values, b: Values) -> Values:
    """Quotient a / b element by element, NaN where b is zero."""
    result = np.full(np.broadcast_shapes(a.shape, b.shape), np.nan, np.result_type(a, b))
    return np.divide(a, b, out=result, where=b != 0)


def relative_error(model: ComplexArray, measured: ComplexArray) -> float:
    """Rms of model minus measurement over rms of measurement."""
    size = float(np.sum(np.abs(measured) ** 2))
    return float(np.sqrt(np.sum(np.abs(model - measured) ** 2) / size)) if size > 0 else float("nan")


def relative_noise(sigma: Array, measured: ComplexArray) -> float:
    """The contribution of noise with this standard deviation to `relative_error`."""
    size = float(np.sum(np.abs(measured) ** 2))
    return float(np.sqrt(np.sum(sigma**2) / size)) if size > 0 else float("nan")
