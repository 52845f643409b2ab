"""A delay of all channels is told to look the same as loads that are early: they differ in wind-on loads alone."""

import pytest

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.conclusions import alike_in_all
from balance_cli.model.placed_effects import place_effect
from tests.support.rigs import rotor_balance


def strain_only() -> Geometry:
    content = rotor_balance().model_dump(mode="json", exclude_none=True)
    content["channels"] = [channel for channel in content["channels"] if "strain" in channel["name"]]
    del content["torque_meter"]
    return Geometry.model_validate(content)


@pytest.mark.parametrize(
    ("geometry", "name", "place", "is_common"),
    [
        (rotor_balance(), "time-delay", "all", True),
        (strain_only(), "time-delay", "strain", True),
        (rotor_balance(), "time-delay", "strain", False),
        (rotor_balance(), "time-delay", "x.piezo", False),
        (rotor_balance(), "channel-gain", "strain", False),
    ],
)
def test_a_delay_of_all_channels_may_be_one_of_the_loads(
    geometry: Geometry, name: str, place: str, is_common: bool
) -> None:
    """Loads 3 ms late were a delay of -3 ms of all channels, which turns 1/rev by 20 deg, without an alternative."""
    alike = alike_in_all(place_effect(name, (place,), geometry), geometry)
    assert (alike is not None) is is_common
    if alike is not None:
        name, place = alike.label.split("@")
        assert place_effect(name, (place,), geometry).label == alike.label and alike.label in alike.separated_by
