"""Whether responses to one component from several sweeps agree: one is used, and nothing else would show it wrong.

A rig that depends on the level shows it here, too, and then the response is that of no load in flight for sure.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.percent import percent_text
from balance_cli.signals.response.choices import CONTRADICTING_RESPONSES
from balance_cli.signals.response.transfer import (
    Transfer,
    response_components,
    response_to_component,
    select_channels,
    select_component,
)
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LARGEST_DIFFERENCE = 0.01
"""Of the response, rms over lines and channels in units of their noise: what the cross-checks of sweeps promise."""
NOISE_FACTOR = 3.0
"""Times its noise that a difference has at least."""
EXPLAINED_SHARE = 0.9
"""Of the squared difference, that a factor or a delay explains where it is named."""
FEWEST_LINES = 8
"""Lines in common from which two responses are compared."""
MOST_DELAYS = 1001
"""Delays that are tried, the smallest first: ten periods of the highest line to either side."""


@dataclass(frozen=True)
class _Pair:
    """Values (k, c) of a response and of another one at common frequencies (k,) [Hz], the first of mean square one."""

    frequency: Array
    first: ComplexArray
    second: ComplexArray
    noise: float

    @property
    def difference(self) -> float:
        """Rms difference over the rms of the first."""
        return float(np.sqrt(np.mean(np.abs(self.second - self.first) ** 2)))


def contradicting_responses(transfer: Transfer) -> Iterator[str]:
    """Yield what sweeps at one rotor speed say differently of the response to a component, beyond their noise."""
    for component in response_components(transfer):
        used = response_to_component(transfer, component)
        alone = [select_component(item, component) for item in transfer.responses if component in item.components]
        for one, other in combinations(alone, 2):
            if used.run not in (one.run, other.run) or one.rotor_speed != other.rotor_speed:
                continue
            first, second = (one, other) if one.run == used.run else (other, one)
            pair = _pair(first, second)
            if pair is not None and pair.difference > max(LARGEST_DIFFERENCE, NOISE_FACTOR * pair.noise):
                runs = f"that to {component} in {second.run} differs from that in {first.run}, which is used"
                yield f"{CONTRADICTING_RESPONSES}{runs}, by {percent_text(pair.difference)} %{_explanation(pair)}"


def _pair(first: FrequencyResponse, second: FrequencyResponse) -> _Pair | None:
    """Two responses at the lines and channels that they have in common; None where these are few."""
    names = [name for name in first.channel_names if name in second.channel_names]
    # Lines of equal periods are equal but for rounding.
    frequency, at, beside = np.intersect1d(first.frequency.round(6), second.frequency.round(6), return_indices=True)
    if len(frequency) < FEWEST_LINES or not names:
        return None
    a, b = (select_channels(item, names) for item in (first, second))
    x, y = a.response[at, :, 0], b.response[beside, :, 0]
    variance = _variance(a)[at] + _variance(b)[beside]
    sigma = np.maximum(np.sqrt(np.median(variance, axis=0)), np.finfo(float).tiny)
    # Channels count by what they read above their noise; the whole has the size one.
    size = sigma * np.sqrt(np.mean(np.abs(x / sigma) ** 2))
    return _Pair(frequency, x / size, y / size, float(np.sqrt(np.mean(variance / size**2))))


def _variance(response: FrequencyResponse) -> Array:
    """Variance (k, c) of the response to its only component."""
    channels = np.real(np.diagonal(response.channel_covariance, axis1=1, axis2=2))
    return np.asarray(channels * np.real(response.load_covariance[:, 0, 0])[:, None])


def _explanation(pair: _Pair) -> str:
    """The factor or the delay that explains a difference, in words; else what may."""
    cross = np.sum(pair.second * pair.first.conj(), axis=1)
    factor = float(cross.real.sum() / np.sum(np.abs(pair.first) ** 2))
    delay = _delay(pair.frequency, cross)
    late = np.exp(-2j * np.pi * pair.frequency * delay)[:, None]
    left = {
        f", as by a factor of {factor:.4g}": factor * pair.first,
        f", as by a delay of {1e3 * delay:.3g} ms": late * pair.first,
    }
    unexplained = {words: float(np.mean(np.abs(pair.second - value) ** 2)) for words, value in left.items()}
    words = min(unexplained, key=lambda each: unexplained[each])
    if unexplained[words] < (1.0 - EXPLAINED_SHARE) * pair.difference**2:
        return words
    return ": the rig, the exciter or a channel differs between them, or the rig depends on the level"


def _delay(frequency: Array, cross: ComplexArray) -> float:
    """The delay [s] that turns the cross products (k,) of two responses as they are turned."""
    step = float(np.min(np.diff(frequency)))
    # Up to half a turn from line to line, on a grid that is fine against the highest line.
    delays = np.arange(-0.5 / step, 0.5 / step, 0.02 / frequency[-1])
    delays = delays[np.argsort(np.abs(delays), kind="stable")][:MOST_DELAYS]
    match = np.real(np.exp(2j * np.pi * np.outer(delays, frequency)) @ cross)
    best = delays[int(np.argmax(match))]
    turned = np.angle(cross * np.exp(2j * np.pi * frequency * best))
    weight = np.abs(cross)
    return float(best - np.sum(weight * frequency * turned) / (2.0 * np.pi * np.sum(weight * frequency**2)))
