"""What the channels of one cell say of each other before any model of the plate is asked.

Two channels of a cell read the same force. Where they differ by a delay, a gain or a filter beyond doubt, one of the
two has it; which one, the plate decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.data_tests.channel_pairs import (
    MIN_DIFFERENCE_GAIN,
    ChannelDifference,
    find_channel_differences,
)
from balance_cli.diagnosis.search.candidates import Candidate, candidate_at
from balance_cli.io.errors import UserError
from balance_cli.signals.run_spectrum import RunSpectrum


@dataclass(frozen=True)
class InitialCandidates:
    """Candidates of which one must be there, each begun at the value that the pair gives; what it gains there."""

    candidates: tuple[Candidate, ...]
    gain: float


def initial_candidates(runs: Sequence[RunSpectrum], geometry: Geometry) -> tuple[InitialCandidates, ...]:
    """One for each way in which a pair of channels differs, the clearest first; none that the geometry declares."""
    found = []
    for pair in find_channel_differences(runs, geometry):
        each = [_candidate(pair, *kind, own, geometry) for kind in pair.kinds for own in (1, 0)]
        chosen = tuple(one for one in each if one is not None)
        if chosen and pair.gain > MIN_DIFFERENCE_GAIN:
            found.append(InitialCandidates(chosen, pair.gain))
    return tuple(sorted(found, key=lambda seed: -seed.gain))


def _candidate(pair: ChannelDifference, kind: str, value: float, which: int, geometry: Geometry) -> Candidate | None:
    """The effect at the first (0) or second (1) channel that makes the pair's difference; None where it cannot."""
    channel = (pair.first, pair.second)[which]
    sign = 1.0 if which == 1 else -1.0
    if kind == "delay":
        name, start = "time-delay", {"delay": sign * value}
    elif kind == "gain":
        name, start = "channel-gain", {"gain": float(np.exp(sign * value))}
    elif kind.endswith("BA"[1 - which]) and kind.startswith("low-pass"):
        name, start = "low-pass", {"1/cutoff": 2 * np.pi * value}
    elif kind.endswith("BA"[1 - which]) and kind.startswith("high-pass"):
        name, start = "high-pass", {"cutoff": value / (2 * np.pi)}
    else:
        return None
    try:
        one = candidate_at(name, (channel,), geometry)
    except UserError:
        return None
    taken = {(item.name, item.where) for item in geometry.effects}
    return None if (name, (channel,)) in taken else Candidate(one.one, (start,))
