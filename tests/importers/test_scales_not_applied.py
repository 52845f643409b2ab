"""Raw integers whose scale is not applied: an import says so, or asks for the scale."""

import h5py
import numpy as np
import pytest

from balance_cli.campaign.recording.import_map import ImportMap
from balance_cli.campaign.recording.import_map_file import declared_runs
from balance_cli.importers import open_foreign
from balance_cli.io.errors import UserError
from balance_cli.steps.import_runs import import_run
from balance_cli.steps.import_sketch import sketch_map

COUNTS = np.random.default_rng(2).integers(-9000, 9000, 50).astype(np.int16)
WAVEFORM = {"wf_increment": 0.001, "unit_string": "V"}


def imported(path, entry):
    mapping = {"channels": {"F1": entry}, "runs": [{"file": "*", "kind": "zero", "run": "zero-1"}]}
    mapping = ImportMap.model_validate({"format": "balance-import/1", "rig": "r"} | mapping)
    imported = import_run(declared_runs(mapping, [path], "map")[0], [open_foreign(path)])
    return np.concatenate([block.channels for block in imported.run.blocks(20)])[:, 0], imported.notes


def write_tdms(path, properties, on="channel", values=COUNTS):
    nptdms = pytest.importorskip("nptdms")
    held = {place: properties if place == on else {} for place in ("file", "group", "channel")}
    channel = nptdms.ChannelObject("g", "F1", values, WAVEFORM | held["channel"])
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([nptdms.RootObject(held["file"]), nptdms.GroupObject("g", held["group"]), channel])


def scales(*types):
    properties = {"NI_Number_Of_Scales": len(types), "NI_Scaling_Status": "unscaled"}
    for k, kind in enumerate(types):
        stated = {"Scale_Type": kind, f"{kind}_Input_Source": 0xFFFFFFFF if k == 0 else k - 1}
        stated |= {"Linear_Slope": 1e-4, "Linear_Y_Intercept": 0.25} if kind == "Linear" else {}
        properties |= {f"NI_Scale[{k}]_{name}": value for name, value in stated.items()}
    return properties


@pytest.mark.parametrize("on", ["file", "group", "channel"])
@pytest.mark.parametrize("types", [("Reciprocal",), ("Linear", "Reciprocal")])
def test_a_scale_of_tdms_that_cannot_be_applied_must_be_stated(tmp_path, types, on):
    """The raw counts were taken for volts."""
    path = tmp_path / "record.tdms"
    write_tdms(path, scales(*types), on)
    with pytest.raises(UserError, match="holds raw values: a scale of type `Reciprocal` cannot be applied"):
        imported(path, {"name": "z1", "unit": "V"})
    assert np.allclose(imported(path, {"name": "z1", "unit": "V", "scale": 1e-3})[0], 1e-3 * COUNTS, rtol=1e-15)
    sketch = sketch_map([open_foreign(path)], None)
    assert "scale: TODO}" in sketch and "a scale of type `Reciprocal`" in sketch


def test_scales_of_tdms_that_are_applied_need_no_other(tmp_path):
    path = tmp_path / "record.tdms"
    write_tdms(path, scales("Linear"))
    values, notes = imported(path, {"name": "z1"})
    assert np.allclose(values, 1e-4 * COUNTS + 0.25) and not notes
    write_tdms(path, scales("Reciprocal") | {"NI_Scaling_Status": "scaled"}, values=1.0 / (COUNTS + 0.5))
    values, notes = imported(path, {"name": "z1"})
    assert np.allclose(values, 1.0 / (COUNTS + 0.5)) and not notes


def test_a_gain_beside_integers_that_the_map_leaves_out_is_said(tmp_path):
    """Only the sketch said so: counts were volts without a word."""
    path = tmp_path / "record.h5"
    with h5py.File(path, "w") as file:
        file["F1"] = COUNTS
        file["F1"].attrs.update({"unit": "V", "gain": 1e-4, "dt": 1e-3})
    values, notes = imported(path, "z1")
    assert np.array_equal(values, COUNTS) and notes == (
        "F1: integers; gain 0.0001, as the file states, was not applied, since the map has no `scale`",
    )
    values, notes = imported(path, {"name": "z1", "scale": 1e-4})
    assert np.allclose(values, 1e-4 * COUNTS, rtol=1e-15) and not notes
    assert not imported(path, {"name": "z1", "scale": 1.0})[1]


def rtd(lead, wires):
    """A Pt100 at 1 mA, by IEC 60751."""
    stated = {"Current_Excitation": 1e-3, "R0_Nominal_Resistance": 100.0, "A": 3.9083e-3, "B": -5.775e-7}
    stated |= {"C": -4.183e-12, "Lead_Wire_Resistance": lead, "Resistance_Configuration": wires}
    stated = {f"RTD_{name}": value for name, value in (stated | {"Input_Source": 0xFFFFFFFF}).items()}
    return {f"NI_Scale[0]_{name}": value for name, value in (stated | {"Scale_Type": "RTD"}).items()}


@pytest.mark.filterwarnings("ignore:'where' used without 'out'")  # npTDMS 1.13 overwrites what it leaves open
@pytest.mark.parametrize(("lead", "wires", "in_series"), [(0.0, 4, 0.0), (1.0, 3, 1.0), (0.5, 2, 1.0)])
def test_resistance_thermometers_of_tdms(tmp_path, lead, wires, in_series):
    """Of IEC 60751, table 1: 60.26, 100, 138.51 and 212.05 ohm at -100, 0, 100 and 300 degC."""
    volts = 1e-3 * (np.array([60.26, 100.0, 138.51, 212.05]) + in_series)
    write_tdms(tmp_path / "record.tdms", rtd(lead, wires), values=volts)
    (group,) = open_foreign(tmp_path / "record.tdms").groups
    assert group.read([0], 0, 4)[:, 0] == pytest.approx([-100.0, 0.0, 100.0, 300.0], abs=0.02)


def test_thermocouples_of_tdms(tmp_path):
    """Type K by IEC 60584-1: -3554, 0, 4096 and 20644 microvolts at -100, 0, 100 and 500 degC."""
    stated = {"Thermocouple_Type": 10073, "Scaling_Direction": 0, "Input_Source": 0xFFFFFFFF}
    scale = {"NI_Scale[0]_Scale_Type": "Thermocouple"}
    scale |= {f"NI_Scale[0]_Thermocouple_{name}": value for name, value in stated.items()}
    write_tdms(tmp_path / "record.tdms", scale, values=np.array([-3554.0, 0.0, 4096.0, 20644.0]))
    (group,) = open_foreign(tmp_path / "record.tdms").groups
    assert group.read([0], 0, 4)[:, 0] == pytest.approx([-100.0, 0.0, 100.0, 500.0], abs=0.06)
