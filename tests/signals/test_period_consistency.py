"""A multisine whose loads do not repeat after its stated period has a wrong period or sample rate."""

from dataclasses import replace

import pytest

from balance_cli.campaign.recording.attribute_checks import kind_faults
from balance_cli.signals.period_consistency import period_faults


def test_sweeps_as_recorded_repeat(campaign):
    assert [fault for run in campaign.runs for fault in period_faults(run)] == []


@pytest.mark.parametrize("factor", [0.8, 0.99, 1.01, 1.25])
def test_a_wrong_sample_rate_is_found_with_the_time_after_which_the_loads_repeat(campaign, factor):
    """`check` had no word for it."""
    sweep = campaign.runs_of_kind("sweep")[0]
    (fault,) = period_faults(replace(sweep, sample_rate=factor * sweep.sample_rate))
    assert f"but after {sweep.period / factor:.3g}"[:14] in fault.fault
    assert "sample_rate" in fault.remedy


def test_a_speed_in_revolutions_per_minute_is_named_where_the_sample_rate_excludes_it():
    attributes = {"kind": "wind", "sample_rate": 800.0, "rotor_speed": 17.45 * 60}
    (fault,) = kind_faults(attributes)
    assert "is 1047." in str(fault) and "1/min divided by 60" in str(fault)
    (fault,) = kind_faults({**attributes, "rotor_speed": 1e6})
    assert "1/min" not in str(fault)
