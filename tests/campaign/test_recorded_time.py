"""When a run was recorded: times in ISO 8601, and what is said of others."""

import pytest

from balance_cli.campaign.recording.recorded_time import recorded_time, unreadable_time
from balance_cli.cli.watching.zeros import ZeroRun, ZeroRuns


@pytest.mark.parametrize("text", ["2024-13-05T10:00:00", "05.03.2024", "yesterday"])
def test_what_is_no_time_is_named(text):
    """Such a run was ordered by the times of the files without a word."""
    assert recorded_time(text) is None and unreadable_time(text).startswith(f"`recorded` is `{text}`, which is no time")


@pytest.mark.parametrize("text", [None, "", "2024-12-05", "2024-12-05T10:00:00+01:00"])
def test_times_and_none_are_not(text):
    assert unreadable_time(text) == ""


def test_the_zero_of_such_a_run_is_named():
    class Run:
        name, recorded = "zero-1", "2024-12-05T09:00:00"

    zeros = ZeroRuns()
    assert zeros.warning("wind-1", "2024-13-05") == ""
    zeros.add(ZeroRun(Run(), None))
    assert zeros.warning("wind-1", "2024-13-05").endswith("and its zero is zero-1, the newest file")
    assert zeros.warning("wind-1", "2024-12-06") == ""
