"""A response needs the names of channels and loads alone: it is measured and shown without masses and stiffness."""

import csv
import json

import numpy as np
from click.testing import CliRunner
from scipy import signal

from balance_cli.cli import balance

RATE, SAMPLES, MODE, DAMPING = 200.0, 8000, 12.5, 0.03
GEOMETRY = """format: balance-geometry/1
name: beam
rig: beam
channels: [{name: tip, unit: V}]
freedom: [z]
"""
MAP = """format: balance-import/1
rig: beam
time: t
channels: {tip: tip}
loads: {force: Fz}
runs: [{file: "*.csv", run: shaker, kind: sweep, excited: Fz, excitation: random}]
"""


def call(*words, status=0):
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == status, result.output
    return result


def write_record(path):
    """The tip of a beam with one mode, sampled with the force of a shaker that is held between samples."""
    omega = 2 * np.pi * MODE
    system = signal.cont2discrete(([omega**2], [1.0, 2 * DAMPING * omega, omega**2]), 1 / RATE)
    force = np.random.default_rng(6).standard_normal(SAMPLES)
    tip = signal.lfilter(system[0].ravel(), system[1], force)
    rows = [f"{k / RATE:.4f},{tip[k]:.9f},{force[k]:.9f}" for k in range(SAMPLES)]
    path.write_text("\n".join(["t [s],tip [V],force [N]", *rows]) + "\n")
    return system


def test_a_response_needs_no_masses_and_no_stiffness(tmp_path):
    system = write_record(tmp_path / "record.csv")
    (tmp_path / "map.yaml").write_text(MAP)
    (tmp_path / "beam.yaml").write_text(GEOMETRY)
    call("import", tmp_path / "map.yaml", tmp_path / "record.csv", "-o", tmp_path / "runs")
    run, transfer = tmp_path / "runs" / "shaker.h5", tmp_path / "tf.h5"
    call("sweep-tf", "-g", tmp_path / "beam.yaml", run, "--to", 40, "-o", transfer, "--json", tmp_path / "tf.json")
    assert json.loads((tmp_path / "tf.json").read_text())["coherence_min"]["Fz"] > 0.9
    call("export", transfer, "-o", tmp_path / "tf.csv")
    with (tmp_path / "tf.csv").open() as file:
        rows = list(csv.DictReader(file))
    frequency = np.array([float(row["frequency_hz"]) for row in rows])
    amplitude = np.array([float(row["magnitude"]) for row in rows])
    true = np.abs(signal.freqz(system[0].ravel(), system[1], frequency, fs=RATE)[1])
    assert abs(frequency[np.argmax(amplitude)] - MODE) < 0.1
    near = np.abs(frequency / MODE - 1.0) < 0.5
    np.testing.assert_allclose(amplitude[near], true[near], rtol=0.02)
    call("report", transfer, "-o", tmp_path / "page.html")


def test_a_model_needs_them_and_the_refusal_says_what_does_not(tmp_path):
    write_record(tmp_path / "record.csv")
    (tmp_path / "map.yaml").write_text(MAP)
    (tmp_path / "beam.yaml").write_text(GEOMETRY)
    call("import", tmp_path / "map.yaml", tmp_path / "record.csv", "-o", tmp_path / "runs")
    said = call(
        "identify", "-g", tmp_path / "beam.yaml", tmp_path / "runs/shaker.h5", "-o", tmp_path / "m.h5", status=2
    )
    assert "`calibrate`, `apply` and `sweep-tf` do without it" in said.output
