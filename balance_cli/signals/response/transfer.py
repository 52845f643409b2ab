"""Measured frequency responses of a rig: the result of `sweep-tf`, which `reduce` and the report read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.io.result_view import ResultView, plural, warning_lines
from balance_cli.signals.nyquist_noise import UsualNoise
from balance_cli.signals.run_spectrum import FrequencyResponse

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class SteadyPart:
    """Part of a periodic run that was used.

    It is used from `start` to `stop` [s] at every line. `period` [s] is the period, of which the record has `periods`.
    `first` and `last` are the earliest and the latest first steady period of a line (0 is the first of the record).
    `steady` says whether a test found these periods steady.
    """

    start: float
    stop: float
    period: float
    periods: int
    first: int
    last: int
    steady: bool


@dataclass(frozen=True, repr=False)
class Transfer(ResultView):
    """Measured responses of a rig, one per run and level (or one for runs that were solved together).

    `estimator` is the one that was requested; each response names the one that was used. `steady_parts` maps each
    periodic run to the part that was used, `channels_left_out` {run: {channel: reason}} and `unused_runs` {run: reason}
    say what was not used; `consistency` is what the cross-checks said of the runs, None where nothing. `usual_noise` is
    that of the channels near half the sample rate, which the sweeps have in common; None where they have none.
    `import_notes` say of responses of another program what was assumed, and where sigma comes from; else None.
    """

    geometry: Geometry
    responses: tuple[FrequencyResponse, ...]
    estimator: str = "auto"
    steady_parts: dict[str, SteadyPart] = field(default_factory=dict, metadata={"stored_as": "steady"})
    channels_left_out: dict[str, dict[str, str]] = field(default_factory=dict)
    unused_runs: dict[str, str] = field(default_factory=dict, metadata={"stored_as": "unused"})
    consistency: tuple[str, ...] | None = field(default=None, metadata={"omit_if_none": True})
    usual_noise: tuple[UsualNoise, ...] | None = field(default=None, metadata={"omit_if_none": True})
    import_notes: tuple[str, ...] | None = field(default=None, metadata={"omit_if_none": True})

    def summary_lines(self) -> Iterator[str]:
        """Runs, components and band, least coherence, channels left out."""
        components = " ".join(response_components(self))
        yield f"Frequency responses of {self.geometry.rig}: {plural(len(self.responses), 'response')} to {components}"
        low = min(float(response.frequency[0]) for response in self.responses)
        high = max(float(response.frequency[-1]) for response in self.responses)
        lines = sum(len(response.frequency) for response in self.responses)
        yield f"  {plural(lines, 'spectral line')} from {low:.4g} to {high:.4g} Hz, estimator {self.estimator}"
        coherence = least_coherence(self)
        worst = min(coherence, key=lambda name: coherence[name])
        yield f"  least coherence {coherence[worst]:.4f} ({worst})"
        lost = sorted({channel for channels in self.channels_left_out.values() for channel in channels})
        if lost:
            yield f"  channels left out: {', '.join(lost)}"
        yield from (f"  {note}" for note in self.import_notes or ())
        yield from warning_lines(self.consistency)

    def to_frame(self) -> pd.DataFrame:
        """One row for each run, component, channel and spectral line (long form).

        `response` is complex [V/N, V/(N m)], output/input with exp(+j omega t); `sigma` is the standard deviation of
        the complex number, sqrt(E|error|^2).
        """
        import pandas as pd

        return pd.concat([_response_frame(response) for response in self.responses], ignore_index=True)


def _response_frame(response: FrequencyResponse) -> pd.DataFrame:
    """The rows of one response, by component, channel and spectral line."""
    import pandas as pd

    k, c, u = response.response.shape
    channel_variance = np.diagonal(response.channel_covariance, axis1=1, axis2=2).real
    load_variance = np.diagonal(response.load_covariance, axis1=1, axis2=2).real
    variance = channel_variance[:, :, None] * load_variance[:, None, :]
    values = response.response.transpose(2, 1, 0).ravel()
    return pd.DataFrame(
        {
            "run": response.run,
            "component": np.repeat(response.components, c * k),
            "channel": np.tile(np.repeat(response.channel_names, k), u),
            "frequency_hz": np.tile(response.frequency, u * c),
            "response": values,
            "magnitude": np.abs(values),
            "phase_deg": np.degrees(np.angle(values)),
            "sigma": np.sqrt(variance).transpose(2, 1, 0).ravel(),
            "coherence": response.coherence.transpose(2, 1, 0).ravel(),
        }
    )


def response_to_component(transfer: Transfer, component: str) -> FrequencyResponse:
    """Return the response to one component at its highest level; of several, that of least sigma.

    Responses of fewer channels than another one to this component are not used.
    Raises UserError where no sweep excited that component.
    """
    candidates = [
        select_component(response, component) for response in transfer.responses if component in response.components
    ]
    if not candidates:
        raise UserError(f"there is no measured response to {component}", remedy="Include a sweep that excites it")
    most = max(len(response.channel_names) for response in candidates)
    candidates = [response for response in candidates if len(response.channel_names) == most]
    levels = [response.level[0] for response in candidates if np.isfinite(response.level[0])]
    target = max(levels, default=float("nan"))
    at_level = [response for response in candidates if np.isclose(response.level[0], target, equal_nan=True)]
    return min(at_level, key=lambda response: float(np.median(relative_sigma(response))))


def select_component(response: FrequencyResponse, component: str) -> FrequencyResponse:
    """Return the column of one component; its level is NaN where the run does not declare it as excited."""
    j = response.components.index(component)
    return replace(
        response,
        components=(component,),
        response=response.response[:, :, j : j + 1],
        load_covariance=response.load_covariance[:, j : j + 1, j : j + 1],
        coherence=response.coherence[:, :, j : j + 1],
        level=(response.level[j] if len(response.level) == len(response.components) else float("nan"),),
    )


def select_channels(response: FrequencyResponse, channels: Sequence[str]) -> FrequencyResponse:
    """Return the rows of some of the channels of a response, in the order of `channels`."""
    rows = [response.channel_names.index(name) for name in channels]
    return replace(
        response,
        channel_names=tuple(channels),
        response=response.response[:, rows],
        channel_covariance=response.channel_covariance[:, rows][:, :, rows],
        coherence=response.coherence[:, rows],
        multiple_coherence=response.multiple_coherence[:, rows],
    )


def relative_sigma(response: FrequencyResponse) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return the relative standard deviation (k,) of a one-component response, in the channel where it is least."""
    channels = np.diagonal(response.channel_covariance, axis1=1, axis2=2).real
    variance = channels * response.load_covariance[:, :1, 0].real
    amplitude = np.maximum(np.abs(response.response[:, :, 0]), 1e-300)
    return np.asarray(np.min(np.sqrt(variance) / amplitude, axis=1))


def least_coherence(transfer: Transfer) -> dict[str, float]:
    """Return for each component the least multiple coherence of its best-responding channel over all lines and runs."""
    return {
        name: min(
            float(np.min(np.max(r.multiple_coherence, axis=1))) for r in transfer.responses if name in r.components
        )
        for name in response_components(transfer)
    }


def sigma_notes(transfer: Transfer) -> tuple[str, ...]:
    """Return where sigma of imported responses comes from, in words; empty of responses of `sweep-tf`."""
    return tuple(note for note in transfer.import_notes or () if "sigma" in note)


def response_components(transfer: Transfer) -> tuple[str, ...]:
    """Return the components to which some response was measured, in the usual order."""
    measured = {name for response in transfer.responses for name in response.components}
    return tuple(name for name in COMPONENTS if name in measured)
