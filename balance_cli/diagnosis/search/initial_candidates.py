"""Initial candidates: effects that the two channels of one cell show before any model of the plate is fitted.

Two channels of a cell measure the same force. Where they clearly differ by a delay, a gain or a filter, one of the two
has that effect; the model of the plate decides which one. Where all cells show the same difference between the same two
groups of channels, one group has the effect: one late box is likelier than six late channels.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from balance_cli.campaign.rig.channel_groups import channel_groups
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.data_tests.channel_pairs import (
    ChannelDifference,
    channel_pairs,
    difference_gain,
    find_channel_differences,
)
from balance_cli.diagnosis.data_tests.channel_ratio import DifferenceKind
from balance_cli.diagnosis.search.candidates import Candidate, candidate_at, is_excluded
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.diagnosis.significance import gain_p_value
from balance_cli.io.errors import UserError
from balance_cli.signals.run_spectrum import RunSpectrum


@dataclass(frozen=True)
class InitialCandidates:
    """Candidates of which one must be present, each started at the value that the pair gives, and their gain there.

    `reason`: what shows them. Where they are not `is_certain`, the whole rig must be described better with one of them.
    """

    candidates: tuple[Candidate, ...]
    gain: float
    reason: str = "two channels of one cell differ this way"
    is_certain: bool = True


@dataclass(frozen=True)
class _CommonDifference:
    """The same difference in every pair of a group: its effect, the values in the channels of the group, its gain."""

    group: str
    kind: DifferenceKind
    value: float
    pairs: tuple[ChannelDifference, ...]

    @property
    def gain(self) -> float:
        """The gain of all pairs."""
        return sum(pair.gain for pair in self.pairs)


def initial_candidates(
    runs: Sequence[RunSpectrum], geometry: Geometry, settings: SearchSettings
) -> tuple[InitialCandidates, ...]:
    """The initial candidates for each difference of two channels, the clearest first, without declared effects."""
    least_gain = settings.data_tests.channel_pairs.min_kind_gain
    differences = [item for item in find_channel_differences(runs, geometry, settings) if item.gain > least_gain]
    sets, explained = list[InitialCandidates](), list[ChannelDifference]()
    for common in _common_differences(runs, differences, geometry, settings):
        if not any(pair in explained for pair in common.pairs):
            possible = _possible(_group_candidates(common, geometry), settings)
            sets += [InitialCandidates(possible, common.gain)] if possible else []
            explained += common.pairs if possible else ()
    for pair in differences:
        proposed = [_candidate(pair, kind, value, first, geometry) for kind, value, _ in pair.kinds for first in (0, 1)]
        possible = _possible(proposed, settings)
        if possible and pair not in explained:
            sets.append(InitialCandidates(possible, pair.gain))
    return tuple(sorted(sets, key=lambda item: -item.gain))


def _possible(proposed: Iterable[Candidate | None], settings: SearchSettings) -> tuple[Candidate, ...]:
    """The proposed candidates that exist and are not excluded."""
    return tuple(
        candidate
        for candidate in proposed
        if candidate is not None
        and not is_excluded(candidate.effect.name, candidate.placed_effect.where, settings.excluded)
    )


def _candidate(
    pair: ChannelDifference, kind: DifferenceKind, value: float, in_first: bool | int, geometry: Geometry
) -> Candidate | None:
    """The effect in the first or the second channel that makes the pair's difference; None where none does."""
    if kind.ratio.one_sided and kind.in_first != in_first:
        return None
    return _started_at(kind, pair.first if in_first else pair.second, _value_in(kind, value, bool(in_first)), geometry)


def _value_in(kind: DifferenceKind, value: float, in_first: bool) -> float:
    """The parameter of the effect in the first or the second channel of a pair whose ratio has this value."""
    return -value if in_first and not kind.ratio.one_sided else value


def _started_at(kind: DifferenceKind, place: str, value: float, geometry: Geometry) -> Candidate | None:
    """The effect at a channel or group, started at a value; None where it cannot be there, or is declared."""
    name, where = kind.effect.name, (place,)
    try:
        candidate = candidate_at(name, where, geometry)
    except UserError:
        return None
    declared = {(item.name, item.where) for item in geometry.effects}
    return None if (name, where) in declared else Candidate(candidate.placed_effect, (kind.ratio.start(value),))


# ---- differences that all channels of a group show -------------------------------------------------------------------


def _common_differences(
    runs: Sequence[RunSpectrum],
    differences: Sequence[ChannelDifference],
    geometry: Geometry,
    settings: SearchSettings,
) -> Iterator[_CommonDifference]:
    """Groups of which every channel differs from its partner in the same way, those of most channels first."""
    groups = channel_groups(geometry)
    for name in sorted(groups, key=lambda name: -len(groups[name])):
        members = set(groups[name])
        names = [pair for pair in channel_pairs(geometry) if len(members & set(pair)) == 1]
        pairs = tuple(item for item in differences if (item.first, item.second) in names)
        if len({(item.first, item.second) for item in pairs}) != len(pairs) or 2 * len(pairs) <= max(len(names), 2):
            continue
        common = _common_kind(name, members, pairs, settings)
        if common is not None and all(
            _fits_other_pair(runs, pair, common, pairs, geometry, settings)
            for pair in names
            if pair not in {(item.first, item.second) for item in common.pairs}
        ):
            yield replace(common, pairs=pairs)


def _common_kind(
    group: str, members: set[str], pairs: tuple[ChannelDifference, ...], settings: SearchSettings
) -> _CommonDifference | None:
    """The first kind that describes most pairs, and these with the same value in the channels of the group."""
    for kind in dict.fromkeys(kind for pair in pairs for kind, *_ in pair.kinds):
        same = [
            (pair, _value_in(kind, value, pair.first in members), spread)
            for pair in pairs
            for other, value, spread in pair.kinds
            if _is_same(other, kind, pair, members)
        ]
        values = np.array([value for _, value, _ in same])
        sigma = np.array([spread for *_, spread in same])
        if 2 * len(same) > max(len(pairs), 2) and sigma.min() > 0.0:
            weight = 1.0 / sigma**2
            mean = float(weight @ values / weight.sum())
            chi2 = float(weight @ (values - mean) ** 2)
            if gain_p_value(chi2, len(same) - 1) > settings.selection.negligible_p_value:
                return _CommonDifference(group, kind, mean, tuple(pair for pair, *_ in same))
    return None


def _is_same(other: DifferenceKind, kind: DifferenceKind, pair: ChannelDifference, members: set[str]) -> bool:
    """Whether a kind is the same effect, which can be in the channel of the group."""
    return other.effect.name == kind.effect.name and (
        not other.ratio.one_sided or other.in_first == (pair.first in members)
    )


def _fits_other_pair(
    runs: Sequence[RunSpectrum],
    names: tuple[str, str],
    common: _CommonDifference,
    clear: Sequence[ChannelDifference],
    geometry: Geometry,
    settings: SearchSettings,
) -> bool:
    """Whether the difference also describes a pair of the group that does not show it clearly by itself.

    A pair with a clear difference of its own must lose nothing that its own description gains.
    """
    in_first = names[0] in channel_groups(geometry)[common.group]
    kind = replace(common.kind, in_first=in_first and common.kind.ratio.one_sided)
    own = [pair.gain for pair in clear if (pair.first, pair.second) == names]
    gain = difference_gain(runs, geometry, names, (kind, _value_in(kind, common.value, in_first)), settings)
    return gain > sum(own) - settings.alternative_gap if own else gain > 0.0


def _group_candidates(common: _CommonDifference, geometry: Geometry) -> list[Candidate | None]:
    """The effect in the group, or its opposite in the group of the channels that it is compared with."""
    groups, kind = channel_groups(geometry), common.kind
    members = set(groups[common.group])
    compared = [pair for pair in channel_pairs(geometry) if len(members & set(pair)) == 1]
    partners = {name for pair in compared for name in pair} - members
    opposite = [name for name, others in groups.items() if set(others) == partners]
    proposed = [_started_at(kind, common.group, common.value, geometry)]
    if not kind.ratio.one_sided:
        proposed += [_started_at(kind, name, -common.value, geometry) for name in opposite]
    return proposed
