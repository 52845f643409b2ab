"""Which steps a campaign allows: by its geometry and its runs, without running anything."""

from pathlib import Path

import pytest

from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.cli.pipeline.folder import log_path, require_own_results
from balance_cli.cli.pipeline.inventory import Inventory, RunFile, find_geometry, run_files
from balance_cli.cli.pipeline.state import State
from balance_cli.cli.pipeline.steps import plan_steps
from balance_cli.io.errors import UserError

CONFIGS = Path(__file__).parents[2] / "configs"
RUNS = {"static": ["s"], "sweep": ["f"], "check": ["c"], "wind": ["w"], "zero": ["z"]}
IDENTIFIED = {"transfer", "model-computed", "model-rigid", "diagnosis"}
PAPER = {"model-paper", "model-paper-full"}


def plan(config, *kinds, pulses=True, band=None):
    runs = {
        kind: tuple(RunFile(Path(f"{name}.h5"), name, name, pulses, 4096.0) for name in names)
        for kind, names in RUNS.items()
        if kind in kinds
    }
    geometry = load_geometry(CONFIGS / f"{config}.yaml")
    return plan_steps(Inventory(CONFIGS / f"{config}.yaml", geometry, "g", runs), Path("r"), band)


def names(steps):
    return {step.name for step in steps.steps}


def loads(*responses):
    return {f"loads-{name}" for name in responses}


@pytest.mark.parametrize(
    ("config", "expected", "left_out"),
    [
        ("rts-6", {"calibration", *PAPER, *loads("static", "paper", "paper-full")}, set()),
        ("hexapod", {"calibration", *PAPER, *loads("static", "paper", "paper-full")}, set()),
        ("piezo-12", set(), {"calibration", *PAPER}),
    ],
)
def test_a_whole_campaign(config, expected, left_out):
    steps = plan(config, *RUNS)
    common = {"modes", *IDENTIFIED, *loads("transfer", "computed", "rigid", "closed", "smoother")}
    tables = {"loads", "loads-transfer.csv", "report"}
    assert names(steps) == expected | common | tables
    assert set(steps.left_out) == left_out


def test_reductions_take_calibration_and_zero_only_where_there_is_one():
    for config, given in (("rts-6", True), ("piezo-12", False)):
        step = next(step for step in plan(config, *RUNS).steps if step.name == "loads-closed")
        assert ("--calibration" in step.words, "--zero" in step.words) == (given, given)


def test_records_without_pulses_become_spectra():
    steps = plan("dynamometer", "sweep", "check", pulses=False)
    assert names(steps) == {"modes", *IDENTIFIED, "spectra", "spectra.csv", "report"}
    assert {"loads", "calibration"} <= set(steps.left_out)
    spectra = next(step for step in steps.steps if step.name == "spectra")
    assert spectra.words[spectra.words.index("--band") :][1:3] == ("1", "960")
    diagnosis = next(step for step in steps.steps if step.name == "diagnosis")
    assert "--hold-out" not in diagnosis.words


def test_without_sweeps_the_model_is_the_computed_one():
    steps = plan("rts-6", "static", "wind")
    assert names(steps) == {"modes", "calibration", "model-computed", *loads("static", "computed"), "loads", "report"}
    assert "no model is identified" in steps.left_out["transfer"]


def test_without_a_rotor_run_there_are_no_loads():
    steps = plan("rts-6", "static", "sweep")
    assert "loads" in steps.left_out
    assert not any(name.startswith("loads") for name in names(steps))


def test_given_results_reduce_wind_runs_alone():
    runs = {"wind": (RunFile(Path("w.h5"), "w", "w", True, 4096.0),)}
    given = {"model": (Path("m.h5"), "m"), "calibration": (Path("c.h5"), "c")}
    geometry = load_geometry(CONFIGS / "rts-6.yaml")
    inventory = Inventory(CONFIGS / "rts-6.yaml", geometry, "g", runs, given=given)
    steps = plan_steps(inventory, Path("r"))
    assert loads("static", "given", "computed") | {"loads"} <= names(steps)
    step = next(step for step in steps.steps if step.name == "loads-given")
    assert step.words[:5] == ("reduce", "--calibration", Path("c.h5"), "--model", Path("m.h5"))
    table = next(step for step in steps.steps if step.name == "loads")
    assert table.reads_first_of[0] == Path("r/loads-given.h5")
    assert {Path("m.h5"), Path("c.h5")} <= set(inventory.digests)


def test_sweeps_by_forces_beside_the_hub_may_give_no_response():
    runs = {"sweep": (RunFile(Path("f.h5"), "f", "f", False, 4096.0, True),)}
    geometry = load_geometry(CONFIGS / "dynamometer.yaml")
    steps = plan_steps(Inventory(CONFIGS / "dynamometer.yaml", geometry, "g", runs), Path("r"))
    assert [step.name for step in steps.steps if step.optional] == ["transfer"]


def test_layouts_of_other_folders(tmp_path):
    (tmp_path / "Geometry.YML").write_bytes((CONFIGS / "rts-6.yaml").read_bytes())
    (tmp_path / "notes.yaml").write_text("operator: me\n", encoding="utf-8")
    assert find_geometry(tmp_path).name == "Geometry.YML"
    inner = tmp_path / "Tag 2, Läufe"
    inner.mkdir()
    sample = CONFIGS.parent / "sample_data" / "wind-1.h5"
    (inner / "Hover 1.H5").write_bytes(sample.read_bytes())
    assert [path.name for path in run_files(tmp_path)] == ["Hover 1.H5"]
    (tmp_path / "own.hdf5").write_bytes(sample.read_bytes())
    assert [path.name for path in run_files(tmp_path)] == ["own.hdf5"]


def test_a_band_goes_to_what_is_identified_from_sweeps():
    given = {step.name for step in plan("rts-6", *RUNS, band=(5.0, 150.25)).steps if "--band" in step.words}
    assert given == {"model-rigid", *PAPER}
    step = next(step for step in plan("rts-6", *RUNS, band=(5.0, 150.25)).steps if step.name == "model-rigid")
    assert step.words[step.words.index("--band") :][1:3] == ("5.0", "150.25")


def test_a_band_without_sweeps_is_refused():
    with pytest.raises(UserError, match="no sweep is there"):
        plan("rts-6", "static", "check", band=(5.0, 150.0))


def test_histories_of_the_user_are_not_replaced(tmp_path):
    geometry = load_geometry(CONFIGS / "rts-6.yaml")
    runs = {kind: (RunFile(Path(f"{kind}.h5"), kind, kind, True, 4096.0),) for kind in ("sweep", "wind")}
    steps = plan_steps(Inventory(CONFIGS / "rts-6.yaml", geometry, "g", runs), tmp_path)
    require_own_results(tmp_path, steps, State())
    (tmp_path / "histories").mkdir()
    (tmp_path / "histories" / "wind.h5").touch()
    with pytest.raises(UserError, match="would be replaced"):
        require_own_results(tmp_path, steps, State())
    log_path(tmp_path, "loads-smoother").parent.mkdir()
    log_path(tmp_path, "loads-smoother").touch()
    require_own_results(tmp_path, steps, State())
