"""The noise with which a campaign is planned: assumed, declared in the hall, or measured in runs already made."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.channel import Channel
from balance_cli.signals.run_spectrum import RunSpectrum
from balance_cli.simulation.noise import DeclaredNoise, Noise

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ChannelNoise(Noise):
    """Noise with a standard deviation [V] of its own for some channels, by name; `source` says where it is from."""

    by_channel: Mapping[str, float] = field(default_factory=dict)
    source: str = "assumed, that of the recorded campaign of the rig RTS-6"

    def sigma_of_channel(self, channel: Channel) -> float:
        """Standard deviation [V] of a channel in a record."""
        return self.by_channel.get(channel.name, super().sigma_of_channel(channel))

    def scale_by(self, factor: float) -> ChannelNoise:
        """The noise multiplied by `factor`; with 0 rounding is left out, too."""
        scaled = super().scale_by(factor)
        assert isinstance(scaled, ChannelNoise)
        return replace(scaled, by_channel={name: factor * value for name, value in self.by_channel.items()})

    def declared(self, channels: Iterable[Channel]) -> DeclaredNoise:
        """The noise of each channel by name, as a plan keeps it."""
        by_channel = {channel.name: self.sigma_of_channel(channel) for channel in channels}
        known = {name: value for name, value in by_channel.items() if value > 0}
        return DeclaredNoise(channels=known, load=self.load or None)


PLANNED_SOURCE = "that of the plan"


def planning_noise(
    declared: DeclaredNoise | None,
    lines: Sequence[RunSpectrum],
    sample_rate: float,
    source: str = "declared in the hall file",
) -> ChannelNoise:
    """The noise of a plan: that of periodic runs already made, else what the hall declares, else the assumed one."""
    noise = ChannelNoise()
    if declared is not None:
        given = {name: value for name in ("strain", "piezo", "torque", "load") if (value := getattr(declared, name))}
        noise = replace(noise, **given, by_channel=dict(declared.channels), source=source)
    measured = measured_noise(lines, sample_rate)
    if measured is None:
        return noise
    by_channel, load = measured
    return replace(noise, by_channel={**noise.by_channel, **by_channel}, load=load, source="measured in the runs given")


def measured_noise(lines: Iterable[RunSpectrum], sample_rate: float) -> tuple[dict[str, float], float] | None:
    """Standard deviation of a sample of each channel, and of the loads, at a sample rate [Hz] by white noise.

    None without a periodic run. Of white noise of variance s^2 at f_s samples per second the amplitude of a line over
    the time t has the variance 4 s^2 / (f_s t). The median over the lines is not raised by a line of the mains.
    """
    channels: dict[str, list[float]] = {}
    loads: list[float] = []
    for run in lines:
        if run.window is None:
            continue
        seconds = run.window.stop - run.window.start
        variance = np.real(np.diagonal(run.window.covariance, axis1=1, axis2=2)) * seconds[:, None] * sample_rate / 4.0
        variance = variance[run.frequency > 0]
        for i, name in enumerate(run.channel_names):
            channels.setdefault(name, []).append(_finite_median(variance[:, i]))
        loads += [_finite_median(column) for column in variance[:, len(run.channel_names) :].T]
    if not channels:
        return None
    sigma = {name: float(np.sqrt(np.nanmean(values))) for name, values in channels.items() if np.isfinite(values).any()}
    known = [value for value in loads if np.isfinite(value)]
    return sigma, float(np.sqrt(np.mean(known))) if known else 0.0


def _finite_median(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else float("nan")


def channel_sigma(noise: Noise, channels: Sequence[Channel]) -> Array:
    """Standard deviation (c,) [V] of a sample of each channel, rounding included (a twelfth of its step squared)."""
    sigma = np.array([noise.sigma_of_channel(channel) for channel in channels])
    return np.asarray(np.sqrt(sigma**2 + noise.quantum**2 / 12.0))
