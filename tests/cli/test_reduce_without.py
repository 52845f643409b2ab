"""`balance reduce` without a calibration and without a rotor; the truth is that of the simulation."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
import yaml
from click.testing import CliRunner

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.campaign.recording.run_file import open_run
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.cli import balance
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.io.artefacts import load_artefact
from balance_cli.reduction.model_sources import model_source
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.steps.reduce_frequencies import reduce_run_at_frequencies
from balance_cli.steps.reduction_inputs import default_harmonics
from tests.support.rigs import rotor_balance

ROOT = Path(__file__).parents[2]
RIG = ROOT / "configs" / "dynamometer.yaml"
RECORD = {"kind": "check", "rotor_speed": 80.0, "duration": 3.0, "sample_rate": 4096.0}
PLAN = {
    "runs": [
        {"run": "tool", **RECORD, "harmonics": {"Fx": [100, 40, 20, 300], "Fz": [50, 30, 10, 100]}, "pulses": False},
        {"run": "turning", **RECORD, "harmonics": {"Fx": [100, 40, 20, 300], "Fz": [50, 30, 10, 100]}},
        {
            "run": "random",
            **RECORD,
            "kind": "wind",
            "duration": 6.0,
            "turbulence": {"Fx": 20.0, "Fy": 10.0, "Mz": 1.0},
            "turbulence_band": [50.0, 900.0],
            "pulses": False,
        },
    ]
}
TONES = (80.0, 160.0, 240.0, 320.0)


def call(*words, status=0):
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == status, result.output
    return result


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Simulated records of the dynamometer, and its computed model (which is the true one)."""
    folder = tmp_path_factory.mktemp("without")
    (folder / "plan.yaml").write_text(yaml.safe_dump(PLAN))
    call("simulate", "-g", RIG, "--plan", folder / "plan.yaml", "-o", folder / "runs")
    call("identify", "-g", RIG, "--method", "computed", "-o", folder / "model.h5")
    return folder


def reduce(folder, run, *words, name="loads.csv"):
    files = ("--model", folder / "model.h5", folder / "runs" / f"{run}.h5", "-o", folder / name)
    result = call("reduce", *files, *words, "--json", "-")
    return pd.read_csv(folder / name, keep_default_na=True), json.loads(result.stdout)["runs"][run], result.stderr


def errors(table, reference):
    """Errors of cosines and sines over their sigma against {(component, row): complex amplitude}."""
    rows = [row for row in table.itertuples() if row.harmonic > 0]
    pairs = [(row, reference[row.component, row.harmonic]) for row in rows]
    cosine = [(row.cosine - value.real) / row.sigma_cosine for row, value in pairs]
    sine = [(row.sine + value.imag) / row.sigma_sine for row, value in pairs]
    return np.array([*cosine, *sine])


def tones_of(file, frequencies, interval):
    """True tones of the loads as applied, without filter: least squares on the samples of the truth."""
    with h5py.File(file) as truth:
        group = truth["tool"]
        time, loads = np.asarray(group["time"]), np.asarray(group["loads"])
    keep = (time >= interval[0]) & (time <= interval[1])
    angle = 2 * np.pi * np.outer(time[keep], frequencies)
    basis = np.hstack([np.ones((keep.sum(), 1)), np.cos(angle), np.sin(angle)])
    found = np.linalg.lstsq(basis, loads[keep], rcond=None)[0]
    k = len(frequencies)
    names = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
    return {(name, i + 1): found[1 + i, j] - 1j * found[1 + k + i, j] for j, name in enumerate(names) for i in range(k)}


def test_without_a_calibration_the_mean_is_not_measured_and_the_harmonics_are(folder):
    table, run, text = reduce(folder, "turning")
    mean = table[table.harmonic == 0]
    assert set(mean.flag) == {"not measured"}
    assert mean[["cosine", "sine", "amplitude", "phase_deg", "sigma_cosine", "sigma_sine"]].isna().all().all()
    assert table[table.harmonic > 0].flag.isna().all()
    assert run["load_error"]["Fx"] < 0.01
    assert run["flags"] == {"not measured": 6}
    assert "trust: not measured" in text


def test_tones_of_a_record_without_pulses_are_the_true_ones(folder):
    words = ("--frequencies", ",".join(map(str, TONES)))
    table, run, text = reduce(folder, "tool", *words)
    assert table[table.component == "Fx"].frequency_hz.tolist() == [0.0, *TONES]
    found = errors(table, tones_of(folder / "runs" / "truth.hdf5", TONES, run["interval_s"]))
    assert np.abs(found).max() < 5.0
    assert run["load_error"]["Fx"] < 0.002
    assert "240 Hz" in text.partition("trust in")[0]


def test_loads_of_the_other_sign_are_named_once_over_all_tones(folder):
    model = load_artefact(folder / "model.h5", {"balance-model/1": IdentifiedModel}).content
    run = open_run(folder / "runs" / "tool.h5")
    block = run.read()
    turned = replace(run, source=MemorySource(block.channels, -block.loads))
    found = reduce_run_at_frequencies(turned, TONES, model.geometry, None, model_source(model), None)
    assert "".join(found.notes).count("reduced loads over applied ones: Fx -1") == 1
    assert all("model contradicted" in flag for row in found.flags[1:] for flag in row)


def test_tones_that_the_record_does_not_resolve_are_refused(folder):
    model, run, out = folder / "model.h5", folder / "runs" / "tool.h5", folder / "x.csv"
    words = ("reduce", "--model", model, run, "-o", out)
    assert "closer than the record resolves" in call(*words, "--frequencies", "80,80.1", status=2).stderr
    assert "`a` is not a frequency" in call(*words, "--frequencies", "80,a", status=2).stderr
    assert "cycles of 0.5 Hz" in call(*words, "--frequencies", "0.5", status=2).stderr
    assert "half the sample rate" in call(*words, "--frequencies", "3000", status=2).stderr
    assert "no 1/rev pulses" in call(*words, status=2).stderr
    assert "--band" in call(*words, "--band", "10", "5", status=2).stderr
    assert "beyond what the record" in call(*words, "--band", "10", "2000", status=2).stderr
    assert "needs a static calibration" in call(*words, "--zero", run, status=2).stderr
    assert not out.exists()


def test_tones_beside_each_other_do_not_leak(folder):
    """Neighbors 1.5 lines apart: regressed alone, each would take up much of the other."""
    import shutil

    path = folder / "runs" / "beside.h5"
    shutil.copy(folder / "runs" / "tool.h5", path)
    with h5py.File(path, "r+") as file:
        file.attrs["run"] = "beside"
        time = np.arange(len(file["channels"])) / 4096.0
        file["channels"][:, :] += (0.05 * np.cos(2 * np.pi * 320.5 * time))[:, None]
    apart, _, _ = reduce(folder, "beside", "--frequencies", "320,320.5")
    alone, _, _ = reduce(folder, "tool", "--frequencies", "320")

    def tone(table):
        row = table[(table.component == "Fx") & (table.frequency_hz == 320.0)].iloc[0]
        return row.cosine - 1j * row.sine, max(row.sigma_cosine, row.sigma_sine)

    (beside, sigma), (single, _) = tone(apart), tone(alone)
    assert abs(beside - single) < 5.0 * sigma


def test_a_smoother_follows_the_multiples_of_a_frequency(folder):
    words = ("--method", "smoother", "--frequencies", "80", "--harmonics", "4", "--history", folder / "history")
    _, run, _ = reduce(folder, "tool", *words)
    assert run["load_error"]["Fx"] < 0.005
    with h5py.File(folder / "history" / "tool.h5") as file, h5py.File(folder / "runs" / "truth.hdf5") as truth:
        assert file.attrs["mean"] == "not measured"
        time, loads = np.asarray(file["time"]), np.asarray(file["loads"])
        true = np.array([np.interp(time, truth["tool/time"], truth["tool/loads"][:, i]) for i in (0, 2)]).T
    late = time > 1.5
    assert np.std((loads[:, [0, 2]] - true)[late], axis=0) == pytest.approx([0, 0], abs=0.05 * np.std(true[:, 0]))


def test_densities_are_those_of_the_true_loads(folder):
    band = (60.0, 800.0)
    table, run, _ = reduce(folder, "random", "--band", *band)
    with h5py.File(folder / "runs" / "truth.hdf5") as truth:
        loads = np.asarray(truth["random/loads"])
    start = int(run["interval_s"][0] * 4096)
    for column, name in ((0, "Fx"), (1, "Fy"), (5, "Mz")):
        part = table[table.component == name]
        step = np.diff(part.frequency_hz).mean()
        spectrum = np.abs(np.fft.rfft(loads[start:, column])) ** 2
        frequency = np.fft.rfftfreq(len(loads) - start, 1 / 4096)
        inside = (frequency >= band[0]) & (frequency <= band[1])
        mean_square = 2 * spectrum[inside].sum() / (len(loads) - start) ** 2
        assert step * part.density.sum() == pytest.approx(mean_square, rel=0.03)
        value = run["band_rms"][name]
        assert value["value"] == pytest.approx(np.sqrt(mean_square), abs=4 * value["sigma"])
        level = part.density.median()
        assert np.std(part.density / level) == pytest.approx(np.median(part.sigma_density / level), rel=0.35)
    quiet = table[table.component == "Mx"]
    assert (quiet.density / quiet.noise_density).quantile(0.1) > 0.7
    loud = table[table.component == "Fy"]
    assert quiet.density.median() < 1e-5 * loud.density.median()  # what the bandwidth of the window leaves
    assert run["redundancy_max"] < 2.0
    assert run["trust"] == "good"


def test_spectra_are_artefacts(folder):
    from balance_cli.api.artefacts import load_artefact

    files = ("--model", folder / "model.h5", folder / "runs" / "random.h5", "-o", folder / "s.h5")
    call("reduce", *files, "--band", 60, 800)
    spectra = load_artefact(folder / "s.h5")
    assert set(spectra.runs) == {"random"}
    assert "60 to 800 Hz" in repr(spectra)


def test_a_record_of_a_rotor_needs_its_pulses(folder, tmp_path):
    path = tmp_path / "run.h5"
    path.write_bytes((folder / "runs" / "tool.h5").read_bytes())
    with h5py.File(path, "r+") as file:
        file.attrs["rotor_speed"] = 80.0
    message = call("check", path, status=2).stdout
    assert "rotor/pulse_times" in message and "set `rotor_speed` to 0" in message


@pytest.mark.parametrize(("blades", "harmonics"), [(1, 8), (2, 8), (3, 9), (4, 8), (5, 10), (6, 12), (7, 14)])
def test_harmonics_are_whole_multiples_of_the_blades(blades, harmonics):
    geometry = rotor_balance()
    rotor = geometry.rotor.model_copy(update={"blades": blades})
    assert default_harmonics(geometry.model_copy(update={"rotor": rotor})) == harmonics


def test_filter_of_the_dynamometer_is_taken_out():
    """The loads of the truth have no filter: at 320 Hz it would turn the phase by much more than sigma."""
    response = anti_alias_response(load_geometry(RIG).acquisition, np.array([320.0]))
    assert abs(np.angle(response[0])) > 0.5
