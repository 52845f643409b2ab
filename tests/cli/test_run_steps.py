"""Which steps a campaign allows: by its geometry and its runs, without running anything."""

from pathlib import Path

import pytest

from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.cli.pipeline.inventory import Inventory, RunFile
from balance_cli.cli.pipeline.steps import plan_steps

CONFIGS = Path(__file__).parents[2] / "configs"
RUNS = {"static": ["s"], "sweep": ["f"], "check": ["c"], "wind": ["w"], "zero": ["z"]}
IDENTIFIED = {"transfer", "model-computed", "model-rigid", "diagnosis"}
PAPER = {"model-paper", "model-paper-full"}


def plan(config, *kinds, pulses=True):
    runs = {
        kind: tuple(RunFile(Path(f"{name}.h5"), name, name, pulses, 4096.0) for name in names)
        for kind, names in RUNS.items()
        if kind in kinds
    }
    geometry = load_geometry(CONFIGS / f"{config}.yaml")
    return plan_steps(Inventory(CONFIGS / f"{config}.yaml", geometry, "g", runs), Path("r"))


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
