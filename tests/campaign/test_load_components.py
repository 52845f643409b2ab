"""Load components of the user's own, and geometries that are only calibrated."""

import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.campaign.rig.geometry_checks import missing_mechanics
from balance_cli.campaign.rig.geometry_file import geometry_from_dict, geometry_to_dict
from balance_cli.campaign.rig.load_components import load_components
from balance_cli.cli import balance
from balance_cli.io.errors import UserError

MINIMAL = {"format": "balance-geometry/1", "name": "m", "rig": "r", "channels": [{"name": "a"}, {"name": "b"}]}
FORCE_BALANCE = [
    {"name": "N1", "direction": [0, 0, -1], "position": [0.2, 0, 0]},
    {"name": "N2", "direction": [0, 0, -1], "position": [-0.3, 0, 0]},
    {"name": "Y1", "direction": [0, 1, 0], "position": [0.1, 0, 0]},
    {"name": "Y2", "direction": [0, 1, 0], "position": [-0.1, 0, 0]},
    {"name": "A", "direction": [-1, 0, 0]},
    {"name": "Rm", "moment": [1, 0, 0]},
]


def geometry(**keys):
    return geometry_from_dict({**MINIMAL, **keys})


def test_a_geometry_with_channels_alone_carries_six_loads() -> None:
    rig = geometry()
    assert load_components(rig).names == ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
    assert geometry_from_dict(geometry_to_dict(rig)) == rig
    assert missing_mechanics(rig) == ("bodies", "cells", "channels[0].cell", "channels[1].cell", "damping_ratio")


def test_rated_loads_name_the_components() -> None:
    assert load_components(geometry(rated_loads={"Fz": 100, "Fx": 50})).names == ("Fx", "Fz")
    with pytest.raises(UserError, match=r"rated_loads.Fq: `Fq` is not a component"):
        geometry(components=["Fx"], rated_loads={"Fq": 1.0})


def test_force_balance_format_is_statics() -> None:
    """N1 at 0.2 m gives Fz -1 and My +0.2 (r x F); hub loads and back is the identity."""
    components = load_components(geometry(components=FORCE_BALANCE))
    assert components.units == ("N", "N", "N", "N", "N", "N m")
    assert components.to_hub[0] == pytest.approx([0, 0, -1, 0, 0.2, 0])
    assert components.to_hub[2] == pytest.approx([0, 1, 0, 0, 0, 0.1])
    assert components.to_hub @ components.from_hub == pytest.approx(np.eye(6), abs=1e-12)


def test_moment_balance_format_is_moments_about_stations() -> None:
    """A force Fz at the hub has the moment -(x_hub - x_p) Fz about y at a station p."""
    stations = [{"name": f"M{i}", "moment": [0, 1, 0], "position": [x, 0, 0]} for i, x in ((1, 0.1), (2, -0.1))]
    components = load_components(geometry(components=[*stations, "Fx"]))
    hub = np.array([[0.0, 0, 50.0, 0, 3.0, 0]])
    assert components.from_hub_loads(hub)[0] == pytest.approx([3.0 + 0.1 * 50.0, 3.0 - 0.1 * 50.0, 0.0])
    assert components.remaining_hub_loads(np.vstack([0 * hub, hub])).shape[1] == 0
    assert components.remaining_hub_loads(np.array([[0.0] * 6, [0, 7.0, 0, 0, 0, 0]]))[:, 0] == pytest.approx([0, 7.0])


@pytest.mark.parametrize(
    ("components", "words"),
    [
        ([{"name": "N1"}], "give `direction"),
        ([{"name": "Fx", "direction": [0, 1, 0]}], "is a hub load"),
        (["Fx", "Fx"], "already that of"),
        ([{"name": "A", "direction": [1, 0, 0]}, "Fx"], "depend on each other"),
        ([], "too few"),
        ([{"name": "N 1", "direction": [1, 0, 0]}], "pattern"),
        (
            [
                {"name": "N", "direction": [0, 0, 1], "position": [1, 0, 0]},
                {"name": "M", "moment": [1, 0, 0], "position": [1, 0, 0]},
            ],
            "mixed",
        ),
    ],
)
def test_faults_are_named(components, words) -> None:
    with pytest.raises(UserError, match=words):
        geometry(components=components)


def test_units_of_readings() -> None:
    rig = geometry(channels=[{"name": "a", "unit": "mV/V"}, {"name": "b"}, {"name": "c", "unit": "counts"}])
    assert [channel.reading_unit for channel in rig.channels] == ["V/V", "V", "1"]
    with pytest.raises(UserError, match="is a unit of N"):
        geometry(channels=[{"name": "a", "unit": "lbf"}])


def test_other_commands_say_what_is_missing(tmp_path) -> None:
    path = tmp_path / "g.yaml"
    path.write_text("format: balance-geometry/1\nname: m\nrig: r\nchannels: [{name: a}]\n")
    done = CliRunner().invoke(balance, ["modes", "-g", str(path)])
    assert done.exit_code == 2
    assert "`bodies`, `cells`, `channels[0].cell`, `damping_ratio` are missing" in done.output
    assert CliRunner().invoke(balance, ["check", str(path)]).exit_code == 0
