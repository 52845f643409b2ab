"""The tutorial, executed in a temporary folder: its commands, files and Python, and the numbers that it states."""

import glob
import json
import re
import shlex
import shutil
from pathlib import Path

import pandas as pd
import pytest
from click.testing import CliRunner

from balance_cli.cli import balance

ROOT = Path(__file__).parents[1]
TUTORIAL = ROOT / "docs" / "tutorial.md"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.DOTALL | re.MULTILINE)
FILE_NAME = re.compile(r"as `([\w.-]+)`:\s*$")


def run_line(line):
    """One line of a shell block: `cp` as from a folder of the clone, or a command of balance."""
    program, *words = shlex.split(line)
    if program == "cp":
        shutil.copy((ROOT / "try" / words[0]).resolve(), words[1])
        return
    assert program == "balance", line
    words = [name for word in words for name in (sorted(glob.glob(word)) if "*" in word else [word])]  # noqa: PTH207
    result = CliRunner().invoke(balance, words)
    assert result.exit_code == 0, f"{line}\n{result.output}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder after all blocks of the tutorial."""
    folder = tmp_path_factory.mktemp("tutorial")
    text = TUTORIAL.read_text(encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for block in BLOCK.finditer(text):
            language, content = block.groups()
            if language == "yaml":
                name = FILE_NAME.search(text[: block.start()]).group(1)
                Path(name).write_text(content, encoding="utf-8")
            elif language == "python":
                exec(compile(content, str(TUTORIAL), "exec"), {})
            else:
                for line in content.replace("\\\n", " ").splitlines():
                    run_line(line)
    return folder


def summary(folder, name):
    return json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))


def test_calibration_is_as_good_as_the_tutorial_expects(folder):
    (trim,) = summary(folder, "calibration")["trims"].values()
    assert max(trim["residual_percent_fs"].values()) < 0.1
    assert 0.5 < trim["lack_of_fit"] < 2
    assert trim["condition"] < 100


def test_sweeps_are_as_clean_as_the_tutorial_expects(folder):
    sweeps = summary(folder, "transfer")
    assert min(sweeps["coherence_min"].values()) > 0.95
    assert max(sweeps["relative_sigma"].values()) < 0.01


def test_rigid_model_does_not_fit(folder):
    model = summary(folder, "model")
    assert model["chi2_per_dof"] > 1000
    assert round(100 * model["frf_error"]) == 4


def test_diagnosis_finds_the_delay(folder):
    diagnosis = summary(folder, "diagnosis")
    assert diagnosis["verdict"] == "explained"
    (effect,) = diagnosis["effects"]
    assert (effect["name"], effect["where"]) == ("time-delay", ["x.piezo"])
    assert effect["parameters"]["delay"]["value"] == pytest.approx(6e-4, rel=1e-3)
    before = [error for run in diagnosis["hold_out"].values() for error in run["before"]["load_error"].values()]
    after = [error for run in diagnosis["hold_out"].values() for error in run["after"]["load_error"].values()]
    assert max(before) > 1.0 > 100 * max(after)


def test_loads_pass_the_tests_of_the_tutorial(folder):
    table = pd.read_csv(folder / "loads.csv", keep_default_na=False)
    on_one_sensor = (table["component"] == "Mz") | ((table["harmonic"] == 0) & table["component"].isin(["Fx", "My"]))
    assert set(table["flag"][~on_one_sensor]) == {""} and set(table["flag"][table["component"] == "Mz"]) == {"untested"}
    mean = table[(table["run"] == "wind-1") & (table["harmonic"] == 0)].set_index("component")
    for name, true in {"Fx": 100.0, "Fy": 0.0, "Fz": 2700.0, "Mx": 0.0, "My": 0.0, "Mz": 275.0}.items():
        assert mean.loc[name, "cosine"] == pytest.approx(true, abs=5 * mean.loc[name, "sigma_cosine"])
    for run in summary(folder, "loads")["runs"].values():
        assert all(value < run["redundancy_limit"][harmonic] for harmonic, value in run["redundancy"].items())
