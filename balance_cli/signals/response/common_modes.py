"""Whether responses to different components have their modes in common, as those of one rig do.

A mass of the exciter beyond its force cell, or a part that was added between two sweeps, moves the modes in some of the
responses. Loads need all of them at once, and no response by itself shows that another one is of another rig.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from balance_cli.signals.response.choices import CONTRADICTING_RESPONSES
from balance_cli.signals.response.response_poles import ResponsePole, determined_poles
from balance_cli.signals.response.transfer import Transfer, response_components, response_to_component, select_channels
from balance_cli.signals.response.window_models import LOCAL_LINES
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

LARGEST_SHIFT = 0.02
"""Distance of two poles over the decay rate, from which a mode is another one: it changes a response beside the mode by
2 %. On sound rigs it is below 0.002."""
SIGMA_FACTOR = 10.0
"""Times its standard deviation that the distance has at least: on sound rigs up to 7, by the local models' error."""
SAME_SHAPE = 0.9
"""Modal assurance criterion, from which two residues are of one mode: 0.91 to 0.99 on rigs with different modes."""
SEARCHED = 0.1
"""Of the frequency, within which a mode that has moved is sought: a rig that has a fifth more of its mass."""
LEAST_DECAY = 2.0
"""Decay rate [rad/s] of a mode over the distance [Hz] of the lines, from which a local model is its: below it poles
of a sine sweep of 0.2 s were off by a third of their decay rate."""
LINE_SHARE = 0.3
"""Distance of two poles [rad/s] over that of the lines [Hz], below which local models may differ: 0.1 in that sweep."""


@dataclass(frozen=True)
class _Mode:
    """A pole in the response to a component by a run.

    Its `shape` (c,) is of size one; `spacing` [Hz] is that of the lines about it.
    """

    component: str
    run: str
    pole: ResponsePole
    spacing: float
    shape: ComplexArray

    @property
    def frequency(self) -> float:
        """Frequency [Hz] of the pole."""
        return self.pole.s.imag / (2.0 * np.pi)


def contradicting_modes(transfer: Transfer) -> Iterator[str]:
    """Yield the mode that lies farthest apart in responses to different components, where one does."""
    apart = [
        pair
        for responses in _responses_by_speed(transfer)
        for one, other in combinations(_modes_by_response(responses), 2)
        for pair in _modes_apart(one, other)
    ]
    if apart:
        first, second = max(apart, key=lambda pair: _distance(*pair))
        yield (
            f"{CONTRADICTING_RESPONSES}the mode at {first.frequency:.5g} Hz in that to {first.component} "
            f"({first.run}) lies at {second.frequency:.5g} Hz in that to {second.component} ({second.run}), "
            "as if the rig or the mass of the exciter had changed between them, or the rig depends on the level"
        )


def _responses_by_speed(transfer: Transfer) -> Iterator[list[FrequencyResponse]]:
    """The responses that are used, one for each component, where they were measured at one rotor speed."""
    used = [response_to_component(transfer, component) for component in response_components(transfer)]
    for speed in dict.fromkeys(response.rotor_speed for response in used):
        yield [response for response in used if response.rotor_speed == speed]


def _modes_by_response(responses: Sequence[FrequencyResponse]) -> Iterator[list[_Mode]]:
    """The modes of each response, with shapes in the channels that all of them have."""
    names = [name for name in responses[0].channel_names if all(name in item.channel_names for item in responses)]
    if len(responses) < 2 or not names:
        return
    alike = [select_channels(response, names) for response in responses]
    # Channels count alike, whatever their unit and noise: one that is much better shows every mode alike.
    size = np.sqrt(sum(np.mean(np.abs(item.response[:, :, 0]) ** 2, axis=0) for item in alike))
    size = np.where(size > 0.0, size, 1.0)
    for response in alike:
        poles = determined_poles(response, _peaks(response.response[:, :, 0] / size))
        modes = (_mode(response, pole, size) for pole in poles)
        yield [mode for mode in modes if -mode.pole.s.real > LEAST_DECAY * mode.spacing]


def _peaks(values: ComplexArray) -> Index:
    """The lines at which a response (k, c) has its peaks: maxima of the squares among as many lines as a model has."""
    size = np.sum(np.abs(values) ** 2, axis=1)
    return np.flatnonzero(size == maximum_filter1d(size, LOCAL_LINES, mode="nearest"))


def _mode(response: FrequencyResponse, pole: ResponsePole, size: Array) -> _Mode:
    """The mode of a pole in the response to a component, with its shape in units of the `size` (c,) of the channels."""
    lines, shape = response.frequency, pole.residue[:, 0] / size
    above = int(np.clip(np.searchsorted(lines, pole.s.imag / (2.0 * np.pi)), 1, len(lines) - 1))
    spacing = float(lines[above] - lines[above - 1])
    return _Mode(response.components[0], response.run, pole, spacing, shape / np.linalg.norm(shape))


def _modes_apart(one: Sequence[_Mode], other: Sequence[_Mode]) -> Iterator[tuple[_Mode, _Mode]]:
    """Yield modes of one shape that neither response has where the other one has it, each with the nearest."""
    alone = [mode for mode in one if not any(_is_same(mode, beside) for beside in other)]
    beside = [mode for mode in other if not any(_is_same(mode, first) for first in one)]
    for first in alone:
        moved = [mode for mode in beside if mode.run != first.run and _is_alike(first, mode)]
        if moved:
            yield first, min(moved, key=lambda mode: _distance(first, mode))


def _is_alike(one: _Mode, other: _Mode) -> bool:
    """Whether two modes have one shape and nearly one frequency."""
    is_near = abs(one.frequency - other.frequency) < SEARCHED * one.frequency
    return is_near and bool(abs(np.vdot(one.shape, other.shape)) ** 2 > SAME_SHAPE)


def _is_same(one: _Mode, other: _Mode) -> bool:
    """Whether two poles are one within their standard deviations, or nearly."""
    sigma = float(np.hypot(one.pole.sigma, other.pole.sigma))
    decay = min(-one.pole.s.real, -other.pole.s.real)
    least = max(SIGMA_FACTOR * sigma, LARGEST_SHIFT * decay, LINE_SHARE * max(one.spacing, other.spacing))
    return abs(one.pole.s - other.pole.s) < least


def _distance(one: _Mode, other: _Mode) -> float:
    """Distance of two poles over the smaller decay rate."""
    return abs(one.pole.s - other.pole.s) / min(-one.pole.s.real, -other.pole.s.real)
