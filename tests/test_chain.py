"""The chain end to end, by the commands, on files of a simulated campaign; and what each refuses."""

import json

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.geometry_file import save_geometry
from balance_cli.cli import balance


def call(*words, status=0):
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == status, result.output + (result.stderr if result.stderr_bytes else "")
    return result


@pytest.fixture(scope="module")
def folder(campaign, tmp_path_factory):
    """A folder as after a test day: geometry.yaml and run files."""
    folder = tmp_path_factory.mktemp("campaign")
    save_geometry(folder / "geometry.yaml", campaign.geometry)
    for run in campaign.runs:
        write_run(folder / f"{run.name}.h5", run)
    return folder


@pytest.fixture(scope="module")
def results(folder):
    """What the chain makes of it."""
    out, runs = folder / "results", sorted(folder.glob("*.h5"))
    out.mkdir()
    geometry = folder / "geometry.yaml"
    call("calibrate", "-g", geometry, *runs, "-o", out / "cal.h5", "--json", out / "cal.json")
    call("sweep-tf", "-g", geometry, *runs, "-o", out / "tf.h5", "--json", out / "tf.json")
    call("identify", "-g", geometry, *runs, "-o", out / "model.h5", "--json", out / "model.json")
    paper = ("--form", "paper", "--damping", "full")
    call("identify", "-g", geometry, *runs, *paper, "-o", out / "paper.h5")
    cal = ("reduce", "--calibration", out / "cal.h5")
    call(*cal, "--model", out / "model.h5", *runs, "-o", out / "loads.h5", "--json", out / "loads.json")
    call(*cal, "--model", out / "model.h5", *runs, "-o", out / "loads.csv", "--history", out / "histories")
    call(*cal, "--transfer", out / "tf.h5", *runs, "-o", out / "loads-tf.h5", "--json", out / "loads-tf.json")
    call(*cal, "--model", out / "paper.h5", *runs, "-o", out / "loads-paper.h5", "--json", out / "loads-paper.json")
    call(*cal, "--static", *runs, "-o", out / "loads-static.h5", "--json", out / "loads-static.json")
    return out


def summary(results, name):
    return json.loads((results / f"{name}.json").read_text())


def test_every_summary_has_the_keys_of_the_contract(results):
    trims = summary(results, "cal")["trims"]
    assert set(trims) == {"bare", "trim"}
    assert set(trims["bare"]["residual_percent_fs"]) == {"Fx", "Fy", "Fz", "Mx", "My", "Mz"}
    assert trims["bare"]["condition"] > 1
    transfer = summary(results, "tf")
    assert len(transfer["runs"]) == 6
    assert min(transfer["coherence_min"].values()) > 0.5
    assert "relative_sigma" in transfer
    model = summary(results, "model")
    assert len(model["modes"]) == 7
    assert 0.8 < model["chi2_per_dof"] < 1.2
    assert model["parameters"]["mass"]["rests_on"] == "prior"
    loads = summary(results, "loads")
    assert set(loads["runs"]) == {"check-1", "wind-1"}
    assert set(loads["runs"]["wind-1"]["redundancy"]) == {str(n) for n in range(9)}


def test_the_error_falls_from_method_to_method(results):
    """Static matrix, paper's form, transfer function, identified model: on loads that no fit has seen."""

    def error(name):
        run = summary(results, name)["runs"]["check-1"]
        return np.sqrt(np.mean(np.square(list({**run["load_error"], **run["interaction"]}.values()))))

    assert error("loads-static") > 20 * error("loads")
    assert error("loads-tf") < 0.1
    assert error("loads-paper") < 0.1
    assert error("loads") < 0.01
    assert error("loads") <= error("loads-tf")
    # The rig is rigid, so that the paper's form holds it too, and noise alone parts the two.
    assert error("loads") <= 1.2 * error("loads-paper")


def test_the_table_is_what_scripts_expect(results):
    table = pd.read_csv(results / "loads.csv", keep_default_na=False)
    columns = "run component unit harmonic frequency_hz cosine sine amplitude phase_deg sigma_cosine sigma_sine flag"
    assert list(table.columns) == columns.split()
    assert len(table) == 2 * 6 * 9
    first = table[(table.run == "check-1") & (table.harmonic == 1)].frequency_hz.iloc[0]
    assert first == pytest.approx(17.5, rel=0.05)
    means = table[table.harmonic == 0]
    assert set(means[~means.component.isin(["Fx", "My", "Mz"])].flag) <= {"no zero", "no zero; redundancy"}
    assert set(means.flag) <= {f"no zero{one}{more}" for one in ("", "; untested") for more in ("", "; redundancy")}
    assert table[table.component == "Mz"].flag.str.contains("untested").all()


def test_a_history_is_written_per_run(results):
    import h5py

    with h5py.File(results / "histories" / "wind-1.h5") as file:
        assert file["loads"].shape == (len(file["time"]), 6) == file["sigma"].shape
        assert np.all(np.isfinite(file["loads"]))


def test_same_inputs_same_digest(folder, results):
    from balance_cli.io.artefacts import read_stored

    again = results / "again.h5"
    runs = sorted(folder.glob("*.h5"))
    call("identify", "-g", folder / "geometry.yaml", *runs, "-o", again)
    assert read_stored(again).digest == read_stored(results / "model.h5").digest


def test_another_geometry_than_the_calibrations_is_refused(folder, campaign, results, tmp_path):
    other = campaign.geometry.model_copy(update={"name": "rts-2", "damping_ratio": 0.02})
    save_geometry(tmp_path / "other.yaml", other)
    call("identify", "-g", tmp_path / "other.yaml", "--method", "computed", "-o", tmp_path / "other.h5")
    words = ("--model", tmp_path / "other.h5", folder / "check-1.h5", "-o", tmp_path / "loads.csv")
    result = call("reduce", "--calibration", results / "cal.h5", *words, status=2)
    assert "another geometry" in result.stderr
    assert not (tmp_path / "loads.csv").exists()


@pytest.fixture
def bad(folder, campaign, tmp_path):
    """Files that cannot serve, by name."""
    whole = (folder / "check-1.h5").read_bytes()
    (tmp_path / "truncated.h5").write_bytes(whole[: len(whole) // 2])
    text = (folder / "geometry.yaml").read_text()
    (tmp_path / "wrong-key.yaml").write_text(text.replace("damping_ratio", "damping_ration", 1))
    save_geometry(tmp_path / "other-rig.yaml", campaign.geometry.model_copy(update={"rig": "OTHER"}))
    return tmp_path


@pytest.mark.parametrize(
    ("geometry", "run", "words"),
    [
        ("geometry.yaml", "missing.h5", "missing.h5"),
        ("wrong-key.yaml", "sweep-Fx.h5", "damping_ratio"),
        ("other-rig.yaml", "sweep-Fx.h5", "RTS-6"),
        ("geometry.yaml", "truncated.h5", "truncated.h5"),
        ("geometry.yaml", "geometry.yaml", "geometry.yaml"),
    ],
)
@pytest.mark.parametrize("name", ["calibrate", "sweep-tf", "identify"])
def test_bad_input_is_one_message_and_nothing_written(folder, bad, name, geometry, run, words):
    place = bad if (bad / geometry).exists() else folder
    file = bad / run if (bad / run).exists() else folder / run
    result = call(name, "-g", place / geometry, file, "-o", bad / "out.h5", status=2)
    errors = [line for line in result.stderr.splitlines() if line.startswith("balance: error:")]
    assert len(errors) == 1
    assert words in errors[0]
    assert "Traceback" not in result.stderr
    assert not (bad / "out.h5").exists()


def test_skip_bad_goes_on_and_lists_what_it_skipped(folder, results, bad):
    words = ("--model", results / "model.h5", folder / "check-1.h5", bad / "truncated.h5", "-o", bad / "loads.h5")
    call("reduce", "--calibration", results / "cal.h5", *words, "--skip-bad", "--json", bad / "loads.json")
    written = json.loads((bad / "loads.json").read_text())
    assert list(written["runs"]) == ["check-1"]
    assert any("truncated.h5" in path for path in written["skipped"])


def test_exactly_one_response_is_asked_for(folder, results, tmp_path):
    words = ("--calibration", results / "cal.h5", folder / "check-1.h5", "-o", tmp_path / "loads.csv")
    assert "exactly one" in call("reduce", *words, status=2).stderr
    both = ("--model", results / "model.h5", "--static")
    assert "exactly one" in call("reduce", *words, *both, status=2).stderr


def test_loads_that_the_remaining_channels_do_not_determine_end_with_one_message(folder, results, campaign, tmp_path):
    """The only torque channel is dead: nothing tells Mz."""
    from dataclasses import replace

    from balance_cli.campaign.recording.run import MemorySource

    run = campaign.runs_of_kind("check")[0]
    block = run.read()
    channels = block.channels.copy()
    channels[:, run.channel_names.index("torque")] = 0.0
    write_run(tmp_path / "dead.h5", replace(run, source=MemorySource(channels, block.loads)))
    words = ("--model", results / "model.h5", tmp_path / "dead.h5", "-o", tmp_path / "loads.csv")
    result = call("reduce", "--calibration", results / "cal.h5", *words, status=2)
    errors = [line for line in result.stderr.splitlines() if line.startswith("balance: error:")]
    assert len(errors) == 1
    assert "dead.h5" in errors[0]
    assert "torque" in errors[0]
    assert not (tmp_path / "loads.csv").exists()


def test_a_zero_must_be_a_wind_off_record(folder, results, tmp_path):
    words = ("--model", results / "model.h5", folder / "wind-1.h5", "-o", tmp_path / "loads.csv")
    result = call("reduce", "--calibration", results / "cal.h5", *words, "--zero", folder / "check-1.h5", status=2)
    assert "is a check run" in result.stderr
    assert not (tmp_path / "loads.csv").exists()


def test_static_runs_alone_identify_nothing(folder, tmp_path):
    result = call(
        "identify", "-g", folder / "geometry.yaml", folder / "static-bare.h5", "-o", tmp_path / "m.h5", status=2
    )
    assert "no sweep" in result.stderr
