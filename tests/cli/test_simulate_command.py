"""`balance simulate`: files, truth, options and faults."""

import json

import h5py
import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from balance_cli.campaign.recording.run_file import open_run
from balance_cli.cli import balance
from balance_cli.simulation import draw_rig, simulate_campaign
from balance_cli.simulation.extensions.library import extension
from balance_cli.simulation.files import read_plan
from balance_cli.simulation.truth import random_stream
from tests.support.simulation_rig import GEOMETRY, RIG

PLAN = """
runs:
- {run: s, kind: static, largest: {Fx: 800}, steps: 1}
- {run: f, kind: sweep, excited: [Fz], level: [50], period: 0.5, periods: 2}
- {run: w, kind: wind, rotor_speed: 17.5, duration: 1, harmonics: {Fz: [10, 5]}, steady: {Fz: 100}}
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "geometry.yaml").write_text(RIG)
    (tmp_path / "plan.yaml").write_text(PLAN)
    return tmp_path


def call(folder, *words, plan="plan.yaml"):
    base = ["simulate", "-g", str(folder / "geometry.yaml"), "-o", str(folder / "out")]
    where = [] if plan is None else ["--plan", str(folder / plan)]
    return CliRunner().invoke(balance, [*base, *where, *words])


def test_files_hold_what_the_step_gives(folder):
    words = ("--sample-tolerances", "--seed", "7", "--effect", "time-delay@z1.strain", "--parameter", "delay=0.002")
    result = call(folder, *words, "--json", str(folder / "s.json"))
    assert result.exit_code == 0, result.output
    names = sorted(path.name for path in (folder / "out").iterdir())
    assert names == ["f.h5", "s.h5", "truth.hdf5", "truth.yaml", "w.h5"]
    summary = json.loads((folder / "s.json").read_text())
    run = open_run(folder / "out" / "f.h5")
    assert run.digest == summary["runs"]["f"]["digest"]
    truth = yaml.safe_load((folder / "out" / "truth.yaml").read_text())
    rig = draw_rig(GEOMETRY, random_stream(7, "", "rig"))
    assert truth["rig"]["mass"] == rig.mass
    assert truth["rig"]["effects"][0]["parameters"] == {"delay": 0.002}
    rig = rig.with_extensions(extension("time-delay", ("z1.strain",), delay=0.002))
    runs, truths = simulate_campaign(rig, read_plan(folder / "plan.yaml"), seed=7)
    np.testing.assert_array_equal(run.read().channels, runs[1].read().channels)
    with h5py.File(folder / "out" / "truth.hdf5") as file:
        np.testing.assert_array_equal(file["w/cosine"], truths[2].cosine)
        np.testing.assert_array_equal(file["f/loads"], truths[1].loads)
    assert open_run(folder / "out" / "w.h5").read().loads is None


def test_the_former_name_of_sample_tolerances_works_with_a_warning(folder):
    result = call(folder, "--draw", "--seed", "7", "--only", "s")
    assert result.exit_code == 0, result.output
    assert "--draw is deprecated; use --sample-tolerances" in result.stderr
    truth = yaml.safe_load((folder / "out" / "truth.yaml").read_text())
    assert truth["rig"]["mass"] == draw_rig(GEOMETRY, random_stream(7, "", "rig")).mass


def test_only_and_noise(folder):
    assert call(folder, "--only", "f", "--noise", "0").exit_code == 0
    samples = open_run(folder / "out" / "f.h5").read().channels
    assert np.any(samples != samples.astype(np.float32))
    assert not (folder / "out" / "s.h5").exists()


def test_declared_effects_are_simulated(folder):
    declared = {
        **yaml.safe_load(RIG),
        "effects": [{"name": "channel-gain", "where": ["torque"], "parameters": {"gain": 2.0}}],
    }
    (folder / "geometry.yaml").write_text(yaml.safe_dump(declared))
    assert call(folder, "--only", "s").exit_code == 0
    assert yaml.safe_load((folder / "out" / "truth.yaml").read_text())["rig"]["effects"][0]["name"] == "channel-gain"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--only", "q"), "no run `q`"),
        (("--effect", "cubic@z1", "--parameter", "k3=1"), "Did you mean `cubic-stiffness`"),
        (("--effect", "cubic-stiffness@z1", "--parameter", "k4=1"), "Did you mean `k3`"),
        (("--effect", "cubic-stiffness@z1"), "has no parameter"),
        (("--effect", "low-pass@torque", "--effect", "high-pass@torque", "--parameter", "cutoff=1"), "more than one"),
        (("--effect", "low-pass@torque", "--parameter", "cutoff"), "has no `=`"),
        (("--effect", "low-pass@torqe", "--parameter", "cutoff=1"), "not at torqe"),
        (("--parameter", "cutoff=1"), "no effect"),
        (("--effect", "low-pass@torque", "--parameter", "cutoff=nan"), "`cutoff` of `low-pass` is `nan`"),
        (("--noise", "nan"), "'--noise': nan is not a number"),
        (("--noise", "inf"), "--noise: `inf` is not a factor"),
        (("--effect", "dry-friction@z1", "--parameter", "force=1"), "`stick_stiffness` above 0"),
        (("--effect", "low-pass@torque", "--parameter", "cutoff=inf"), "`cutoff` of `low-pass` is `inf`"),
    ],
)
def test_faults_of_the_call(folder, words, message):
    result = call(folder, *words)
    assert result.exit_code == 2
    assert message in result.output
    assert result.output.count("error") == 1
    assert not (folder / "out").exists()


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        ([{"name": "added-mass", "parameters": {}}], "`added-mass` has no parameter"),
        ([{"name": "added-mass", "parameters": {"mass": -500.0}}], "inertia with `added-mass` is not positive"),
        ([{"name": "channel-gain", "where": ["torque"], "parameters": {"gain": 2.0}}] * 2, "given twice"),
    ],
)
def test_declared_effects_that_cannot_be_simulated_are_refused_with_the_file(folder, effects, message):
    (folder / "geometry.yaml").write_text(yaml.safe_dump({**yaml.safe_load(RIG), "effects": effects}))
    result = call(folder, "--only", "s")
    assert result.exit_code == 2
    assert message in result.output
    assert "geometry.yaml" in result.output
    assert not (folder / "out").exists()


def test_a_static_run_needs_a_channel_for_constant_loads(folder):
    declared = yaml.safe_load(RIG)
    declared["channels"] = [channel | {"time_constant": 1.0} for channel in declared["channels"]]
    (folder / "geometry.yaml").write_text(yaml.safe_dump(declared))
    result = call(folder)
    assert result.exit_code == 2
    assert "no channel measures the constant loads of the static run `s`" in result.output


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("runs: [{run: a, kind: sweep, excited: [Fz], level: [1, 2]}]", "one `level`"),
        ("runs: [{run: a, kind: zero}, {run: a, kind: zero}]", "not unique"),
        ("runs: [{run: a, kind: zero, durration: 3}]", "durration"),
        ("runs: [", "not YAML"),
        ("runs: []", "at least 1 item"),
        ('runs: !!int ""', "not a value of the type `int`"),
        ("runs: [{run: /tmp/outside, kind: zero}]", "not the name of a file"),
        ("runs: [{run: ../a, kind: zero}]", "not the name of a file"),
        ("runs: [{run: '  ', kind: zero}]", "not the name of a file"),
        (f"runs: [{{run: {'n' * 300}, kind: zero}}]", "at most 200 characters"),
        ("runs: [{run: a, kind: zero, duration: 1.0e-6}]", "samples"),
        ("runs: [{run: a, kind: zero, sample_rate: 1.0e+12}]", "samples"),
        ("runs: [{run: a, kind: sweep, excited: [Fz, Fz], level: [1, 1]}]", "twice"),
        ("runs: [{run: a, kind: sweep, excited: [Fz], level: [1], band: [20, 3000]}]", "below half"),
        ("runs: [{run: a, kind: sweep, excited: [Fz], level: [1], band: [2.1, 2.2]}]", "multiples of 1/`period`"),
        ("runs: [{run: a, kind: sweep, excited: [Fz], level: [1], periods: 1000000000}]", "samples"),
        ("runs: [{run: a, kind: sweep, excited: [Fz], level: [1], period: 0.001, periods: 2000}]", "shorter than two"),
        ("runs: [{run: a, kind: static, largest: {Fz: 1}, steps: 1000000000}]", "10000"),
        ("runs: [{run: a, kind: wind, rotor_speed: 17.5, duration: 0.1}]", "more than 2"),
        ("runs: [{run: a, kind: wind, rotor_speed: 1.0e+9}]", "below half of `sample_rate`"),
        (
            "runs: [{run: a, kind: wind, rotor_speed: 17.5, turbulence: {Fz: 3}, turbulence_band: [50, 2]}]",
            "`turbulence_band` 50 to 2 Hz should rise",
        ),
    ],
)
def test_faults_of_the_plan(folder, text, message):
    (folder / "bad.yaml").write_text(text)
    result = call(folder, plan="bad.yaml")
    assert result.exit_code == 2
    assert message in result.output
    assert "bad.yaml" in result.output


def test_full_folder_is_refused(folder):
    (folder / "out").mkdir()
    (folder / "out" / "mine.txt").write_text("kept")
    result = call(folder)
    assert result.exit_code == 2
    assert "not empty" in result.output
    assert [path.name for path in (folder / "out").iterdir()] == ["mine.txt"]


def test_record_beyond_memory_is_refused_before_it_is_computed(folder):
    long = PLAN.replace("period: 0.5", "period: 600")
    (folder / "plan.yaml").write_text(long)
    result = call(folder)
    assert result.exit_code == 2, result.output
    assert "run `f`: 960000 samples would take" in result.output
    assert "Give at most" in result.output
    assert not (folder / "out").exists()
