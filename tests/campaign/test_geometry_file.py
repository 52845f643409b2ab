"""Geometry files: sound ones survive reading and writing, and every fault is named by place and remedy."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_checks import unrestrained_motion
from balance_cli.campaign.rig.geometry_file import (
    geometry_digest,
    geometry_from_dict,
    geometry_to_dict,
    load_geometry,
    read_geometry,
    save_geometry,
)
from balance_cli.campaign.rig.mass_properties import metric_side
from balance_cli.io.errors import UserError
from balance_cli.io.validation import dotted_place
from tests.support.geometries import declarations
from tests.support.measured_data import SHARED

ROOT = Path(__file__).parents[2]
QUICK = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
JUNK = st.none() | st.booleans() | st.integers(-3, 3) | st.text(max_size=3) | st.just([]) | st.just({}) | st.just([[]])


def rts() -> dict[str, Any]:
    return geometry_to_dict(load_geometry(ROOT / "configs" / "rts-6.yaml"))


def faults_of(tmp_path: Path, text: str) -> list[UserError]:
    path = tmp_path / "geometry.yaml"
    path.write_text(text, encoding="utf-8")
    faults = list(read_geometry(path)[1])
    assert all(fault.file == str(path) and fault.fault and fault.remedy for fault in faults)
    return faults


def faults_after(tmp_path: Path, change: Any) -> list[UserError]:
    declared = rts()
    change(declared)
    return faults_of(tmp_path, yaml.safe_dump(declared))


@QUICK
@given(declarations())
def test_a_sound_geometry_survives_writing_and_reading(tmp_path: Path, declared: dict[str, Any]) -> None:
    geometry = geometry_from_dict(declared)
    path = tmp_path / "geometry.yaml"
    save_geometry(path, geometry)
    again = load_geometry(path)
    assert again == geometry
    assert geometry_digest(again) == geometry_digest(geometry)
    assert geometry_from_dict(geometry_to_dict(geometry)) == geometry


@QUICK
@given(declarations(), st.randoms(use_true_random=False))
def test_content_counts_and_not_wording(declared: dict[str, Any], random: Any) -> None:
    def shuffled(value: Any) -> Any:
        if not isinstance(value, dict):
            return [shuffled(item) for item in value] if isinstance(value, list) else value
        keys = list(value)
        random.shuffle(keys)
        return {key: shuffled(value[key]) for key in keys}

    digest = geometry_digest(geometry_from_dict(declared))
    assert geometry_digest(geometry_from_dict(shuffled(declared))) == digest
    declared["bodies"][0]["mass"] = np.nextafter(declared["bodies"][0]["mass"], np.inf)
    assert geometry_digest(geometry_from_dict(declared)) != digest


@QUICK
@given(st.data())
def test_a_damaged_geometry_is_read_or_refused(tmp_path: Path, data: st.DataObject) -> None:
    declared = part = rts()
    for _ in range(data.draw(st.integers(0, 3))):
        keys = list(part) if isinstance(part, dict) else list(range(len(part)))
        inner = part[data.draw(st.sampled_from(keys))]
        if not isinstance(inner, dict | list) or not inner:
            break
        part = inner
    key = data.draw(st.sampled_from(list(part) if isinstance(part, dict) else list(range(len(part)))))
    if data.draw(st.booleans()):
        del part[key]
    else:
        part[key] = data.draw(JUNK)
    path = tmp_path / "geometry.yaml"
    path.write_text(yaml.safe_dump(declared), encoding="utf-8")
    geometry, faults = read_geometry(path)
    assert isinstance(geometry, Geometry) or faults
    assert all(isinstance(fault, UserError) and str(path) in str(fault) for fault in faults)


@QUICK
@given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
def test_any_bytes_are_read_or_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "geometry.yaml"
    path.write_bytes(b"format: balance-geometry/1\n" + content)
    assert read_geometry(path)[1]


def test_the_configured_rig_is_the_one_of_the_campaign() -> None:
    campaign = SHARED / "campaign" / "geometry.yaml"
    if not campaign.exists():
        pytest.skip("the campaign's own geometry is not here")
    assert geometry_digest(load_geometry(ROOT / "configs" / "rts-6.yaml")) == geometry_digest(load_geometry(campaign))


def test_a_balance_of_one_freedom_needs_no_more_than_one_cell() -> None:
    geometry = load_geometry(ROOT / "configs" / "one-dof.yaml")
    assert (geometry.freedom, geometry.torque_meter, geometry.rotor) == (("z",), None, None)


@pytest.mark.parametrize(
    ("where", "key", "nearest"),
    [
        ((), "dampingratio", "damping_ratio"),
        (("cells", 3), "stifness", "stiffness"),
        (("bodies", 1), "mas", "mass"),
        (("channels", 0), "low_pass", "lowpass"),
        (("acquisition", "filter"), "cut_off", "cutoff"),
        (("tolerances",), "center_of_gravity", "centre_of_gravity"),
        (("torque_meter",), "stiff", "stiffness"),
    ],
)
def test_an_unknown_key_comes_first_with_the_nearest_known_one(
    tmp_path: Path, where: tuple[Any, ...], key: str, nearest: str
) -> None:
    def change(declared: Any) -> None:
        for step in where:
            declared = declared[step]
        declared[key] = declared.pop(nearest, 1.0)

    first = faults_after(tmp_path, change)[0]
    assert f"`{key}`" in first.fault
    assert f"`{nearest}`" in first.remedy
    assert first.place == dotted_place([*where, key])


def set_to(*steps: Any, value: Any) -> Any:
    def change(declared: Any) -> None:
        for step in steps[:-1]:
            declared = declared[step]
        declared[steps[-1]] = copy.deepcopy(value)

    return change


@pytest.mark.parametrize(
    ("change", "place", "words"),
    [
        (set_to("format", value="balance-geometry/2"), "format", "balance-geometry/2"),
        (set_to("cells", 3, "stiffness", value=-1.0), "cells[3].stiffness", "(found -1.0)"),
        (set_to("cells", 3, "stiffness", value=1e308), "cells[3].stiffness", "less than or equal to"),
        (set_to("bodies", 0, "mass", value=5e-324), "bodies[0].mass", "(found 5e-324)"),
        (set_to("bodies", 0, "mass", value=True), "bodies[0].mass", "not true or false"),
        (set_to("bodies", 0, "position", value=[1e300, 0, 0]), "bodies[0].position[0]", "less than or equal to"),
        (set_to("name", value="n" * 300), "name", "at most 200 characters"),
        (lambda declared: declared["channels"].extend(declared["channels"] * 40), "channels", "too many"),
        (set_to("cells", 0, "series", value=[1e6]), "cells[0]", "either `stiffness` or `series`"),
        (set_to("cells", 0, "axis", value=[0, 0, 0]), "cells[0]", "no length"),
        (set_to("hub", value=[0.0, 0.0]), "hub[2]", "missing"),
        (set_to("hub", value=[0.0] * 4), "hub", "too many"),
        (set_to("bodies", value=[]), "bodies", "too few"),
        (set_to("bodies", 0, "mass", value=float("nan")), "bodies[0].mass", "finite"),
        (set_to("bodies", 1, "name", value="upper plate"), "bodies[1]", "`upper plate`"),
        (set_to("cells", 1, "name", value="x"), "cells[1]", "cells[0]"),
        (set_to("channels", 1, "name", value="x.strain"), "channels[1]", "channels[0]"),
        (set_to("channels", 1, "cell", value="y9"), "channels[1].cell", "`y9`"),
        (set_to("channels", 14, "cell", value="x"), "channels[14]", "either `cell: NAME` or"),
        (set_to("torque_meter", value=None), "channels[14].torque_meter", "no torque meter"),
        (set_to("freedom", value=["z", "z"]), "freedom[1]", "`z`"),
        (set_to("freedom", value=["z", "roll"]), "freedom[1]", "'phi'"),
        (set_to("bodies", 0, "inertia", "xx", value=20.0), "bodies[0].inertia", "exceeds the sum"),
        (set_to("bodies", 0, "inertia", "xy", value=4.0), "bodies[0].inertia", "negative"),
    ],
)
def test_each_fault_is_named_with_its_place(tmp_path: Path, change: Any, place: str, words: str) -> None:
    faults = faults_after(tmp_path, change)
    assert (place, True) in [(fault.place, words in fault.fault) for fault in faults]


def test_all_faults_are_listed_and_the_first_is_raised(tmp_path: Path) -> None:
    def change(declared: Any) -> None:
        declared["cells"][0]["stiffness"] = -1.0
        declared["channels"][2]["sensitivity"] = 0.0
        declared["speed"] = 3.0

    faults = faults_after(tmp_path, change)
    assert [fault.place for fault in faults] == ["speed", "cells[0].stiffness", "channels[2]"]
    with pytest.raises(UserError, match="unknown key `speed`"):
        load_geometry(tmp_path / "geometry.yaml")


def test_a_key_that_stands_twice_is_refused(tmp_path: Path) -> None:
    [fault] = faults_of(tmp_path, "format: balance-geometry/1\nname: a\nrig: b\nname: c\n")
    assert (fault.place, "`name` is given twice" in fault.fault) == ("line 4", True)


def test_yaml_is_read_safely(tmp_path: Path) -> None:
    [fault] = faults_of(tmp_path, "format: balance-geometry/1\nname: !!python/object/apply:os.getcwd []\n")
    assert "not YAML" in fault.fault


def test_powers_of_ten_are_numbers(tmp_path: Path) -> None:
    declared = rts()
    text = yaml.safe_dump(declared).replace("stiffness: 3600000.0", "stiffness: 36e5")
    assert faults_of(tmp_path, text) == []
    assert geometry_digest(load_geometry(tmp_path / "geometry.yaml")) == geometry_digest(geometry_from_dict(declared))


@pytest.mark.parametrize(
    ("name", "words"), [("missing.yaml", "no such file"), (".", "folder"), ("empty.yaml", "no keys")]
)
def test_what_is_no_geometry_is_said(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / "empty.yaml").touch()
    with pytest.raises(UserError, match=words):
        load_geometry(tmp_path / name)


def test_a_plate_that_its_cells_do_not_hold_is_refused_with_the_degree_of_freedom(tmp_path: Path) -> None:
    """Without the cell along x the plate slides; with both y cells in one line it turns about that line."""
    sliding = rts()
    del sliding["cells"][0], sliding["channels"][7], sliding["channels"][0]
    fault = faults_of(tmp_path, yaml.safe_dump(sliding))[-1]
    assert (fault.place, "free to move in x" in fault.fault) == ("cells", True)
    turning = rts()
    turning["cells"][2]["position"] = [0.31, 0.5, -0.05]
    assert "psi" in faults_of(tmp_path, yaml.safe_dump(turning))[-1].fault


@QUICK
@given(st.permutations(range(7)), st.integers(1, 7))
def test_unheld_motion_agrees_with_rigid_body_motion_of_the_cells(order: list[int], kept: int) -> None:
    """Cells hold the plate where no rigid motion leaves all their lengths; counted by moving the points themselves."""
    whole = load_geometry(ROOT / "configs" / "rts-6.yaml")
    geometry = whole.model_copy(update={"cells": tuple(whole.cells[index] for index in order[:kept])})
    centre = metric_side(geometry).centre_of_gravity
    lengths = []
    for cell in geometry.cells:
        arm = np.asarray(cell.position) - centre
        turns = [np.cross(np.eye(3)[axis], arm) for axis in (2, 1, 0)]
        lengths.append([*cell.direction, *(turn @ cell.direction for turn in turns)])
    assert bool(unrestrained_motion(geometry, centre)) == (np.linalg.matrix_rank(np.array(lengths), tol=1e-6) < 6)


def test_a_point_mass_may_not_turn(tmp_path: Path) -> None:
    text = (ROOT / "configs" / "one-dof.yaml").read_text(encoding="utf-8")
    still = text.replace("{xx: 0.3, yy: 0.3, zz: 0.4}", "{xx: 0.0, yy: 0.0, zz: 0.0}")
    assert faults_of(tmp_path, still) == []
    faults = faults_of(tmp_path, still.replace("freedom: [z]", "freedom: [z, phi]"))
    assert "no inertia" in faults[0].fault
