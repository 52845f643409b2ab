"""Optional parts of run files: forces at points, temperatures, a second rotor, the error of the azimuth."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from balance_cli.campaign.recording.additions import (
    FORCE,
    POSITION,
    TEMPERATURE,
    LoadPoints,
    MemoryAdditions,
    RunAdditions,
)
from balance_cli.campaign.recording.point_loads import with_hub_loads
from balance_cli.campaign.recording.run import MemorySource, Run, excerpt_run, run_digest
from balance_cli.campaign.recording.run_file import open_run, open_runs, read_run, write_run
from balance_cli.campaign.rig.geometry_file import geometry_from_dict, geometry_to_dict
from balance_cli.io.errors import UserError
from tests.support.rigs import rotor_balance

RNG = np.random.default_rng(4)
ROWS = 700


def run_with(additions=None, kind="sweep", loads=None):
    rig = rotor_balance()
    names = rig.channel_names
    sweep = {"excited": ("Fz",), "excitation": "impact", "level": (1.0,)} if kind == "sweep" else {}
    source = MemorySource(RNG.standard_normal((ROWS, len(names))), loads)
    return Run("r", rig.rig, kind, names, ROWS, source, loads is not None, 800.0, additions=additions, **sweep)


def additions(moving=False, **changes):
    position = np.array([[0.1, 0.2, 0.3], [0.0, -0.5, 0.1]])
    datasets = {FORCE: RNG.standard_normal((ROWS, 2)), TEMPERATURE: 20.0 + RNG.standard_normal((ROWS, 1))}
    datasets |= {POSITION: position + 0.01 * RNG.standard_normal((ROWS, 2, 3))} if moving else {}
    points = LoadPoints(
        ("stinger", "hammer"), np.array([[0.0, 0.0, 2.0], [1.0, 1.0, 0.0]]), None if moving else position
    )
    built = RunAdditions(points, ("beam",), (np.arange(0.1, 0.8, 0.05),), 0.02, MemoryAdditions(datasets))
    return replace(built, **changes)


@pytest.mark.parametrize("moving", [False, True])
def test_they_come_back_from_a_file(tmp_path, moving):
    run = run_with(additions(moving), loads=RNG.standard_normal((ROWS, 6)))
    write_run(tmp_path / "r.h5", run)
    read = open_run(tmp_path / "r.h5")
    assert read.digest == run_digest(run) and read.excitation == "impact"
    assert read.additions.load_points.names == ("stinger", "hammer") and read.additions.azimuth_error_deg == 0.02
    assert np.array_equal(read.additions.further_pulse_times[0], run.additions.further_pulse_times[0])
    for dataset in run.additions.sampled_datasets:
        assert np.array_equal(read.additions.read(dataset, 3, 90), run.additions.read(dataset, 3, 90))


@pytest.mark.parametrize("moving", [False, True])
def test_forces_at_points_are_hub_loads(moving):
    run = run_with(additions(moving), loads=np.ones((ROWS, 6)))
    hub = np.array([0.0, 0.0, 0.4])
    loads = with_hub_loads(run, rotor_balance().model_copy(update={"hub": tuple(hub)})).read().loads
    force = run.additions.read(FORCE, 0, ROWS)
    vectors = force[:, :, None] * np.array([[0, 0, 1.0], [np.sqrt(0.5), np.sqrt(0.5), 0]])
    place = run.additions.read(POSITION, 0, ROWS) if moving else run.additions.load_points.position
    expected = np.hstack([vectors.sum(axis=1), np.cross(place - hub, vectors).sum(axis=1)])
    assert np.allclose(loads, 1.0 + expected, atol=1e-12)


def test_a_sweep_without_hub_loads_has_those_of_its_points(tmp_path):
    write_run(tmp_path / "r.h5", run_with(additions()))
    (run,), _ = open_runs([tmp_path / "r.h5"], rotor_balance())
    assert run.has_loads and np.abs(run.read().loads[:, 2]).max() > 0.0


DECLARED = {
    "stinger": {"position": [0.1, 0.2, 0.3], "direction": [0.0, 0.0, 1.0]},
    "hammer": {"position": [0.0, -0.5, 0.1], "direction": [1.0, 1.0, 0.0]},
}


def rig_with_points(**changes):
    points = {name: {**point, **changes.get(name, {})} for name, point in DECLARED.items()}
    return geometry_from_dict({**geometry_to_dict(rotor_balance()), "load_points": points})


def test_points_are_those_of_the_geometry_where_the_file_names_them_only(tmp_path):
    full = run_with(additions())
    unknown = np.full((2, 3), np.nan)
    points = LoadPoints(("stinger", "hammer"), unknown, unknown)
    write_run(tmp_path / "r.h5", replace(full, additions=replace(full.additions, load_points=points)))
    with h5py.File(tmp_path / "r.h5") as file:
        assert "load_points/position" not in file and "load_points/direction" not in file
    (run,), _ = open_runs([tmp_path / "r.h5"], rig_with_points())
    assert np.allclose(run.read().loads, with_hub_loads(full, rig_with_points()).read().loads, atol=1e-12)
    with pytest.raises(UserError, match=r"neither position nor direction, and is not declared"):
        open_runs([tmp_path / "r.h5"], rotor_balance())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"hammer": {"position": [0.0, -0.5, 0.2]}}, "lies 0.1 m from the point"),
        ({"stinger": {"direction": [0.0, 0.0, -1.0]}}, "has another direction"),
    ],
)
def test_a_point_elsewhere_than_declared_is_refused(tmp_path, changes, words):
    write_run(tmp_path / "r.h5", run_with(additions()))
    open_runs([tmp_path / "r.h5"], rig_with_points())
    with pytest.raises(UserError, match=words) as caught:
        open_runs([tmp_path / "r.h5"], rig_with_points(**changes))
    assert caught.value.file.endswith("r.h5") and "load_points" in caught.value.place


def test_an_excerpt_takes_them_along():
    part = excerpt_run(run_with(additions()), 160, 400)
    whole = additions().further_pulse_times[0]
    assert np.allclose(part.additions.further_pulse_times[0], whole[(whole >= 0.2) & (whole < 0.5)] - 0.2)


def test_runs_without_them_have_the_digest_of_before():
    run = run_with()
    assert (
        run_digest(run) == run_digest(replace(run, additions=None)) != run_digest(replace(run, additions=additions()))
    )


@pytest.mark.parametrize(
    ("change", "place"),
    [
        (lambda f: f.pop(FORCE), FORCE),
        (lambda f: replace_dataset(f, FORCE, np.zeros((ROWS - 1, 2))), FORCE),
        (lambda f: replace_dataset(f, "load_points/direction", np.zeros((2, 3))), "load_points/direction"),
        (lambda f: replace_dataset(f, POSITION, np.zeros((2, 2))), POSITION),
        (lambda f: replace_dataset(f, FORCE, np.full((ROWS, 2), np.nan)), FORCE),
        (lambda f: f[TEMPERATURE].attrs.__setitem__("unit", "K"), TEMPERATURE),
        (lambda f: replace_dataset(f, TEMPERATURE, np.full((ROWS, 1), 1e5), unit="degC", names=["beam"]), TEMPERATURE),
        (lambda f: replace_dataset(f, "rotor2/pulse_times", np.array([1.0, 0.5])), "rotor2/pulse_times"),
        (lambda f: f.attrs.__setitem__("azimuth_error_deg", "small"), "azimuth_error_deg"),
    ],
)
def test_faults_are_named_by_their_place(tmp_path, change, place):
    write_run(tmp_path / "r.h5", run_with(additions(), loads=np.ones((ROWS, 6))))
    with h5py.File(tmp_path / "r.h5", "r+") as file:
        change(file)
    _, faults = read_run(tmp_path / "r.h5")
    assert len(faults) == 1 and place in faults[0].place and faults[0].remedy


def replace_dataset(file, name, values, **attributes):
    del file[name]
    file[name] = values
    for key, value in attributes.items():
        file[name].attrs[key] = value
