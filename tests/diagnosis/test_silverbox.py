"""A real measurement: the Silverbox as a balance with one degree of freedom, its fit and its diagnosis."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.campaign.recording.run_file import open_run, write_run
from balance_cli.campaign.rig.geometry_file import geometry_from_dict
from balance_cli.cli import balance
from balance_cli.diagnosis.result import EXPLAINED, NOTHING_MISSING
from balance_cli.diagnosis.search.candidates import candidate_at
from balance_cli.diagnosis.search.score_statistics import scores
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.io.artefacts import load_artefact, make_provenance, save_artefact
from balance_cli.model.balance import balance_model
from balance_cli.model.placed_effects import add_effects
from balance_cli.steps.diagnose import diagnose
from balance_cli.steps.identify import identified_effects, identify
from tests.support.measured_data import SHARED

PROJECT = Path(__file__).parents[2]
CSV = SHARED / "measured" / "silverbox" / "SNLS80mV.csv"
SHORT = 22000
CLOSING = ("load-offset@Fz", "cubic-stiffness@z,beside")

pytestmark = pytest.mark.skipif(not CSV.exists(), reason="the measured data are not here")


def load_tool(name):
    spec = importlib.util.spec_from_file_location(name, PROJECT / "tools" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def silverbox():
    return load_tool("silverbox")


@pytest.fixture(scope="module")
def errors(runs):
    """RMSE [mV] of a model on the test part of the multisines and on the arrow head."""
    tool = load_tool("silverbox_errors")
    return lambda model: tool.errors(model, runs)[:2]


@pytest.fixture(scope="module")
def runs(silverbox):
    return silverbox.silverbox_runs(CSV)


@pytest.fixture(scope="module")
def spectra(silverbox, runs):
    return measured_spectra([runs["train"]], geometry_from_dict(silverbox.GEOMETRY), means=True)


def fit(silverbox, spectra, *effects):
    return identify(spectra, add_effects(geometry_from_dict(silverbox.GEOMETRY), effects))


@pytest.fixture(scope="module")
def updated(silverbox, spectra):
    return fit(silverbox, spectra, *CLOSING)


def test_errors_of_the_linear_model_are_those_of_the_literature(silverbox, spectra, errors):
    test, arrow = errors(fit(silverbox, spectra))
    assert test == pytest.approx(8.64, abs=0.1)
    assert arrow == pytest.approx(15.3, abs=0.4)


def test_load_offset_and_a_cubic_spring_beside_the_cell_explain_it(updated, errors):
    test, arrow = errors(updated)
    assert test < 0.41
    assert arrow < 0.50
    found = {effect.name: effect.parameters[0] for effect in identified_effects(updated)}
    assert found["cubic-stiffness"].value > 30 * found["cubic-stiffness"].sigma
    assert found["load-offset"].value == pytest.approx(0.0053, abs=0.0005)


@pytest.fixture(scope="module")
def closed(silverbox, third):
    """The fit of the effects that close the model to the first third."""
    return fit(silverbox, third, *CLOSING)


def test_the_side_is_beside(silverbox, third, closed):
    inside = fit(silverbox, third, "load-offset@Fz", "cubic-stiffness@z,inside")
    assert inside.quality.chi2 > 10 * closed.quality.chi2


def test_a_quadratic_stiffness_gains_nothing_beyond_an_offset(silverbox, third, closed):
    """Beside the cell it is the same as an offset of the channel, a shift of the origin of the elongation."""
    offset, quadratic = (
        fit(silverbox, third, *CLOSING, further) for further in ("channel-offset@z", "quadratic-stiffness@z,beside")
    )
    assert 0.0 < closed.quality.chi2 - quadratic.quality.chi2 < 10.0
    assert quadratic.quality.chi2 == pytest.approx(offset.quality.chi2, abs=0.5)
    model, theta = balance_model(offset.geometry), np.array(offset.parameters.value)
    further = [candidate_at("quadratic-stiffness", ("z", side), offset.geometry) for side in ("beside", "inside")]
    found = scores(model.at(theta), stack_runs(third.lines, third.statics, ("z",)), further, SETTINGS.score)
    assert all(score.gain < 1.0 for score in found)


# ---- diagnosis by the commands ---------------------------------------------------------------------------------------


def call(*words):
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result


def shortened(run):
    """Its first samples."""
    block = run.read()
    return replace(run, samples=SHORT, source=MemorySource(block.channels[:SHORT], block.loads[:SHORT]))


@pytest.fixture(scope="module")
def commands(silverbox, third, tmp_path_factory):
    """Result and JSON output of `diagnose` by the command of the manual, the linear and the updated model.

    They use the first third of the training part and the first half of the arrow head.
    """
    folder = tmp_path_factory.mktemp("silverbox")
    silverbox.write_silverbox(CSV, folder)
    write_run(folder / "third.h5", shortened(open_run(folder / "train.h5")))
    write_run(folder / "half.h5", shortened(open_run(folder / "arrow.h5")))
    linear, updated, output = folder / "linear.h5", folder / "updated.h5", folder / "output.json"
    save_artefact(linear, "balance-model/1", fit(silverbox, third), make_provenance("identify", {}, ()))
    held = ("--hold-out", folder / "test.h5", "--hold-out", folder / "half.h5")
    out = ("-o", folder / "diagnosis.h5", "--model-out", updated, "--json", output)
    result = call("diagnose", linear, folder / "third.h5", *held, *out)
    models = [load_artefact(path, {"balance-model/1": IdentifiedModel}).content for path in (linear, updated)]
    return result, json.loads(output.read_text()), *models


def test_diagnose_finds_load_offset_and_cubic_stiffness_by_itself(commands):
    _, output, _, _ = commands
    assert output["verdict"] == EXPLAINED
    found = {effect["name"]: effect for effect in output["effects"]}
    assert {"load-offset", "cubic-stiffness"} <= set(found) <= {"load-offset", "cubic-stiffness", "channel-offset"}
    assert found["load-offset"]["where"] == ["Fz"]
    assert found["cubic-stiffness"]["where"] == ["z"]
    assert found["cubic-stiffness"]["parameters"]["side"] == {"value": "beside", "sigma": None, "unit": ""}
    cubic = found["cubic-stiffness"]["parameters"]["k3"]
    assert cubic["value"] > 30 * cubic["sigma"]
    assert cubic["value"] == output["parameters"]["cubic-stiffness@z,beside.k3"]["value"]


def test_the_updated_model_simulates_the_measured_output(commands, errors):
    _, _, linear, updated = commands
    before, after = errors(linear), errors(updated)
    assert before[0] > 8.0 and before[1] > 14.0
    assert after[0] < 0.41
    assert after[1] < 0.50


def test_errors_on_hold_out_runs_fall_to_about_their_noise_floor(commands):
    result, output, _, _ = commands
    assert list(output["hold_out"]) == ["test", "arrow"]
    for run in output["hold_out"].values():
        before, after, noise = (run[stage]["frf_error"] for stage in ("before", "after", "noise"))
        assert before > 0.03
        assert after < 0.1 * before
        # 0.97 times on the test part, 2.01 on the half arrow head.
        assert after < 2.2 * noise < 4.4 * after
    assert "cubic-stiffness@z,beside" in result.stdout


def test_what_one_record_of_one_cell_cannot_show_is_said(commands):
    _, output, _, _ = commands
    reasons = {item["name"]: item["why"] for item in output["not_testable"]}
    assert {"gyroscopic-coupling", "crosstalk", "mast-bending"} <= set(reasons)
    assert all("has no place for it" in reasons[name] for name in ("gyroscopic-coupling", "crosstalk", "mast-bending"))
    assert "weigh" in reasons["added-mass"]
    assert not {"load-offset", "cubic-stiffness", "time-delay"} & set(reasons)
    notes = " ".join(output["notes"])
    assert all(word in notes for word in ("one level only", "no static run", "chi2/dof is below one"))


@pytest.fixture(scope="module")
def third(silverbox, runs):
    """Spectra of the first third of the training part."""
    return measured_spectra([shortened(runs["train"])], geometry_from_dict(silverbox.GEOMETRY), means=True)


@pytest.mark.parametrize("side", ["beside", "inside"])
def test_a_quadratic_stiffness_in_the_model_is_taken_out_again(silverbox, third, side):
    found, without = diagnose(fit(silverbox, third, *CLOSING, f"quadratic-stiffness@z,{side}"), third)
    assert found.verdict == NOTHING_MISSING
    (removed,) = (trial for trial in found.trials if trial.decision == "removed")
    assert removed.label == f"quadratic-stiffness@z,{side}"
    assert {effect.label for effect in identified_effects(without)} == set(CLOSING)


def test_an_offset_of_the_channel_first_gives_way_to_that_of_the_load(silverbox, third, errors):
    """To the linear model the two are the same."""
    found, updated = diagnose(fit(silverbox, third, "channel-offset@z"), third)
    assert {effect.label for effect in found.effects} == set(CLOSING)
    assert [trial.label for trial in found.trials if trial.decision == "removed"] == ["channel-offset@z"]
    test, arrow = errors(updated)
    assert test < 0.41
    assert arrow < 0.50
