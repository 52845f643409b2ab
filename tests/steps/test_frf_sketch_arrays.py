"""Draft maps of frequency responses from the names of columns and variables."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from balance_cli.importers.base import TextLayout
from balance_cli.importers.frf.variables import Variables, open_variables
from balance_cli.steps.frf_sketch import sketch_frf_map
from balance_cli.steps.frf_sketch_arrays import SketchedArrays
from tests.support.rigs import CONFIGS, load_geometry

RIG = load_geometry(CONFIGS / "rts-6.yaml")
LINES = 20


def a_file(name, units, kind=float):
    arrays = {"Frequency": np.arange(LINES, dtype=float)} | {key: np.ones(LINES, kind) for key in units}
    return Variables(Path(name), "text", arrays, units | {"Frequency": "Hz"})


@pytest.mark.parametrize(
    ("magnitude", "phase"),
    [
        ("x.strain Mag", "x.strain Phase"),
        ("|x.strain| over Fy_abs", "|x.strain| over Fy_angle"),
        ("Magnitude [X.Strain, Fy]", "Phase [X.Strain, Fy]"),
        ("x.strain/Fy Betrag", "x.strain/Fy Phase"),
    ],
)
def test_magnitude_and_phase_of_a_channel_are_a_pair(magnitude, phase):
    file = a_file("frf_Fy.csv", {magnitude: "N/N", phase: "rad"})
    sketch = yaml.safe_load(sketch_frf_map([file], RIG))
    pair = {"file": "frf_Fy.csv", "response": "x.strain", "reference": "Fy", "magnitude": magnitude, "phase": phase}
    assert sketch["pairs"] == [pair]
    assert sketch["responses"] == {"x.strain": {"name": "x.strain", "unit": "N"}}
    assert sketch["references"] == {"Fy": {"component": "Fy", "unit": "N"}}
    assert sketch["phase_unit"] == "rad" and sketch["frequency"] == "Frequency"


@pytest.mark.parametrize(
    ("columns", "parts"),
    [
        ({"Real": "m/s^2/N", "Imag": "m/s^2/N"}, {"real": "Real", "imaginary": "Imag"}),
        ({"Amp": "dB", "Phase": "deg", "Coh": ""}, {"magnitude": "Amp", "phase": "Phase", "coherence": "Coh"}),
    ],
)
def test_columns_of_one_response_may_be_called_by_their_parts(columns, parts):
    pair = yaml.safe_load(sketch_frf_map([a_file("x.strain_Fy.csv", columns)], RIG))["pairs"][0]
    assert pair == {"file": "x.strain_Fy.csv", "response": "x.strain", "reference": "Fy", **parts}


@pytest.mark.parametrize("form", ["({x.real:.6f}{x.imag:+.6f}j)", "{x.real:.6f} {x.imag:+.6f}i"])
def test_complex_numbers_in_text_are_read(tmp_path, form):
    values = np.exp(1j * np.arange(LINES)) * 3.0
    rows = "".join(f"{k}.0,{form.format(x=x)},word\n" for k, x in enumerate(values))
    (tmp_path / "frf.csv").write_text("Frequency,H11,Remark\n" + rows)
    variables = open_variables(tmp_path / "frf.csv", TextLayout())
    assert set(variables.arrays) == {"Frequency", "H11"}
    np.testing.assert_allclose(variables.arrays["H11"], values, atol=1e-6)


def test_a_unit_that_is_no_quotient_is_that_of_neither_end():
    columns = {"x.strain/Fy Mag": "dB", "x.strain/Fy Phase": "deg"}
    sketch = sketch_frf_map([a_file("frf.csv", columns)], RIG)
    assert "magnitude_unit: dB" in sketch and '"x.strain": {name: "x.strain", unit: "TODO"}' in sketch
    assert 'Fy: {component: Fy, unit: "TODO"}' in sketch


def test_files_of_several_components_make_one_map():
    columns = {"Re(y1.strain)": "V/N", "Im(y1.strain)": "V/N", "Coh(y1.strain)": ""}
    moment = {"Re(y1.strain)": "V/(N m)", "Im(y1.strain)": "V/(N m)"}
    sketch = yaml.safe_load(sketch_frf_map([a_file("Fx.txt", columns), a_file("Mz.txt", moment)], RIG))
    assert [(pair["reference"], "coherence" in pair) for pair in sketch["pairs"]] == [("Fx", True), ("Mz", False)]
    assert {name: item["unit"] for name, item in sketch["references"].items()} == {"Fx": "N", "Mz": "N m"}
    assert list(sketch["responses"]) == ["y1.strain"]


def test_complex_vectors_are_named_by_channel_and_component():
    pairs = SketchedArrays([a_file("frf.mat", {"H_torque_Mz": ""}, complex)], RIG.channel_names).pairs
    assert [(pair.channel, pair.component, pair.parts) for pair in pairs] == [
        ("torque", "Mz", {"value": "H_torque_Mz"})
    ]


def test_what_names_do_not_tell_is_to_be_completed():
    sketch = sketch_frf_map([a_file("run.csv", {"cell 7 Mag": "", "cell 7 Phase": "deg"})], RIG)
    assert "response: TODO, reference: TODO" in sketch and "# a name of yours" in sketch
    nothing = sketch_frf_map([a_file("run.csv", {"a": "", "b": ""})], None)
    assert "real: " in nothing and nothing.count("TODO") >= 6
