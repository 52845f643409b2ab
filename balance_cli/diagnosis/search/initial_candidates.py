"""Initial candidates: effects that the two channels of one cell show before any model of the plate is fitted.

Two channels of a cell measure the same force. Where they clearly differ by a delay, a gain or a filter, one of the two
has that effect; the model of the plate decides which one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.data_tests.channel_pairs import (
    ChannelDifference,
    find_channel_differences,
)
from balance_cli.diagnosis.data_tests.channel_ratio import DifferenceKind
from balance_cli.diagnosis.search.candidates import Candidate, candidate_at, is_excluded
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.io.errors import UserError
from balance_cli.signals.run_spectrum import RunSpectrum


@dataclass(frozen=True)
class InitialCandidates:
    """Candidates of which one must be present, each started at the value that the pair gives, and their gain there."""

    candidates: tuple[Candidate, ...]
    gain: float


def initial_candidates(
    runs: Sequence[RunSpectrum], geometry: Geometry, settings: SearchSettings
) -> tuple[InitialCandidates, ...]:
    """The initial candidates for each difference of two channels, the clearest first, without declared effects."""
    groups = []
    for pair in find_channel_differences(runs, geometry, settings):
        both = (False, True)
        proposed = [_candidate(pair, *kind, in_first, geometry) for kind in pair.kinds for in_first in both]
        possible = tuple(
            candidate
            for candidate in proposed
            if candidate is not None
            and not is_excluded(candidate.effect.name, candidate.placed_effect.where, settings.excluded)
        )
        if possible and pair.gain > settings.data_tests.channel_pairs.min_kind_gain:
            groups.append(InitialCandidates(possible, pair.gain))
    return tuple(sorted(groups, key=lambda group: -group.gain))


def _candidate(
    pair: ChannelDifference, kind: DifferenceKind, value: float, in_first: bool, geometry: Geometry
) -> Candidate | None:
    """The effect in the first or the second channel that makes the pair's difference; None where none does."""
    if kind.ratio.one_sided and kind.in_first != in_first:
        return None
    name, where = kind.effect.name, (pair.first if in_first else pair.second,)
    start = kind.ratio.start(-value if in_first and not kind.ratio.one_sided else value)
    try:
        candidate = candidate_at(name, where, geometry)
    except UserError:
        return None
    declared = {(item.name, item.where) for item in geometry.effects}
    return None if (name, where) in declared else Candidate(candidate.placed_effect, (start,))
