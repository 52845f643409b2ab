"""`balance run`: the whole chain on a small campaign, only what changed, and what the rig does not allow."""

import json
import os
import shutil
from contextlib import nullcontext
from pathlib import Path

import h5py
import pandas as pd
import pytest
import yaml
from click.testing import CliRunner

from balance_cli.cli import balance
from balance_cli.cli.pipeline import execution
from balance_cli.cli.pipeline.execution import Execution
from balance_cli.cli.pipeline.state import State, load_state
from balance_cli.cli.pipeline.steps import Plan, Step

ROOT = Path(__file__).parents[2]
ONE_DOF = ROOT / "configs" / "one-dof.yaml"
PLAN = {
    "runs": [
        {"run": "static", "kind": "static", "largest": {"Fz": 300.0}, "steps": 3},
        {"run": "zero", "kind": "zero", "duration": 3.0},
        {"run": "check", "kind": "check", "rotor_speed": 9.0, "duration": 12.0, "harmonics": {"Fz": [20.0, 9.0, 5.0]}},
    ]
}


def call(*words, status=0):
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == status, result.output
    return result


def run(campaign, results, *words, status=0):
    result = call("run", campaign, "-o", results, *words, "--json", "-", status=status)
    summary = json.loads(result.stdout)
    return {name: step["result"] for name, step in summary["steps"].items()}, summary, result.stderr


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A folder whose name has a space, with runs and a geometry.yml."""
    folder = tmp_path_factory.mktemp("run") / "test day"
    plan = folder.parent / "plan.yaml"
    plan.write_text(yaml.safe_dump(PLAN))
    call("simulate", "-g", ONE_DOF, "--plan", plan, "-o", folder)
    shutil.copy(ONE_DOF, folder / "geometry.yml")
    (folder / "truth.yaml").unlink()
    return folder


@pytest.fixture(scope="module")
def results(campaign):
    """The results of the campaign, made once, and what the first call said."""
    folder = campaign.parent / "the results"
    return folder, run(campaign, folder, "--jobs", 2)


def test_the_chain_ends_with_loads(results):
    folder, (steps, summary, text) = results
    assert set(steps.values()) == {"done"}
    assert summary["steps_left_out"] == {"transfer": "no sweep: no frequency response, and no model is identified"}
    assert summary["trust"] == {"check": "untested"}
    assert "Use with care because no redundant sensor tests them (untested: " in text
    table = pd.read_csv(folder / "loads.csv").set_index("harmonic")
    assert list(table.columns[-4:]) == ["sigma_amplitude", "sigma_phase_deg", "method", "response"]
    assert (folder / "report.html").is_file()
    assert (folder / "logs" / "calibration.txt").is_file()


def test_a_second_call_repeats_nothing(campaign, results):
    steps, _, _ = run(campaign, results[0])
    assert set(steps.values()) == {"up to date"}


def test_a_file_that_was_touched_changes_nothing(campaign, results):
    os.utime(campaign / "check.h5")
    os.utime(results[0] / "calibration.h5")
    assert set(run(campaign, results[0], "--dry-run")[0].values()) == {"up to date"}


def test_only_what_depends_on_a_change_is_to_do(campaign, results):
    before = (campaign / "check.h5").read_bytes()
    try:
        with h5py.File(campaign / "check.h5", "r+") as file:
            file["channels"][5, 0] += 1e-3
        steps, _, text = run(campaign, results[0], "--dry-run")
    finally:
        (campaign / "check.h5").write_bytes(before)
    assert {name for name, state in steps.items() if state == "to do"} == {
        "loads-static",
        "loads-computed",
        "loads",
        "report",
    }
    assert "balance reduce --calibration" in text


def test_an_output_that_is_gone_is_made_again(campaign, results):
    (results[0] / "modes.json").unlink()
    steps, _, _ = run(campaign, results[0])
    assert [name for name, state in steps.items() if state == "done"] == ["modes"]


def test_a_dry_run_writes_nothing(campaign, tmp_path):
    steps, _, _ = run(campaign, tmp_path / "r", "--dry-run")
    assert set(steps.values()) == {"to do"}
    assert not (tmp_path / "r").exists()


def test_a_file_that_cannot_be_used_is_left_out(campaign, results, tmp_path):
    folder = tmp_path / "c"
    shutil.copytree(campaign, folder)
    (folder / "broken.h5").write_text("not a run")
    shutil.copy(folder / "check.h5", folder / "copy.h5")
    _, summary, _ = run(folder, tmp_path / "r", "--dry-run")
    reasons = {Path(name).name: reason for name, reason in summary["left_out"].items()}
    assert reasons == {"broken.h5": "is not an HDF5 file", "copy.h5": "has the same run name as check.h5, `check`"}
    assert summary["campaign_runs"]["check"] == ["check"]


@pytest.mark.parametrize(
    ("prepare", "words"),
    [
        (lambda folder: (folder / "geometry.yml").unlink(), ("holds no geometry", "geometry.yaml beside", "-g")),
        (
            lambda folder: shutil.copy(folder / "geometry.yml", folder / "geometry.yaml"),
            ("more than one geometry", "-g GEOMETRY"),
        ),
        (lambda folder: [path.unlink() for path in folder.glob("*.h5")], ("holds no run file",)),
    ],
    ids=["no geometry", "two geometries", "no runs"],
)
def test_a_folder_without_the_necessary_is_refused(campaign, tmp_path, prepare, words):
    folder = tmp_path / "c"
    shutil.copytree(campaign, folder)
    prepare(folder)
    result = call("run", folder, "-o", tmp_path / "r", status=2)
    assert all(word in result.stderr for word in words)
    assert not (tmp_path / "r").exists()


def test_results_do_not_go_among_the_runs(campaign):
    assert "is the campaign itself" in call("run", campaign, "-o", campaign, status=2).stderr


@pytest.mark.parametrize("name", ["calibration.h5", "loads.csv", "inputs.txt", "modes.json"])
def test_a_file_of_the_user_is_not_replaced(campaign, tmp_path, name):
    folder = tmp_path / "r"
    folder.mkdir()
    (folder / name).write_text("mine")
    (folder / "notes.txt").write_text("no result has this name")
    text = call("run", campaign, "-o", folder, status=2).stderr
    assert name in text and "no earlier `balance run` has written it" in text
    assert {path.name for path in folder.iterdir()} == {name, "notes.txt"}
    assert (folder / name).read_text() == "mine"


def test_results_are_those_of_an_earlier_call_without_its_state_too(campaign, results, tmp_path):
    """The state may be removed so that every step is repeated; a step that was interrupted leaves its log, too."""
    folder = tmp_path / "r"
    shutil.copytree(results[0], folder)
    (folder / "run-state.json").unlink()
    assert set(run(campaign, folder, "--dry-run")[0].values()) == {"to do"}
    (folder / "logs" / "modes.txt").unlink()  # as if no call had started this step
    assert "modes.json" in call("run", campaign, "-o", folder, status=2).stderr


# ---- execution, with commands that only pretend ----------------------------------------------------------------------


@pytest.fixture
def chain(tmp_path, monkeypatch):
    """A plan a -> b -> c beside d, and a function that executes it; `refused` and `broken` name steps that fail."""
    outputs = {name: tmp_path / f"{name}.txt" for name in "abcd"}
    steps = [
        Step("a", ("a",), (), (outputs["a"],)),
        Step("b", ("b", outputs["a"]), (outputs["a"],), (outputs["b"],), optional=True),
        Step("d", ("d",), (), (outputs["d"],)),
        Step("c", ("c",), (), (outputs["c"],), reads_first_of=(outputs["b"], outputs["d"])),
    ]
    calls = []

    def execute(jobs=2, statuses=None, working=nullcontext):
        def pretend(words, processes):
            calls.append(words)
            status = (statuses or {}).get(words[0], 0)
            if not status:
                outputs[words[0]].write_text(words[0])
            return status, "balance: error: no luck\n" if status else "balance: warning: so so\n", 0.1

        monkeypatch.setattr(execution, "_run_command", pretend)
        (tmp_path / "logs").mkdir(exist_ok=True)
        job = Execution(Plan(tuple(steps)), tmp_path, load_state(tmp_path), {}, jobs, lambda outcome: None, working)
        del calls[:]
        return {name: outcome.result for name, outcome in job.run().items()}, list(calls)

    return execute, outputs


@pytest.mark.parametrize("jobs", [1, 3])
def test_steps_wait_for_their_inputs(chain, jobs):
    execute, outputs = chain
    results, calls = execute(jobs)
    assert set(results.values()) == {"done"}
    names = [words[0] for words in calls]
    assert names.index("a") < names.index("b") < names.index("c")
    assert calls[-1] == ["c", str(outputs["b"])]
    assert execute(jobs) == (dict.fromkeys("abdc", "up to date"), [])


def test_steps_that_are_at_work_are_named_while_they_are(chain):
    execute, _ = chain
    named = []
    execute(1, working=lambda task: named.append(task) or nullcontext())
    assert sorted(named) == ["a", "b", "c", "d"]


def test_what_the_rig_refuses_is_replaced_by_the_next_best(chain):
    execute, outputs = chain
    results, calls = execute(statuses={"b": 2})
    assert results == {"a": "done", "b": "not possible", "d": "done", "c": "done"}
    assert calls[-1] == ["c", str(outputs["d"])]
    assert execute() == ({"a": "up to date", "b": "not possible", "d": "up to date", "c": "up to date"}, [])


def test_after_a_failure_the_rest_is_done_and_the_failure_is_tried_again(chain):
    execute, _ = chain
    results, _ = execute(statuses={"a": 1})
    assert results == {"a": "failed", "b": "not done", "d": "done", "c": "done"}
    results, calls = execute()
    assert results == {"a": "done", "b": "done", "d": "up to date", "c": "done"}
    assert [words[0] for words in calls] == ["a", "b", "c"]


def test_a_damaged_state_only_costs_time(chain, tmp_path):
    execute, _ = chain
    execute()
    (tmp_path / "run-state.json").write_text("{")
    assert load_state(tmp_path) == State()
    assert set(execute()[0].values()) == {"done"}
