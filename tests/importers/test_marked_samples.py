"""Samples that a recorder has marked as invalid, in records of MDF 4."""

import numpy as np
import pytest

from balance_cli.importers import open_foreign

X = np.random.default_rng(8).standard_normal((3000, 2))
INVALID = np.isin(np.arange(3000), [0, 700, 701, 2999])


@pytest.mark.parametrize("as_integers", [False, True])
@pytest.mark.parametrize("compression", [0, 2])
def test_samples_that_are_marked_invalid_are_missing(tmp_path, compression, as_integers):
    """They were imported as measured values, 77 V among others."""
    asammdf = pytest.importorskip("asammdf")
    values = np.round(1000 * X).astype(np.int16) if as_integers else X
    times = np.arange(3000) / 800.0
    with asammdf.MDF(version="4.10") as file:
        marked = asammdf.Signal(values[:, 0], times, name="a", unit="V", invalidation_bits=INVALID)
        file.append([marked, asammdf.Signal(values[:, 1], times, name="b", unit="V")])
        file.save(tmp_path / "record.mf4", compression=compression)
    (group,) = open_foreign(tmp_path / "record.mf4").groups
    columns = [group.names.index(name) for name in "ab"]
    expected = values.astype(float)
    expected[INVALID, 0] = np.nan
    for begin, end in ((0, 3000), (650, 702), (701, 3000)):
        assert np.array_equal(group.read(columns, begin, end), expected[begin:end], equal_nan=True)


def test_a_channel_that_is_invalid_as_a_whole_has_no_values(tmp_path):
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(X[:, k], np.arange(3000) / 800.0, name=name) for k, name in enumerate("ab")])
        (channel,) = [channel for channel in file.groups[0].channels if channel.name == "a"]
        channel.flags |= 1  # ASAM MDF 4.1, block CN: all values invalid
        file.save(tmp_path / "record.mf4")
    (group,) = open_foreign(tmp_path / "record.mf4").groups
    read = group.read([group.names.index(name) for name in "ab"], 0, 3000)
    assert np.isnan(read[:, 0]).all() and np.array_equal(read[:, 1], X[:, 1])
