"""Measured frequency responses of a rig: what `sweep-tf` leaves behind and `reduce` and the report take up."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.signals.run_spectrum import FrequencyResponse


@dataclass(frozen=True)
class SteadyPart:
    """Part of a periodic run that was used: `start` to `stop` [s] at every line; `period` [s]; `periods` in the record;

    `first` and `last`: earliest and latest steady period of a line (0 is the first); `steady`: by test.
    """

    start: float
    stop: float
    period: float
    periods: int
    first: int
    last: int
    steady: bool


@dataclass(frozen=True)
class Transfer:
    """Measured responses of a rig, one per run and level (or one for runs that were solved together).

    `estimator` is what was asked for; each response names its own. `steady_parts` {run: part used}; `channels_left_out`
    {run: {channel: why}}; `unused_runs` {run: why}.
    """

    geometry: Geometry
    responses: tuple[FrequencyResponse, ...]
    estimator: str = "auto"
    steady_parts: dict[str, SteadyPart] = field(default_factory=dict, metadata={"stored_as": "steady"})
    channels_left_out: dict[str, dict[str, str]] = field(default_factory=dict)
    unused_runs: dict[str, str] = field(default_factory=dict, metadata={"stored_as": "unused"})


def response_to_component(transfer: Transfer, component: str, level: str = "highest") -> FrequencyResponse:
    """The response to one component alone, of its `highest` or `lowest` level; of several, the one of least sigma.

    UserError where no sweep excited that component.
    """
    having = [
        select_component(response, component) for response in transfer.responses if component in response.components
    ]
    if not having:
        raise UserError(f"there is no measured response to {component}", remedy="Include a sweep that excites it")
    levels = [response.level[0] for response in having]
    wanted = max(levels) if level == "highest" else min(levels)
    return min((r for r in having if np.isclose(r.level[0], wanted)), key=lambda r: float(np.median(relative_sigma(r))))


def select_component(response: FrequencyResponse, component: str) -> FrequencyResponse:
    """The column of one component; its level is nan where the run did not declare it excited."""
    j = response.components.index(component)
    return replace(
        response,
        components=(component,),
        response=response.response[:, :, j : j + 1],
        load_covariance=response.load_covariance[:, j : j + 1, j : j + 1],
        coherence=response.coherence[:, :, j : j + 1],
        level=(response.level[j] if len(response.level) == len(response.components) else float("nan"),),
    )


def relative_sigma(response: FrequencyResponse) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Standard deviation over amplitude (k,) of a one-component response, in the channel where it is least."""
    channels = np.diagonal(response.channel_covariance, axis1=1, axis2=2).real
    variance = channels * response.load_covariance[:, :1, 0].real
    amplitude = np.maximum(np.abs(response.response[:, :, 0]), 1e-300)
    return np.asarray(np.min(np.sqrt(variance) / amplitude, axis=1))


def least_coherence(transfer: Transfer) -> dict[str, float]:
    """{component: least over all lines and runs of the multiple coherence of the best-responding channel}."""
    return {
        name: min(
            float(np.min(np.max(r.multiple_coherence, axis=1))) for r in transfer.responses if name in r.components
        )
        for name in response_components(transfer)
    }


def response_components(transfer: Transfer) -> tuple[str, ...]:
    """Components that some response has, in the usual order."""
    found = {name for response in transfer.responses for name in response.components}
    return tuple(name for name in COMPONENTS if name in found)
