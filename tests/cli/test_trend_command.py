"""`balance trend` with the eigenfrequencies of simulated records."""

import json

import pytest
import yaml
from click.testing import CliRunner

from balance_cli.cli import balance
from tests.support.rigs import CONFIGS

RECORD = {"kind": "wind", "rotor_speed": 6.0, "duration": 30.0, "sample_rate": 256.0}
LOADS = {"harmonics": {"Fz": [5, 2, 1, 8]}, "turbulence": {"Fz": 4.0}, "turbulence_band": [0.5, 100.0]}
RIG = CONFIGS / "one-dof.yaml"
FREQUENCY = 20.13
"""sqrt(k / m) / (2 pi) of the rig as declared [Hz]."""


def call(*words, status=0):
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == status, result.output
    return result


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trend")
    plan = {"runs": [{"run": name, **RECORD, **LOADS} for name in ("a", "b", "c")]}
    (folder / "plan.yaml").write_text(yaml.safe_dump(plan))
    call("simulate", "-g", RIG, "--plan", folder / "plan.yaml", "-o", folder / "runs")
    call("identify", "-g", RIG, "--method", "computed", "-o", folder / "model.h5")
    runs = [folder / "runs" / f"{name}.h5" for name in "abc"]
    call("reduce", "--model", folder / "model.h5", *runs, "-o", folder / "loads.h5")
    return folder


def test_eigenfrequencies_of_records_stand_beside_those_of_the_model(folder):
    files = (folder / "loads.h5", "--model", folder / "model.h5", "--records", folder / "runs")
    (folder / "runs" / "c.h5").rename(folder / "c.h5")
    result = call("trend", *files, "--json", "-")
    summary = json.loads(result.stdout)
    (mode,) = summary["modes"]
    assert mode["runs"] == 2 and not mode["is_significant"]
    assert mode["frequency_hz"] == pytest.approx(FREQUENCY, abs=0.01)
    assert abs(mode["departure"]) < 4 * mode["sigma_departure"] < 0.04
    assert [summary["runs"][name].get("frequency_hz") is None for name in "abc"] == [False, False, True]
    assert "1 of 3 runs have no usable record" in result.stderr
    text = call("trend", *files).stdout
    assert "eigenfrequencies of 2 runs" in text and "drift is not testable" in text


def test_model_and_records_go_together(folder):
    loads, model = folder / "loads.h5", folder / "model.h5"
    assert "--records: eigenfrequencies need" in call("trend", loads, "--model", model, status=2).stderr
    assert "--model: eigenfrequencies need" in call("trend", loads, "--records", folder, status=2).stderr
    empty = folder / "empty"
    empty.mkdir(exist_ok=True)
    error = call("trend", loads, "--model", model, "--records", empty, status=2).stderr
    assert "holds no usable record of these loads" in error
