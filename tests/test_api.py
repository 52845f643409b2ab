"""The public interface: what it imports, the examples of its docstrings, and the whole chain as in a notebook."""

import doctest
import importlib
import pkgutil
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import balance_cli as bal
import balance_cli.api
from balance_cli.campaign.recording.run import MemorySource
from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.geometry_file import save_geometry
from balance_cli.cli import balance
from balance_cli.io.artefacts import content_digest, make_provenance, read_stored
from balance_cli.io.result_view import ResultView
from balance_cli.reduction.result import LOAD_TABLE_COLUMNS
from tests.support.rigs import one_degree_of_freedom

ROOT = Path(__file__).parents[1]
API_MODULES = [f"balance_cli.api.{module.name}" for module in pkgutil.iter_modules(balance_cli.api.__path__)]

PLAN = {
    "runs": [
        {"run": "static", "kind": "static", "largest": {"Fz": 800.0}, "steps": 5},
        {"run": "zero", "kind": "zero", "duration": 4.0},
        {"run": "sweep-high", "kind": "sweep", "excited": ["Fz"], "level": [40.0], "periods": 5},
        {"run": "sweep-low", "kind": "sweep", "excited": ["Fz"], "level": [16.0], "periods": 5},
        {"run": "check", "kind": "check", "rotor_speed": 10.0, "duration": 8.0, "harmonics": {"Fz": [40, 20, 20, 30]}},
        {"run": "wind", "kind": "wind", "rotor_speed": 10.0, "duration": 8.0, "harmonics": {"Fz": [40, 20, 20, 30]}},
    ]
}


# ---- import ----------------------------------------------------------------------------------------------------------


def test_import_alone_loads_no_other_module_of_the_package_and_no_numpy():
    code = "import sys, balance_cli; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    packages = {name.partition(".")[0] for name in loaded.split()}
    assert not packages & {"numpy", "scipy", "pandas", "h5py", "pydantic", "click", "matplotlib", "yaml"}
    assert [name for name in loaded.split() if name.startswith("balance_cli")] == ["balance_cli"]


def test_every_public_name_exists_and_is_listed():
    assert set(bal.__all__) <= set(dir(bal))
    for name in bal.__all__:
        value = getattr(bal, name)
        assert value.__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'fault'"):
        _ = bal.fault


def test_type_checkers_see_the_names_that_python_finds():
    text = Path(bal.__file__).read_text(encoding="utf-8")
    shown = re.findall(r"^    from (\S+) import (\w+) as \2$", text, re.MULTILINE)
    assert {name: module for module, name in shown} == bal._MODULE_OF
    assert sorted(bal._MODULE_OF) == sorted([*bal.__all__, "__version__"])


def test_package_says_that_it_is_typed():
    assert Path(bal.__file__).with_name("py.typed").exists()


# ---- docstrings ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", API_MODULES)
def test_examples_of_the_docstrings(name, monkeypatch):
    monkeypatch.chdir(ROOT)
    module = importlib.import_module(name)
    result = doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE, report=True)
    assert result.failed == 0


def test_every_function_of_the_interface_has_an_example():
    functions = [getattr(bal, name) for name in bal.__all__ if name not in ("UserError", "save_artefact")]
    assert [function.__name__ for function in functions if ">>>" not in function.__doc__] == []


# ---- a notebook ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def geometry():
    return one_degree_of_freedom(rotor={"blades": 4, "speed": 10.0})


@pytest.fixture(scope="module")
def runs(geometry):
    return {run.name: run for run in bal.simulate(geometry, PLAN, seed=3).runs}


@pytest.fixture(scope="module")
def calibration(runs, geometry):
    return bal.calibrate(runs.values(), geometry)


@pytest.fixture(scope="module")
def model(runs, geometry):
    return bal.identify(runs.values(), geometry)


@pytest.fixture(scope="module")
def diagnosis(runs, model):
    return bal.diagnose(model, [runs[name] for name in ("static", "sweep-high", "sweep-low")], hold_out=runs["check"])


@pytest.fixture(scope="module")
def loads(runs, calibration, model):
    return bal.reduce(runs.values(), calibration, model, harmonics=4)


def test_loads_of_the_chain_are_the_true_ones(geometry, loads):
    truths = {truth.name: truth for truth in bal.simulate(geometry, PLAN, seed=3).truths}
    table = loads.to_frame()
    assert tuple(table.columns) == LOAD_TABLE_COLUMNS
    for name in ("check", "wind"):
        rows = table[(table["run"] == name) & (table["harmonic"] > 0)].sort_values("harmonic")
        true = truths[name].cosine[1:5, 2]
        errors = (rows["cosine"].to_numpy() - true) / rows["sigma_cosine"].to_numpy()
        assert np.max(np.abs(errors)) < 5


def test_diagnosis_of_the_chain(diagnosis):
    result, updated = diagnosis
    assert result.verdict == "nothing missing"
    assert list(result.hold_out) == ["check"]
    assert updated.quality.chi2_per_dof < 1.2


def test_responses_of_the_chain(runs, geometry):
    responses = bal.frequency_response(runs.values(), geometry, band=(5.0, 100.0))
    table = responses.to_frame()
    assert set(table["run"]) == {"sweep-high", "sweep-low"}
    first = responses.responses[0]
    rows = table[table["run"] == first.run]
    assert np.array_equal(rows["response"].to_numpy(), first.response[:, 0, 0])
    assert np.array_equal(rows["frequency_hz"].to_numpy(), first.frequency)


def with_scaled_channel(run, factor):
    block = run.read()
    return replace(run, source=MemorySource(factor * block.channels, block.loads))


def test_runs_that_contradict_each_other_are_refused_as_by_the_commands(runs, geometry, calibration, model):
    wrong = [with_scaled_channel(runs["sweep-low"], -1.0), runs["sweep-high"], runs["static"]]
    calls = (
        lambda: bal.calibrate(wrong, geometry),
        lambda: bal.frequency_response(wrong, geometry),
        lambda: bal.identify(wrong, geometry),
        lambda: bal.diagnose(model, wrong),
        lambda: bal.reduce([*wrong, runs["check"]], calibration, model),
    )
    for call in calls:
        with pytest.raises(bal.UserError, match=r"reversed.* in sweep-low"):
            call()


def test_what_runs_contradict_reaches_results_and_flags(tmp_path, runs, geometry, calibration):
    spoiled = with_scaled_channel(runs["check"], 4.0)
    responses = bal.frequency_response([with_scaled_channel(runs["sweep-low"], 1.3), runs["sweep-high"]], geometry)
    contradiction, text = responses.consistency
    assert "in sweep-low differs from that in sweep-high, which is used" in contradiction
    assert "times what the loads make" in text and "warning: " in repr(responses)
    inputs = {"cal.h5": calibration, "tf.h5": responses}
    for name, result in inputs.items():
        bal.save_artefact(tmp_path / name, result)
    names = ("sweep-high", "check")
    for name, run in zip(names, (runs["sweep-high"], spoiled), strict=True):
        write_run(tmp_path / f"{name}.h5", run)
    files = [tmp_path / f"{name}.h5" for name in names]
    loads = bal.reduce(files, calibration, responses, harmonics=4)
    assert loads.to_frame()["flag"].str.contains("model contradicted").all()
    words = ["--calibration", tmp_path / "cal.h5", "--transfer", tmp_path / "tf.h5", "--harmonics", 4]
    done = CliRunner().invoke(balance, ["reduce", *map(str, [*words, *files, "-o", tmp_path / "loads.h5"])])
    assert done.exit_code == 0, done.output
    written = bal.load_artefact(tmp_path / "loads.h5")
    assert written.warnings == loads.warnings and any(text in warning for warning in loads.warnings)
    assert written.to_frame().equals(loads.to_frame())


def results(calibration, model, diagnosis, loads, runs, geometry):
    responses = bal.frequency_response(runs["sweep-high"], geometry)
    return [calibration, responses, model, *diagnosis, loads, *loads.runs.values()]


def test_every_result_shows_itself(calibration, model, diagnosis, loads, runs, geometry):
    for result in results(calibration, model, diagnosis, loads, runs, geometry):
        assert isinstance(result, ResultView)
        lines = repr(result).splitlines()
        assert 1 <= len(lines) <= 6, lines
        assert max(map(len, lines)) <= 120
        assert "array(" not in repr(result)
        html = result._repr_html_()
        assert html.startswith("<p>") and "<table" in html


def test_inputs_show_themselves_in_one_line(runs, geometry):
    assert repr(geometry) == "Geometry one of rig ONE: 1 cell, 1 channel"
    assert repr(runs["static"]).startswith("Static run static of rig ONE: 1 channel, ")
    assert max(len(repr(item)) for item in [geometry, *runs.values()]) <= 120


def test_a_model_has_a_row_for_each_parameter_and_two_for_each_mode(model):
    table = model.to_frame()
    assert (table["kind"] == "parameter").sum() == len(model.parameters.names)
    assert (table["kind"] == "mode").sum() == 2 * len(model.modes.frequency)


def test_paths_and_objects_give_the_same_result(tmp_path, runs, geometry, calibration):
    save_geometry(tmp_path / "geometry.yaml", geometry)
    write_run(tmp_path / "static.h5", runs["static"])
    again = bal.calibrate(tmp_path / "static.h5", tmp_path / "geometry.yaml")
    assert np.array_equal(again.trims["bare"].C0, calibration.trims["bare"].C0)


def test_saved_results_have_the_digest_of_the_command(tmp_path, runs, geometry):
    save_geometry(tmp_path / "geometry.yaml", geometry)
    write_run(tmp_path / "static.h5", runs["static"])
    command = tmp_path / "command.h5"
    words = ["calibrate", "-g", tmp_path / "geometry.yaml", tmp_path / "static.h5", "-o", command]
    assert CliRunner().invoke(balance, [str(word) for word in words]).exit_code == 0
    run = bal.read_run(tmp_path / "static.h5")
    result = bal.calibrate(run, geometry)
    digest = bal.save_artefact(tmp_path / "api.h5", result, inputs=[geometry, run])
    assert repr(bal.load_artefact(command)) == repr(result)
    assert digest == read_stored(command).digest


def test_how_a_result_shows_itself_changes_no_digest(calibration):
    provenance = make_provenance("calibrate", {}, ())
    before = content_digest("balance-calibration/1", calibration, provenance)
    repr(calibration), calibration.to_frame(), calibration._repr_html_()
    assert content_digest("balance-calibration/1", calibration, provenance) == before


# ---- errors ----------------------------------------------------------------------------------------------------------


def test_a_run_that_is_fitted_cannot_be_held_out(runs, model):
    with pytest.raises(bal.UserError, match="both lists"):
        bal.diagnose(model, runs["sweep-high"], hold_out=runs["sweep-high"])


def test_two_runs_of_one_name_are_refused(runs, geometry):
    with pytest.raises(bal.UserError, match="two runs are named `static`"):
        bal.calibrate([runs["static"], runs["static"]], geometry)


def test_calibration_and_model_must_have_one_geometry(runs, calibration):
    stiffer = bal.identify([], one_degree_of_freedom(5e5), method="computed")
    with pytest.raises(bal.UserError, match="another geometry"):
        bal.reduce(runs["check"], calibration, stiffer)


def test_a_reduction_in_time_needs_a_model(runs, calibration):
    with pytest.raises(bal.UserError, match="physical form"):
        bal.reduce(runs["check"], calibration, "static", method="smoother")


def test_loads_in_time(runs, calibration, model):
    loads = bal.reduce(runs["wind"], calibration, model, method="smoother", harmonics=4, zero=runs["zero"])
    assert loads.runs["wind"].in_time is not None
    assert "no zero" not in set(loads.to_frame()["flag"])


def test_nothing_to_reduce(runs, calibration):
    with pytest.raises(bal.UserError, match="no check or wind run"):
        bal.reduce(runs["static"], calibration, "static")


def test_what_is_no_result_is_not_saved(tmp_path):
    with pytest.raises(TypeError, match="str is not a result"):
        balance_cli.save_artefact(tmp_path / "x.h5", "a path")


def test_a_point_table_is_calibrated_as_by_the_command(tmp_path):
    """It was refused as no HDF5 file, though the command reads it."""
    blocks = (ROOT / "docs" / "any-balance.md").read_text(encoding="utf-8").split("```")
    geometry, table = tmp_path / "balance.yaml", tmp_path / "points.csv"
    geometry.write_text(blocks[1].removeprefix("yaml\n"))
    table.write_text(blocks[3].removeprefix("text\n"))
    calibration = bal.calibrate(table, geometry, terms="linear")
    frame = calibration.to_frame()
    assert list(frame["channel"]) == ["B1", "B2", "B3"]
    assert frame["A"][0] == pytest.approx(1.02e-3 / (50.0 * 4.4482216), rel=0.01)  # 1.02 mV/V for 50 lbf
