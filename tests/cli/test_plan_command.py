"""`balance plan` from the command line: files, exit status and messages."""

import json

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from balance_cli.campaign.rig.geometry_file import save_geometry
from balance_cli.cli import balance
from balance_cli.simulation import NO_NOISE, CampaignPlan, simulate_run, true_rig
from balance_cli.simulation.files import read_plan
from tests.support.rigs import one_degree_of_freedom

HALL = {
    "format": "balance-hall/1",
    "exciters": {"Fz": {"rms": 20.0, "peak": 30.0}},
    "change_minutes": 0.5,
    "overhead_minutes": 0.1,
    "periods": [3, 5],
    "levels": [1.0],
    "effects": ["channel-gain", "time-delay", "low-pass"],
}


@pytest.fixture
def call(tmp_path):
    save_geometry(tmp_path / "g.yaml", one_degree_of_freedom(rotor={"blades": 2, "speed": 5.0}))

    def run(*words, **hall):
        (tmp_path / "hall.yaml").write_text(yaml.safe_dump({**HALL, **hall}))
        files = ["-g", tmp_path / "g.yaml", "--hall", tmp_path / "hall.yaml", "-o", tmp_path / "plan.yaml"]
        return CliRunner().invoke(balance, ["plan", *map(str, (*files, *words))])

    return run


def test_plan_is_one_of_simulate_with_sheets_and_summary(call, tmp_path):
    words = ("--minutes", 3, "--json", tmp_path / "s.json", "--sheets", tmp_path / "sheets.md")
    result = call(*words, spectrum="flat", exciters={"Fz": {"rms": 20.0, "peak": 25.0}})
    assert result.exit_code == 0, result.output
    plan, summary = read_plan(tmp_path / "plan.yaml"), json.loads((tmp_path / "s.json").read_text())
    assert isinstance(plan, CampaignPlan)
    assert [run.run for run in plan.runs] == [run["run"] for run in summary["runs"]]
    # The peak of 25 N is the limit, not the rms of 20 N, and is reached.
    run, _ = simulate_run(true_rig(one_degree_of_freedom()), plan.runs[0], NO_NOISE)
    assert np.abs(run.read().loads).max() == pytest.approx(25.0, rel=0.02)
    assert 16.0 < plan.runs[0].level[0] < 19.0
    assert summary["minutes"] <= 3.0
    sheets = (tmp_path / "sheets.md").read_text()
    assert all(f"## Run {run.run}" in sheets for run in plan.runs)
    gain = next(effect for effect in summary["effects"] if effect["name"] == "channel-gain")
    assert gain["before"] is None and 0 < gain["after"][-1] < 0.1


def test_runs_already_made_count(call, tmp_path):
    assert call("--minutes", 2).exit_code == 0
    folder, g = tmp_path / "made", tmp_path / "g.yaml"
    simulate = ["simulate", "-g", g, "--plan", tmp_path / "plan.yaml", "-o", folder]
    assert CliRunner().invoke(balance, list(map(str, simulate))).exit_code == 0
    result = call("--minutes", 2, "--json", tmp_path / "s.json", *sorted(folder.glob("*.h5")))
    assert result.exit_code == 0, result.output
    summary = json.loads((tmp_path / "s.json").read_text())
    assert summary["noise"] == "measured in the runs given"
    assert summary["made"]
    assert all(effect["before"] is not None for effect in summary["effects"] if effect["name"] == "channel-gain")


@pytest.mark.parametrize(
    ("hall", "words", "message"),
    [
        ({"excitors": {}}, (), "unknown key `excitors`"),
        ({"exciters": {"Fx": {"rms": 1.0}}}, (), "does not carry Fx"),
        ({"exciters": {"Fz": {"rms": -1.0}}}, (), "exciters.Fz.rms"),
        ({"simultaneous": 3}, (), "`simultaneous` is 3"),
        ({"sample_rate": 3.0}, (), "half of the sample rate"),
        ({"change_minutes": 60.0}, (), "fits into 1 minutes"),
        ({"format": "balance-hall/9"}, (), "format"),
    ],
)
def test_constraints_that_cannot_hold_end_with_one_message(call, tmp_path, hall, words, message):
    result = call("--minutes", 1, *words, **hall)
    assert result.exit_code == 2
    assert message in result.output and ("hall.yaml" in result.output or "--minutes" in result.output)
    assert "Traceback" not in result.output and not (tmp_path / "plan.yaml").exists()


@pytest.fixture
def made(call, tmp_path):
    """A plan, and the run files of its simulation with four times the noise."""
    assert call("--minutes", 2).exit_code == 0
    words = ["simulate", "-g", tmp_path / "g.yaml", "--plan", tmp_path / "plan.yaml", "--noise", 4]
    assert CliRunner().invoke(balance, list(map(str, [*words, "-o", tmp_path / "made"]))).exit_code == 0
    return sorted((tmp_path / "made").glob("*.h5"))


def compare(tmp_path, *words):
    files = ["plan", "-g", tmp_path / "g.yaml", "--hall", tmp_path / "hall.yaml", "--compare", tmp_path / "plan.yaml"]
    return CliRunner().invoke(balance, list(map(str, (*files, *words))))


def test_runs_are_compared_with_their_plan(made, tmp_path):
    result = compare(tmp_path, *made[1:], "--json", tmp_path / "c.json")
    assert result.exit_code == 0, result.output
    summary = json.loads((tmp_path / "c.json").read_text())
    assert len(summary["compared"]) == len(made) - 1 and len(summary["not_made"]) == 1
    for run in summary["compared"]:
        # A sixteenth; the weights of so few lines beside the resonance scatter by tens of percent between records.
        assert 0.6 < 16 * run["information_ratio"] < 1.6
        assert run["level_ratio"] == pytest.approx(1.0, abs=0.02)
        assert run["noise_ratio"] == pytest.approx(4.0, rel=0.1)
        assert any("noise" in cause for cause in run["causes"])
    for item in summary["sizes"]:
        ratio = item["achieved"] / item["planned"]
        assert 3.3 < (1.0 / ratio if item["parameter"] == "cutoff" else ratio) < 4.2


@pytest.mark.parametrize("words", [("--minutes", 3), ("--sheets", "s.md"), ("-o", "p.yaml")])
def test_options_of_a_plan_have_no_meaning_in_a_comparison(call, tmp_path, words):
    assert call("--minutes", 2).exit_code == 0
    result = compare(tmp_path, *words)
    assert result.exit_code == 2 and words[0] in result.output


def test_a_comparison_needs_runs_of_the_plan(call, tmp_path):
    assert call("--minutes", 2).exit_code == 0
    result = compare(tmp_path)
    assert result.exit_code == 2 and "no run has the name of a planned sweep" in result.output
