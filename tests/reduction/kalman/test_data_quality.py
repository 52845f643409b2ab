"""Which samples a filter can use: stretches, what is said of them, and that no bad sample is ever read."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from balance_cli.campaign.recording.channel_health import live_channels
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.io.errors import UserError
from balance_cli.reduction.kalman.data_quality import (
    LONGEST_GAP,
    MAX_BAD_SHARE,
    MERGE_TIME,
    RECOVERY_TIME,
    DataQuality,
    assess_data_quality,
)
from balance_cli.reduction.kalman.segments import Segment
from tests.support.simulation_rig import rig_geometry

RATE = 400.0
SAMPLES = 4000
LIMIT = 5.0
GEOMETRY = rig_geometry()
GEOMETRY = GEOMETRY.model_copy(
    update={"channels": tuple(channel.model_copy(update={"range": LIMIT}) for channel in GEOMETRY.channels)}
)
NAMES = GEOMETRY.channel_names
EVERY = tuple(range(len(NAMES)))
BEFORE, AFTER = 1, int(np.ceil(RECOVERY_TIME * RATE))
"""Samples left out beside bad ones."""

Array = NDArray[np.float64]


def _quiet() -> Array:
    return 0.1 * np.random.default_rng(0).standard_normal((SAMPLES, len(NAMES)))


def _found(y: Array) -> DataQuality:
    source = MemorySource(y, None)
    run = Run("r", "R", "wind", NAMES, len(y), source, has_loads=False, sample_rate=RATE)
    return assess_data_quality(run, GEOMETRY, live_channels(run, GEOMETRY))


def test_a_sound_record_is_one_stretch():
    found = _found(_quiet())
    assert found == DataQuality(NAMES, (Segment(0, SAMPLES, EVERY),), ())
    assert found.spans == ((0, SAMPLES),)
    assert found.gaps == ()


@pytest.mark.parametrize("bad", [np.nan, np.inf, LIMIT, -LIMIT])
def test_a_channel_is_left_out_where_it_is_bad(bad):
    y = _quiet()
    y[1000:1040, 2] = bad
    found = _found(y)
    low, high = 1000 - BEFORE, 1040 + AFTER
    others = (0, 1, 3)
    assert found.names == NAMES
    assert found.segments == (Segment(0, low, EVERY), Segment(low, high, others), Segment(high, SAMPLES, EVERY))
    assert found.spans == ((0, low), (high, SAMPLES))
    assert found.gaps == ()
    assert found.notes == (f"channel {NAMES[2]} not used from {low / RATE:.3f} to {high / RATE:.3f} s",)


def test_a_gap_is_where_all_channels_are_bad():
    y = _quiet()
    y[1000:1040] = np.nan
    y[990:1060, 1] = np.nan
    found = _found(y)
    gap = Segment(1000 - BEFORE, 1040 + AFTER, ())
    assert found.gaps == (gap,)
    assert found.notes[0] == f"gap from {gap.start / RATE:.3f} to {gap.stop / RATE:.3f} s bridged"
    assert found.notes[1] == f"channel {NAMES[1]} not used from {(990 - BEFORE) / RATE:.3f} to 2.655 s"
    assert len(found.notes) == 2


def test_a_gap_is_told_of_once_not_channel_by_channel():
    y = _quiet()
    y[1000:1040] = np.nan
    assert len(_found(y).notes) == 1


def test_places_close_to_each_other_are_joined():
    apart = int(MERGE_TIME * RATE)
    y = _quiet()
    y[[1000, 1000 + apart - 1], 0] = np.nan
    assert len(_found(y).segments) == 3
    y = _quiet()
    y[[1000, 1000 + apart + BEFORE + AFTER + 1], 0] = np.nan
    assert len(_found(y).segments) == 5


def test_bad_samples_at_either_end_are_left_out():
    y = _quiet()
    y[0, 1], y[-1, 3] = np.nan, np.nan
    found = _found(y)
    assert found.segments[0] == Segment(0, 1 + AFTER, (0, 2, 3))
    assert found.segments[-1] == Segment(SAMPLES - 1 - BEFORE, SAMPLES, (0, 1, 2))


def test_a_channel_that_is_mostly_bad_is_left_out_of_all_of_the_record():
    y = _quiet()
    y[: int(1.01 * MAX_BAD_SHARE * SAMPLES), 0] = np.nan
    found = _found(y)
    assert found.names == NAMES[1:]
    assert found.segments == (Segment(0, SAMPLES, (0, 1, 2)),)


def test_a_channel_bad_in_many_places_is_left_out_of_all_of_the_record():
    y = _quiet()
    y[100::400, 0] = np.nan
    found = _found(y)
    assert found.names == NAMES[1:]
    assert len(found.segments) == 1


def test_a_long_gap_is_refused():
    length = int(LONGEST_GAP * RATE)
    y = _quiet()
    y[1000 : 1000 + length - AFTER - BEFORE] = np.nan
    assert len(_found(y).gaps) == 1
    y[1000 : 1000 + length] = np.nan
    with pytest.raises(UserError, match="a gap from"):
        _found(y)


def test_a_record_of_bad_channels_alone_is_refused():
    y = _quiet()
    y[::2] = np.nan
    with pytest.raises(UserError, match="no channel is usable"):
        _found(y)


def test_channels_that_are_never_good_together_are_refused():
    """Each is bad in a small part of the record, but at any time one of them is."""
    geometry = rig_geometry()
    first = geometry.channels[0]
    many = tuple(first.model_copy(update={"name": f"c{i}"}) for i in range(6))
    y = 0.1 * np.random.default_rng(1).standard_normal((SAMPLES, 6))
    for i, (low, high) in enumerate(zip(range(0, SAMPLES, 700), [*range(700, SAMPLES, 700), SAMPLES], strict=True)):
        y[low:high, i] = np.nan
    run = Run("r", "R", "wind", tuple(c.name for c in many), SAMPLES, MemorySource(y, None), sample_rate=RATE)
    geometry = geometry.model_copy(update={"channels": many})
    with pytest.raises(UserError, match="at no time are all channels good"):
        assess_data_quality(run, geometry, live_channels(run, geometry))


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, SAMPLES - 1), st.integers(1, 150), st.sets(st.sampled_from(EVERY), min_size=1)),
        max_size=8,
    )
)
def test_no_bad_sample_is_read_and_none_is_lost(faults):
    y = _quiet()
    for start, length, channels in faults:
        y[start : start + length, list(channels)] = np.nan
    try:
        found = _found(y)
    except UserError:
        return
    edges = [(s.start, s.stop) for s in found.segments]
    assert edges[0][0] == 0
    assert edges[-1][1] == SAMPLES
    assert all(stop == start for (_, stop), (start, _) in pairwise(edges))
    assert all(one.channels != other.channels for one, other in pairwise(found.segments))
    columns = [NAMES.index(name) for name in found.names]
    bad = ~np.isfinite(y[:, columns])
    near = np.array([np.convolve(column, np.ones(2 * int(MERGE_TIME * RATE)), "same") > 0 for column in bad.T]).T
    for s in found.segments:
        assert not bad[s.start : s.stop, list(s.channels)].any()
        unread = sorted(set(range(len(columns))) - set(s.channels))
        assert near[s.start : s.stop, unread].all()
    assert bool(found.notes) == (len(found.segments) > 1)
