"""Measured responses as the response of a reduction: one for each load, of the channels that all of them have."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.load_components import carried_components
from balance_cli.estimation.response_error import ResponseError
from balance_cli.io.errors import UserError
from balance_cli.reduction.response_description import ResponseDescription, ResponseKind, response_text
from balance_cli.reduction.response_sources import (
    ASSUMED_DECAY,
    ChannelCombination,
    ResponseSource,
    ResponseWithoutModel,
    circular_real,
    select_channels,
)
from balance_cli.signals.anti_alias import is_filter_contradicted
from balance_cli.signals.response.choices import has_contradicting_responses

if TYPE_CHECKING:  # Reductions by a model ask for the type of their source, and interpolate nothing.
    from balance_cli.reduction.spin_dependence import SpinDependence
    from balance_cli.reduction.weighted_least_squares import SolvedLoads
    from balance_cli.signals.response.interpolation_error import InterpolationWithError
    from balance_cli.signals.response.transfer import Transfer
    from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Mask = NDArray[np.bool_]


SPIN_NOTE = (
    "the responses depend on the rotor speed, and some were not measured at that of the run: their change is in sigma; "
    "sweep all loads with the rotor turning, or reduce by a model with gyroscopic-coupling"
)

GUESSED_SHARE = 0.1
"""Standard deviation of a load by the interpolation, as a share of the load, that flags it: as of a model's error."""


MOST_KEPT = 4
"""Sets of frequencies at which the responses are kept: the harmonics of a run, with and without the mean."""
SMALL_LOAD = 0.02
"""Of the largest load of a harmonic: a smaller one counts as that large. A load that is zero is known to no share."""


@dataclass(frozen=True)
class TransferSource(ResponseWithoutModel):
    """Measured responses, one per component, interpolated by one of `signals.response.choices.INTERPOLATIONS`.

    All have the channels `channel_names`. `channels_left_out` {channel: reason} are those that some of them lack.
    `at_speeds` are all that were measured, one per component and rotor speed. `response_error` is what the responses
    miss at the rotor speed of a run, as far as sweeps at several speeds tell. They contain their own error, and are
    contradicted only where the sweeps contradict the declared filter.
    """

    channel_names: tuple[str, ...]
    responses: tuple[FrequencyResponse, ...]
    interpolation: str
    slowest_decay: float = ASSUMED_DECAY
    channels_left_out: dict[str, str] = field(default_factory=dict)
    at_speeds: tuple[FrequencyResponse, ...] = ()
    response_error: ResponseError | None = None
    note: str = ""
    is_contradicted: bool = False

    def at_spin(self, spin: float) -> TransferSource:
        """Return the responses that belong to a rotor speed [Hz], with what they miss there."""
        if len(self.at_speeds) == len(self.responses):
            return self
        from balance_cli.reduction.spin_dependence import nearest_responses

        responses = nearest_responses(self.at_speeds, self.responses, spin)
        distance = np.zeros(len(COMPONENTS))
        for response in responses:
            distance[COMPONENTS.index(response.components[0])] = abs(spin - response.rotor_speed)
        if self._spin_dependence is None or not np.any(distance):
            return replace(self, responses=responses, response_error=None, note="")
        error = self._spin_dependence.at(distance)
        return replace(self, responses=responses, response_error=error, note=SPIN_NOTE)

    @cached_property
    def _spin_dependence(self) -> SpinDependence | None:
        from balance_cli.reduction.spin_dependence import spin_dependence

        return spin_dependence(self.at_speeds, self.interpolation)

    @cached_property
    def poles(self) -> tuple[complex, ...]:
        """Those that the responses determine."""
        from balance_cli.signals.response.response_poles import response_poles

        return response_poles(self.responses)

    @property
    def description(self) -> str:
        """That it was measured, and how it is interpolated."""
        return response_text(ResponseDescription(ResponseKind.MEASURED, interpolation=self.interpolation))

    def channel_combination(self, frequency: Array, live: tuple[str, ...]) -> ChannelCombination:
        """Return the rows, which are the channels."""
        return select_channels(self.channel_names, live, len(frequency))

    def at(self, frequency: Array, spin: float) -> ComplexArray:
        """Return T, interpolated between the measured lines column by column."""
        from balance_cli.signals.response.interpolation import interpolate_values

        value = np.zeros((len(frequency), len(self.channel_names), 6), complex)
        for measured in self.responses:
            columns = [COMPONENTS.index(name) for name in measured.components]
            rows = [self.channel_names.index(name) for name in measured.channel_names]
            value[:, np.array(rows)[:, None], columns] = interpolate_values(measured, frequency, self.interpolation)
        return value

    def covariance(self, frequency: Array, spin: float, loads: ComplexArray) -> Array:
        """Return the sum over the responses of f' cov(loads) f* times the covariance of the channels.

        Each response was measured by itself, so that their errors are independent.
        """
        return self._propagate(frequency, loads, lambda judged: judged.response.channel_covariance)

    def form_covariance(self, frequency: Array, loads: ComplexArray) -> Array:
        """Return the part (h, 2c, 2c) of `covariance` that is the error of the curves between their lines."""
        return self._propagate(frequency, loads, lambda judged: judged.form)

    def _propagate(
        self, frequency: Array, loads: ComplexArray, part: Callable[[InterpolationWithError], ComplexArray]
    ) -> Array:
        """Return the covariance (h, 2c, 2c) of T f for loads f (h, 6) by a part (h, c, c) of that of each response."""
        # Of several sets of loads the frequencies are the same.
        frequency, place = np.unique(frequency, return_inverse=True)
        count = len(self.channel_names)
        total = np.zeros((len(place), count, count), complex)
        for measured, at in zip(self.responses, self._interpolated(frequency), strict=True):
            columns = [COMPONENTS.index(name) for name in measured.components]
            rows = np.array([self.channel_names.index(name) for name in measured.channel_names])
            f = loads[:, columns]
            scale = np.real(np.einsum("hi,hij,hj->h", f.conj(), at.response.load_covariance[place], f))
            total[:, rows[:, None], rows] += scale[:, None, None] * part(at)[place]
        return circular_real(total)

    def _interpolated(self, frequency: Array) -> tuple[InterpolationWithError, ...]:
        """Return all responses at frequencies (h,) [Hz]; tests of one run ask for the same dozens of times."""
        from balance_cli.signals.response.interpolation_error import interpolate_and_judge

        kept, key = self._kept, frequency.tobytes()
        if key not in kept:
            for oldest in list(kept)[: max(len(kept) + 1 - MOST_KEPT, 0)]:
                del kept[oldest]
            judged = (interpolate_and_judge(measured, frequency, self.interpolation) for measured in self.responses)
            kept[key] = tuple(judged)
        return kept[key]

    @cached_property
    def _kept(self) -> dict[bytes, tuple[InterpolationWithError, ...]]:
        return {}


def transfer_source(transfer: Transfer, interpolation: str) -> TransferSource:
    """Return the measured responses, for each component that of the highest level, of the channels that all have.

    Raises UserError where a component that the rig carries was not excited in any sweep.
    """
    from balance_cli.signals.response.transfer import response_components, response_to_component
    from balance_cli.signals.response.transfer import select_channels as select_response_channels

    components = response_components(transfer)
    unmeasured = [name for name in carried_components(transfer.geometry) if name not in components]
    if unmeasured:
        raise UserError(
            f"no response to {', '.join(unmeasured)} was measured, which the rig carries, too",
            place="responses",
            remedy="Add sweeps that excite these loads to `balance sweep-tf`, or reduce by a model",
        )
    measured = {name: response_to_component(transfer, name) for name in components}
    by_speed = [
        replace(transfer, responses=tuple(item for item in transfer.responses if item.rotor_speed == speed))
        for speed in dict.fromkeys(response.rotor_speed for response in transfer.responses)
    ]
    at_speeds = [response_to_component(part, name) for part in by_speed for name in response_components(part)]
    lacking = {
        channel: [name for name, response in measured.items() if channel not in response.channel_names]
        for channel in transfer.geometry.channel_names
    }
    channels = tuple(channel for channel, loads in lacking.items() if not loads)

    def selected(responses: Iterable[FrequencyResponse]) -> tuple[FrequencyResponse, ...]:
        return tuple(select_response_channels(item, channels) for item in responses)

    return TransferSource(
        channels,
        selected(measured.values()),
        interpolation,
        channels_left_out={
            channel: f"its response to {', '.join(loads)} was not measured"
            for channel, loads in lacking.items()
            if loads
        },
        at_speeds=selected(item for item in at_speeds if set(channels) <= set(item.channel_names)),
        is_contradicted=is_filter_contradicted(transfer.consistency)
        or has_contradicting_responses(transfer.consistency),
    )


def highest_frequency(source: ResponseSource) -> float:
    """Return the highest frequency [Hz] at which a response is known: the last measured line, infinite for a model."""
    if not isinstance(source, TransferSource):
        return float("inf")
    return min(float(measured.frequency[-1]) for measured in source.responses)


def lowest_frequency(source: ResponseSource) -> float:
    """Return the lowest frequency [Hz] at which a response is known: the first measured line, no end for a model."""
    if not isinstance(source, TransferSource):
        return -float("inf")
    return max(float(measured.frequency[0]) for measured in source.responses)


def unresolved_loads(
    source: ResponseSource,
    solution: SolvedLoads,
    frequency: Array,
    components: Sequence[str],
    live: tuple[str, ...],
    scale: Array,
) -> Mask:
    """Return the loads (n, m) that the error of the interpolation makes uncertain by a share of them, beyond noise.

    They are those of m `components` at `frequency` (n,) from the `live` channels; `scale` (m,) makes them comparable.
    """
    loads = solution.loads
    if not isinstance(source, TransferSource):
        return np.zeros(loads.shape, bool)
    m = loads.shape[1]
    all_loads = np.zeros((len(loads), len(COMPONENTS)), complex)
    all_loads[:, [COMPONENTS.index(name) for name in components]] = loads
    rows = np.array(source.channel_combination(frequency, live).rows)
    rows = np.concatenate([rows, rows + len(source.channel_names)])
    form = source.form_covariance(frequency, all_loads)[:, rows[:, None], rows]
    G = solution.equations.estimator
    variance = np.einsum("hba,hac,hbc->hb", G, form, G)
    noise = np.diagonal(solution.noise_covariance, axis1=1, axis2=2)
    guessed, noise = variance[:, :m] + variance[:, m:], noise[:, :m] + noise[:, m:]
    size = np.abs(loads) * scale
    size = np.maximum(size, SMALL_LOAD * size.max(axis=1, keepdims=True)) / scale
    return np.asarray((guessed > (GUESSED_SHARE * size) ** 2) & (guessed > noise))


def unresolved_note(unresolved: Mask) -> str:
    """Return the harmonics of which loads (n, m) are unresolved, with a remedy; empty where there are none."""
    harmonics = ", ".join(str(n + 1) for n in np.flatnonzero(unresolved.any(axis=1)))
    if not harmonics:
        return ""
    return (
        f"harmonics {harmonics} lie between lines of the measured responses that are too far apart to tell the "
        "response there: sweep in smaller steps, or at the harmonics themselves, or reduce by a model"
    )
