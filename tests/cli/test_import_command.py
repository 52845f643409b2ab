"""`balance import`: run files from foreign files, against the run files that these were made from."""

import json
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import yaml
from click.testing import CliRunner

from balance_cli.campaign.recording.run_file import open_run
from balance_cli.cli import balance
from balance_cli.simulation.rotor import RotorKinematics

ROOT = Path(__file__).parents[2]
COMPONENTS = ["Fx", "Fy", "Fz", "Mx", "My", "Mz"]
UNITS = ["N", "N", "N", "N m", "N m", "N m"]


def invoke(*words):
    return CliRunner().invoke(balance, [str(word) for word in words])


def run_import(folder, mapping, *files, status=0):
    (folder / "map.yaml").write_text(yaml.safe_dump(mapping, sort_keys=False), encoding="utf-8")
    result = invoke("import", folder / "map.yaml", *files, "-o", folder / "runs", "--json", folder / "summary.json")
    assert result.exit_code == status, result.output
    if status:
        assert not (folder / "runs").exists() and result.stderr.count("\n") == 1
    return result


def base_map(**keys):
    return {"format": "balance-import/1", "rig": "RTS-6", **keys}


@pytest.fixture(scope="module")
def static():
    return open_run(ROOT / "sample_data" / "static-bare.h5")


@pytest.fixture(scope="module")
def sweep():
    return open_run(ROOT / "sample_data" / "sweep-Fz-high.h5")


def write_static_csv(path, run):
    block = run.read()
    table = np.hstack([1e3 * block.channels, block.loads[:, :3] / 4.4482216152605, -block.loads[:, 3:]])
    names = [*run.channel_names, *COMPONENTS]
    units = ["mV"] * len(run.channel_names) + ["lbf"] * 3 + ["N m"] * 3
    lines = ["Bilanz;;;", ";".join(names), ";".join(units)]
    lines += [";".join(repr(value).replace(".", ",") for value in row) for row in table.tolist()]
    path.write_text("\n".join(lines), encoding="utf-16")


def test_static_run_of_a_spreadsheet(tmp_path, static):
    write_static_csv(tmp_path / "static-bare.csv", static)
    mapping = base_map(
        channels={name: name for name in static.channel_names},
        loads={name: {"component": name, "sign": 1 if name.startswith("F") else -1} for name in COMPONENTS},
        runs=[{"file": "static-{trim}.csv", "kind": "static", "trim": "{trim}"}],
    )
    run_import(tmp_path, mapping, tmp_path / "static-bare.csv")
    run = open_run(tmp_path / "runs" / "static-bare.h5")
    assert (run.kind, run.trim, run.channel_names) == ("static", "bare", static.channel_names)
    assert np.allclose(run.read().channels, static.read().channels, rtol=1e-12, atol=1e-18)
    assert np.allclose(run.read().loads, static.read().loads, rtol=1e-12, atol=1e-12)


def sweep_map(sweep, **keys):
    return base_map(
        channels={f"V[{k + 1}]": {"name": name, "unit": "V"} for k, name in enumerate(sweep.channel_names)},
        loads={f"F[{k + 1}]": {"component": name, "unit": UNITS[k]} for k, name in enumerate(COMPONENTS)},
        runs=[
            {"file": "sweep-{what}-*", "kind": "sweep", "excited": "{what}", "excitation": "multisine", "period": 4.0}
        ],
        **keys,
    )


def write_sweep_mat(path, sweep, samples=8000):
    block = sweep.read(0, samples)
    time = np.arange(samples)[:, None] / sweep.sample_rate
    scipy.io.savemat(path, {"V": block.channels, "F": block.loads, "t": time}, appendmat=False)


def test_sweep_of_a_mat_file(tmp_path, sweep):
    write_sweep_mat(tmp_path / "sweep-Fz-1.mat", sweep)
    result = run_import(tmp_path, sweep_map(sweep, time="t"), tmp_path / "sweep-Fz-1.mat")
    run, expected = open_run(tmp_path / "runs" / "sweep-Fz-1.h5"), sweep.read(0, 8000)
    assert (run.sample_rate, run.excited, run.period) == (sweep.sample_rate, ("Fz",), 4.0)
    assert np.array_equal(run.read().channels, expected.channels) and np.array_equal(run.read().loads, expected.loads)
    assert run.level[0] == pytest.approx(np.std(expected.loads[:, 2]), rel=1e-5)
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary["runs"]["sweep-Fz-1"]["samples"] == 8000 and "level of the excitation" in result.output


def write_wind_hdf5(path, rate=4000.0, tachometer_rate=20000.0, duration=6.0):
    rotor = RotorKinematics(17.5, drift=0.01)
    slow, fast = np.arange(duration * rate) / rate, np.arange(duration * tachometer_rate) / tachometer_rate
    with h5py.File(path, "w") as file:
        for k in range(7):
            file[f"a{k}"] = np.cos((k + 1) * rotor.azimuth(slow))
            file[f"a{k}"].attrs["unit"], file[f"a{k}"].attrs["sample_rate"] = "V", rate
        file["tacho"] = 5.0 * ((rotor.azimuth(fast) / (2 * np.pi)) % 1.0 < 0.05)
        file["tacho"].attrs["sample_rate"] = tachometer_rate
    return rotor


def wind_map(**keys):
    channels = {f"a{k}": f"c{k}" for k in range(7)}
    run = {"file": "*", "run": "wind-1", "kind": "wind"}
    return base_map(channels=channels, rotor={"channel": "tacho"}, runs=[run], **keys)


def test_wind_run_with_a_tachometer_and_another_rate(tmp_path):
    rotor = write_wind_hdf5(tmp_path / "record")
    result = run_import(tmp_path, wind_map(resample=1000), tmp_path / "record")
    run = open_run(tmp_path / "runs" / "wind-1.h5")
    assert run.sample_rate == 1000.0 and run.rotor_speed == pytest.approx(17.5, rel=0.01)
    assert "resampled from 4000 Hz to 1000 Hz" in result.output and "common part" in result.output
    # Resampling needs half a kernel before its first sample: the record begins later, and so do its pulses.
    channels = run.read().channels
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))["runs"]["wind-1"]
    begin = summary["start"]
    time = begin + np.arange(run.samples) / 1000.0
    expected = np.cos(np.arange(1, 8) * rotor.azimuth(time)[:, None])
    assert np.abs(channels - expected).max() < 1e-4
    azimuth = (np.degrees(rotor.azimuth(run.pulse_times + begin)) + 180) % 360 - 180
    assert np.abs(azimuth).max() < 0.3
    assert begin == pytest.approx(0.033) and summary["rotor"]["azimuth_error_deg"] < 0.1


def test_a_sketch_becomes_a_map(tmp_path, static):
    write_static_csv(tmp_path / "static-bare.csv", static)
    geometry = ROOT / "configs" / "rts-6.yaml"
    result = invoke("import", "--sketch", "-g", geometry, tmp_path / "static-bare.csv")
    assert result.exit_code == 0, result.output
    text = result.stdout
    (tmp_path / "map.yaml").write_text(text, encoding="utf-8")
    refused = invoke("import", tmp_path / "map.yaml", tmp_path / "static-bare.csv", "-o", tmp_path / "runs")
    assert refused.exit_code == 2 and "`TODO` is left of the sketch" in refused.stderr
    (tmp_path / "map.yaml").write_text(text.replace("trim: TODO", "trim: bare"), encoding="utf-8")
    done = invoke("import", tmp_path / "map.yaml", tmp_path / "static-bare.csv", "-o", tmp_path / "runs")
    assert done.exit_code == 0, done.output
    assert np.allclose(open_run(tmp_path / "runs" / "static-bare.h5").read().channels, static.read().channels)
    assert invoke("check", tmp_path / "map.yaml", "-g", geometry).exit_code == 0


def change(mapping, *path, value):
    target = mapping
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value


@pytest.mark.parametrize(
    ("path", "value", "place", "words"),
    [
        (("chanels",), {}, "chanels", "nearest known key is `channels`"),
        (("channels", "V[1]", "unti"), "V", "channels.V[1].unti", "nearest known key is `unit`"),
        (("channels", "V[1]", "unit"), "parsec", "channel `V[1]`", "unknown unit"),
        (("channels", "V[1]", "unit"), "N", "channel `V[1]`", "Add `scale`"),
        (("channels", "V[1]", "scale"), 0.0, "channels.V[1]", "`scale` is zero"),
        (("channels", "V[1]", "name"), "x.piezo", "", "`x.piezo`"),
        (("channels", "V[99]"), {"name": "new", "unit": "V"}, "", "nearest of its"),
        (("loads", "F[1]", "unit"), "N m", "channel `F[1]`", "is a unit of N m"),
        (("runs", 0, "kind"), "sweeep", "runs[0].kind", "sweep"),
        (("runs", 0, "file"), "*.csv", "runs", "no entry fits"),
        (("runs", 0, "excited"), "{who}", "runs[0]", "`{who}` is not in the pattern"),
        (("runs", 0, "excited"), "Fq", "runs[0]", "`Fq` is no component"),
        (("runs", 0, "excitation"), "noise", "attribute excitation", "multisine"),
        (("runs", 0, "period"), None, "attribute period", "period"),
        (("rig",), None, "rig", "rig"),
        (("time",), "V[1]", "time `V[1]`", "time"),
        (("sample_rate",), 800.0, "", "either `time` or `sample_rate`"),
        (("format",), "balance-geometry/1", "format", "--sketch"),
    ],
)
def test_bad_maps_are_one_message_and_nothing_written(tmp_path, sweep, path, value, place, words):
    write_sweep_mat(tmp_path / "sweep-Fz-1.mat", sweep, 2000)
    mapping = sweep_map(sweep, time="t")
    change(mapping, *path, value=value)
    result = run_import(tmp_path, mapping, tmp_path / "sweep-Fz-1.mat", status=2)
    assert words in result.stderr and place in result.stderr


def test_a_bad_file_among_good_ones_leaves_nothing(tmp_path, sweep):
    write_sweep_mat(tmp_path / "sweep-Fz-1.mat", sweep, 2000)
    content = (tmp_path / "sweep-Fz-1.mat").read_bytes()
    (tmp_path / "sweep-Fz-2.mat").write_bytes(content[: len(content) // 2])
    files = [tmp_path / "sweep-Fz-1.mat", tmp_path / "sweep-Fz-2.mat"]
    result = run_import(tmp_path, sweep_map(sweep, time="t"), *files, status=2)
    assert "sweep-Fz-2.mat" in result.stderr


def test_files_without_time_need_a_rate(tmp_path, sweep):
    write_sweep_mat(tmp_path / "sweep-Fz-1.mat", sweep, 2000)
    result = run_import(tmp_path, sweep_map(sweep), tmp_path / "sweep-Fz-1.mat", status=2)
    assert "no sample rate" in result.stderr and "sample_rate: HZ" in result.stderr


def test_a_wind_run_whose_tachometer_stands_still_is_refused(tmp_path):
    write_wind_hdf5(tmp_path / "record", duration=1.0)
    with h5py.File(tmp_path / "record", "r+") as file:
        file["tacho"][:] = 0.0
    result = run_import(tmp_path, wind_map(), tmp_path / "record", status=2)
    assert "channel `tacho` (rotor of the map): is constant" in result.stderr


def test_every_key_of_a_map_is_in_the_manual():
    from balance_cli.campaign.recording.import_map import ImportMap
    from tests.test_docs import keys

    words = set(re.findall(r"`(\w+)`", re.sub(r"[{}(),:]", "` `", (ROOT / "docs" / "import.md").read_text("utf-8"))))
    assert keys(ImportMap) - words == set()


def test_forces_at_points_temperatures_and_a_second_rotor(tmp_path):
    rotor = write_wind_hdf5(tmp_path / "record")
    with h5py.File(tmp_path / "record", "r+") as file:
        time = np.arange(file["a0"].size) / 4000.0
        for name, unit, values in (("hammer", "lbf", np.sin(time)), ("tc", "K", 293.15 + time)):
            file[name] = values
            file[name].attrs["unit"], file[name].attrs["sample_rate"] = unit, 4000.0
        file["tail"] = 5.0 * ((3.0 * rotor.azimuth(time) / (2 * np.pi)) % 1.0 < 0.1)
        file["tail"].attrs["sample_rate"] = 4000.0
    mapping = wind_map(
        load_points=[{"channel": "hammer", "position": [0, 0, 1], "direction": [1, 0, 0], "name": "tip", "sign": -1}],
        temperature={"tc": "beam"},
        rotor2={"channel": "tail"},
    )
    mapping["runs"] = [{"file": "*", "run": "check-1", "kind": "check"}]
    run_import(tmp_path, mapping, tmp_path / "record")
    run = open_run(tmp_path / "runs" / "check-1.h5")
    parts = run.additions
    assert np.allclose(parts.read("load_points/force", 0, 99)[:, 0], -4.4482216152605 * np.sin(time[:99]))
    assert np.allclose(parts.read("temperature", 0, 99)[:, 0], 20.0 + time[:99]) and parts.temperature_names == (
        "beam",
    )
    assert np.allclose(np.diff(parts.further_pulse_times[0]), 1 / 52.5, rtol=0.05)
    assert parts.azimuth_error_deg < 0.1


def test_the_level_of_a_force_at_a_point_is_measured(tmp_path):
    """A stinger beside the hub is a sweep without hub loads; the moment about the hub is not known to the map."""
    time = np.arange(2000) / 500.0
    rows = np.column_stack([time, np.sin(40.0 * time), 5.0 * np.sin(30.0 * time)])
    np.savetxt(tmp_path / "stinger.csv", rows, delimiter=",", header="t [s],B1 [V],force [N]", comments="")
    point = {"channel": "force", "position": [0.1, 0.0, 0.4], "direction": [0.6, 0.0, 0.8], "name": "P1"}
    mapping = {"format": "balance-import/1", "rig": "R", "time": "t", "channels": {"B1": "z1.strain"}}
    mapping |= {"load_points": [point]}
    mapping["runs"] = [{"file": "*", "run": "s", "kind": "sweep", "excited": "Fz", "excitation": "random"}]
    run_import(tmp_path, mapping, tmp_path / "stinger.csv")
    assert open_run(tmp_path / "runs" / "s.h5").level == pytest.approx((0.8 * 5.0 / np.sqrt(2.0),), rel=0.02)


def test_the_taps_of_a_hammer_at_a_point_are_counted(tmp_path):
    rng, time = np.random.default_rng(1), np.arange(8000) / 1000.0
    force = 200.0 * np.sum([np.exp(-(((time - at) / 0.002) ** 2)) for at in (1.0, 4.0)], axis=0)
    rows = np.column_stack([time, rng.standard_normal(8000), -force + 0.05 * rng.standard_normal(8000)])
    np.savetxt(tmp_path / "tap.csv", rows, delimiter=",", header="t [s],B1 [V],Hammer [N]", comments="")
    point = {"channel": "Hammer", "position": [0.1, 0.0, 0.4], "direction": [0.0, 0.0, 1.0]}
    mapping = {"format": "balance-import/1", "rig": "R", "time": "t", "channels": {"B1": "z1.strain"}}
    mapping |= {
        "load_points": [point],
        "runs": [{"file": "*", "kind": "sweep", "excited": "Fz", "excitation": "impact"}],
    }
    assert "Fz: 2 taps" in run_import(tmp_path, mapping, tmp_path / "tap.csv").stdout


def test_loads_of_files_that_differ_belong_to_their_runs(tmp_path):
    (tmp_path / "a.csv").write_text("t [s],B1 [V],F [N],G [N]\n0,0,0,0\n0.1,0,0,0\n", encoding="utf-8")
    mapping = {"format": "balance-import/1", "rig": "R", "time": "t", "channels": {"B1": "z1.strain"}}
    mapping |= {"loads": {"F": "Fx", "G": "Fx"}, "runs": [{"file": "*", "kind": "check"}]}
    assert (
        "of the entries of `runs` that have them" in run_import(tmp_path, mapping, tmp_path / "a.csv", status=2).stderr
    )


def test_a_slow_temperature_sets_neither_rate_nor_length(tmp_path):
    rotor = write_wind_hdf5(tmp_path / "record")
    with h5py.File(tmp_path / "record", "r+") as file:
        file["tc"] = [20.0, 21.0, 23.0, np.nan, 22.0, 21.0]
        file["tc"].attrs["unit"], file["tc"].attrs["sample_rate"] = "degC", 1.0
    result = run_import(tmp_path, wind_map(temperature={"tc": "beam"}), tmp_path / "record")
    run = open_run(tmp_path / "runs" / "wind-1.h5")
    assert (run.sample_rate, run.samples) == (4000.0, 24000)
    assert "tc: interpolated linearly from 1 Hz to 4000 Hz" in result.output and "common part" not in result.output
    time = np.arange(run.samples) / 4000.0
    assert np.array_equal(run.read().channels[:, 0], np.cos(rotor.azimuth(time)))
    temperature = run.additions.read("temperature", 0, run.samples)[:, 0]
    known = (time <= 2.0) | (time > 4.0)
    expected = np.interp(time, [0, 1, 2, 4, 5], [20.0, 21.0, 23.0, 22.0, 21.0])
    assert np.allclose(temperature[known], expected[known]) and np.isnan(temperature[(time > 2) & (time < 4)]).all()
    # Another rate of the run files: the channels need half a kernel at the ends, the temperature does not.
    again = wind_map(temperature={"tc": "beam"}, resample=1000)
    again["runs"][0]["run"] = "wind-2"
    run_import(tmp_path, again, tmp_path / "record")
    assert open_run(tmp_path / "runs" / "wind-2.h5").samples == 6000 - 66


def test_the_example_of_the_manual(tmp_path):
    page = (ROOT / "docs" / "import.md").read_text(encoding="utf-8")
    header = re.search(r"```text\n(.*?)^0,000", page, re.DOTALL | re.MULTILINE)[1]
    (tmp_path / "map.yaml").write_text(re.search(r"```yaml\n(.*?)```", page, re.DOTALL)[1], encoding="utf-8")
    time = np.arange(4000) / 1000.0
    tachometer = 5.0 * ((17.37 * time) % 1.0 < 0.1)
    rows = np.column_stack([time, 1.25 + np.sin(time), -0.5 + np.cos(time), tachometer])
    lines = [";".join(f"{value:.6f}".replace(".", ",") for value in row) for row in rows.tolist()]
    (tmp_path / "hover-3.csv").write_text(header + "\n".join(lines), encoding="cp1252")
    sketch = invoke("import", "--sketch", tmp_path / "hover-3.csv")
    assert sketch.exit_code == 0 and "time: Zeit" in sketch.stdout and "channel: Tacho" in sketch.stdout
    done = invoke("import", tmp_path / "map.yaml", tmp_path / "hover-3.csv", "-o", tmp_path / "runs")
    assert done.exit_code == 0, done.output
    run = open_run(tmp_path / "runs" / "wind-3.h5")
    assert (run.rig, run.note, run.channel_names) == ("hexapod-2", "hover 3", ("z1.strain", "z2.strain"))
    assert run.rotor_speed == pytest.approx(17.37, rel=1e-3)
    assert np.allclose(run.read().channels[:, 1], 1e-3 * (0.5 - np.cos(time)), atol=1e-9)


def test_a_missing_sample_of_a_channel_is_bridged_and_names_of_yaml_words_are_quoted(tmp_path):
    rows = [f"{k / 100:.2f},{np.sin(0.3 * k):.6f},{np.cos(0.3 * k):.6f}" for k in range(4000)]
    rows[777] = f"7.77,,{np.cos(0.3 * 777):.6f}"
    (tmp_path / "check-1.csv").write_text("t [s],No [V],Fz [N]\n" + "\n".join(rows), encoding="utf-8")
    assert '"No": {name: "No", unit: V}' in invoke("import", "--sketch", tmp_path / "check-1.csv").stdout
    run = {"file": "*.csv", "kind": "sweep", "excited": "Fz", "excitation": "random", "level": 1.0}
    mapping = base_map(time="t", channels={"No": "z1"}, loads={"Fz": "Fz"}, runs=[run])
    run_import(tmp_path, mapping, tmp_path / "check-1.csv")
    assert abs(open_run(tmp_path / "runs" / "check-1.h5").read().channels[777, 0] - np.sin(0.3 * 777)) < 1e-3


def test_series_and_kinds_of_points_are_read(tmp_path):
    rows = [("A", "Null", 0.0), ("A", "Last", 10.0), ("A", "Last", 20.0), ("B", "Null", 0.0), ("B", "check", -10.0)]
    lines = [f"{series};{kind};{0.1 * load};{load}".replace(".", ",") for series, kind, load in rows]
    (tmp_path / "cal.csv").write_text("Reihe;Typ;z1 [mV];Fz [N]\n" + "\n".join(lines) + "\n", encoding="utf-8")
    mapping = base_map(
        channels={"z1": "z1"},
        loads={"Fz": "Fz"},
        series="Reihe",
        point_kind={"channel": "Typ", "words": {"Null": "tare", "Last": "load"}},
        runs=[{"file": "*.csv", "kind": "static", "trim": "bare"}],
    )
    run_import(tmp_path, mapping, tmp_path / "cal.csv")
    run = open_run(tmp_path / "runs" / "cal.h5")
    assert run.series_labels == ("A", "A", "A", "B", "B")
    assert run.point_kinds == ("tare", "load", "load", "tare", "check")
    refused = run_import(tmp_path / "..", mapping | {"series": "Reine"}, tmp_path / "cal.csv", status=2)
    assert "Did you mean `Reihe`?" in refused.stderr


def test_a_bridge_is_read_as_a_ratio_to_its_measured_supply(tmp_path):
    time = np.arange(500) / 100.0
    supply, bridge = 9.8 + 0.1 * np.sin(time), 2e-3 * np.sin(7 * time)
    supply[200] = 0.0
    np.savetxt(
        tmp_path / "wind.csv",
        np.column_stack([time, 1e3 * bridge * supply, supply]),
        "%.12g",
        ",",
        header="t [s],z1 [mV],U [V]",
        comments="",
    )
    channel = {"name": "z1", "excitation": {"channel": "U", "nominal": 10.0}}
    mapping = base_map(time="t", channels={"z1": channel}, runs=[{"file": "*.csv", "kind": "zero"}])
    result = run_import(tmp_path, mapping, tmp_path / "wind.csv")
    assert "divided by the supply `U`, times 10 V" in result.output and "no value in 1 of 500" in result.output
    read = open_run(tmp_path / "runs" / "wind.h5").read().channels[:, 0]
    keep = np.arange(500) != 200
    assert np.allclose(read[keep], 10.0 * bridge[keep], rtol=1e-9, atol=1e-12)


def test_files_of_one_run_have_each_their_own_time(tmp_path):
    for name, rate in (("a", 1000.0), ("b", 500.0)):
        time = np.arange(3000) / rate
        table = np.column_stack([time, np.sin(20 * time)])
        np.savetxt(tmp_path / f"rec-{name}.csv", table, "%.9g", ",", header=f"t [s],{name} [V]", comments="")
    run = {"file": "rec-*.csv", "run": "rec", "kind": "zero"}
    mapping = base_map(time="t", channels={"a": "a", "b": "b"}, runs=[run])
    run_import(tmp_path, mapping, tmp_path / "rec-a.csv", tmp_path / "rec-b.csv")
    read = open_run(tmp_path / "runs" / "rec.h5")
    assert read.sample_rate == 500.0 and np.allclose(*read.read().channels.T, atol=1e-4)


def test_channels_of_the_same_name_are_told_by_their_files(tmp_path):
    """Force and response of a hammer test, each a file of two columns without a head."""
    time = np.arange(400) / 1000.0
    for name, values in (("force-1.txt", np.exp(-((time - 0.1) ** 2) * 1e5)), ("accel-1.txt", np.cos(50 * time))):
        np.savetxt(tmp_path / name, np.c_[time, values], delimiter="\t", fmt="%.9g")
    files = tmp_path / "force-1.txt", tmp_path / "accel-1.txt"
    runs = [{"file": "*-{number}.txt", "run": "tap-{number}", "kind": "sweep", "excited": "Fz", "excitation": "impact"}]
    keys = {"time": "column 1", "loads": {"force-*/column 2": {"component": "Fz", "unit": "N"}}, "runs": runs}
    run_import(tmp_path, base_map(channels={"accel-*/column 2": {"name": "a", "unit": "V"}}, **keys), *files)
    block = open_run(tmp_path / "runs" / "tap-1.h5").read()
    assert np.allclose(block.channels[:, 0], np.cos(50 * time))
    assert np.argmax(block.loads[:, 2]) == 100


def test_two_channels_of_one_name_are_refused_with_the_names_that_tell_them_apart(tmp_path):
    for name in ("force-1.txt", "accel-1.txt"):
        np.savetxt(tmp_path / name, np.c_[np.arange(40) / 1000.0, np.ones(40)], delimiter="\t", fmt="%.9g")
    runs = [{"file": "*-1.txt", "run": "tap", "kind": "zero"}]
    mapping = base_map(time="column 1", channels={"column 2": {"name": "a", "unit": "V"}}, runs=runs)
    result = run_import(tmp_path, mapping, tmp_path / "force-1.txt", tmp_path / "accel-1.txt", status=2)
    assert "accel-1.txt/column 2" in result.stderr


def write_pieces(folder, starts, name="rec-{}.csv"):
    """Pieces of 700 samples of one record, with times that begin at `starts` [s]; their files and the record (n, 2)."""
    record = np.random.default_rng(3).normal(size=(700 * len(starts), 2))
    files = [folder / name.format(k) for k in range(len(starts))]
    for file, start, rows in zip(files, starts, np.split(record, len(starts)), strict=True):
        table = np.c_[start + np.arange(700) / 1000.0, rows]
        np.savetxt(file, table, "%.9g", ",", header="t [s],a [V],b [V]", comments="")
    return files, record


def test_pieces_that_continue_each_other_are_one_record(tmp_path):
    """In the order of their times: `rec-10` stands before `rec-2` in a folder."""
    (first, second, third), record = write_pieces(tmp_path, (0.0, 0.7, 1.4))
    run = {"file": "rec-*.csv", "run": "rec", "kind": "zero"}
    mapping = base_map(time="t", channels={"a": "a", "b": "b"}, runs=[run])
    result = run_import(tmp_path, mapping, third, first, second)
    read = open_run(tmp_path / "runs" / "rec.h5")
    assert read.sample_rate == 1000.0 and np.allclose(read.read().channels, record, atol=1e-8)
    assert "continue each other, and are one record: rec-0.csv, rec-1.csv, rec-2.csv" in result.output


@pytest.mark.parametrize("second", [0.0, 0.702, 0.699, 60.0])
def test_pieces_with_a_gap_or_a_clock_of_their_own_are_refused(tmp_path, second):
    files, _ = write_pieces(tmp_path, (0.0, second))
    run = {"file": "rec-*.csv", "run": "rec", "kind": "zero"}
    result = run_import(tmp_path, base_map(time="t", channels={"a": "a"}, runs=[run]), *files, status=2)
    assert "of pieces of one record the times must go on from file to file" in result.stderr


@pytest.mark.parametrize(("late", "status"), [(0.0, 0), (1.234, 2), (0.0003, 2)])
def test_two_boxes_with_clocks_of_their_own_are_told_by_their_tachometers(tmp_path, late, status):
    """Each box counts from its own start: the channels of one were half a revolution off, without a word."""
    rotor, pulse = RotorKinematics(15.0, drift=0.01), np.arange(6000) / 1000.0
    for name, start in (("a", 0.0), ("b", late)):
        azimuth = rotor.azimuth(pulse + start)
        tachometer = 5.0 * np.clip(30.0 * (0.1 - np.abs((azimuth / (2 * np.pi) + 0.5) % 1.0 - 0.5)), 0.0, 1.0)
        table = np.c_[pulse, np.cos(azimuth), tachometer]
        np.savetxt(tmp_path / f"{name}-1.csv", table, "%.9g", ",", header=f"t [s],{name} [V],tacho [V]", comments="")
    run = {"file": "?-1.csv", "run": "wind-1", "kind": "wind"}
    mapping = base_map(time="t", channels={"a": "a", "b": "b"}, rotor={"channel": "tacho"}, runs=[run])
    result = run_import(tmp_path, mapping, tmp_path / "a-1.csv", tmp_path / "b-1.csv", status=status)
    if status:
        assert "the clocks of these files differ" in result.stderr


def test_a_sketch_takes_no_time_or_channel_of_a_structure_for_its_load(tmp_path):
    time = np.arange(200) / 100.0
    record = {"t": time, "y": np.random.default_rng(1).normal(size=(200, 2)), "F": np.cos(time)}
    scipy.io.savemat(tmp_path / "sweeps.mat", {"sweep_Fx": record, "sweep_Fz": record})
    sketch = yaml.safe_load(invoke("import", "--sketch", tmp_path / "sweeps.mat").stdout)
    assert {name: load["component"] for name, load in sketch["loads"].items()} == {
        "sweep_Fx.F": "Fx",
        "sweep_Fz.F": "Fz",
    }


def test_a_spectrum_with_a_column_called_time_is_refused(tmp_path):
    """LabVIEW writes spectra like records: `X_Dimension Time`, `Delta_X`."""
    head = "LabVIEW Measurement\t\nX_Columns\tMulti\n***End_of_Header***\t\n\t\nChannels\t1\t\nX_Dimension\tTime\t\n"
    head += "X0\t0.0\t\nDelta_X\t0.128\t\n***End_of_Header***\t\t\nX_Value\tAcceleration (FFT - (RMS))\tComment\n"
    rows = "".join(f"{0.128 * k:.6f}\t{-60 + 5 * np.cos(k):.6f}\n" for k in range(60))
    (tmp_path / "tap.lvm").write_text(head + rows)
    channels = {"Acceleration": {"name": "a", "unit": "m/s2", "scale": 1}}
    result = run_import(
        tmp_path,
        base_map(channels=channels, runs=[{"file": "*", "run": "tap", "kind": "zero"}]),
        tmp_path / "tap.lvm",
        status=2,
    )
    assert "seems to be a spectrum" in result.stderr


@pytest.mark.parametrize(
    ("head", "lines"),
    [
        ("Azimuth [deg]", ["rotor:", "  channel: Azimuth", "  kind: counts", "  counts_per_revolution: 360"]),
        ("psi [rad]", ["rotor:", "  channel: psi", "  kind: counts", "  counts_per_revolution: 6.28318530717959"]),
        ("azimuth", ["rotor:", "  channel: azimuth", "  kind: counts", "  counts_per_revolution: 360  # TODO: check"]),
        ("Tacho [V]", ["rotor:", "  channel: Tacho", "  pulses_per_revolution: 1"]),
        ("Rotor speed [rpm]", ["# rotor:", "#   channel: TACHOMETER", "#   pulses_per_revolution: 1"]),
    ],
)
def test_a_sketch_tells_angles_and_speeds_from_pulses(tmp_path, head, lines):
    rows = "".join(f"{k / 100:.2f},{k % 7},{3.6 * (17 * k % 100):.1f}\n" for k in range(100))
    (tmp_path / "wind-1.csv").write_text(f"Time [s],x.strain [V],{head}\n{rows}", encoding="utf-8")
    sketch = invoke("import", "--sketch", tmp_path / "wind-1.csv").stdout
    assert "\n".join(lines) in sketch


def write_csv(path, columns, rate=None):
    """A text file of columns {name: (unit, values)}, with times at a `rate`."""
    if rate is not None:
        columns = {"t": ("s", np.arange(len(next(iter(columns.values()))[1])) / rate), **columns}
    lines = [",".join(columns), ",".join(unit for unit, _ in columns.values())]
    lines += [",".join(map(repr, row)) for row in np.transpose([values for _, values in columns.values()]).tolist()]
    path.write_text("\n".join(lines), encoding="utf-8")


def write_unlike_files(folder, samples=400):
    """A wind run with two boxes, statics in kgf with one of them, and sweeps with a load column of their own each."""
    rng = np.random.default_rng(1)
    strain, piezo = [{name: ("V", rng.normal(size=samples))} for name in ("s1", "p1")]
    write_csv(folder / "wind-1.csv", {**strain, **piezo, "Fx": ("N", 0 * strain["s1"][1])}, 100.0)
    write_csv(folder / "static-1.csv", {**strain, "Fx": ("kgf", np.arange(samples) % 7.0)})
    for name in ("Fx", "Fy"):
        write_csv(folder / f"sweep-{name}.csv", {**strain, **piezo, "cell": ("N", rng.normal(size=samples))}, 100.0)
    return [folder / f"{name}.csv" for name in ("wind-1", "static-1", "sweep-Fx", "sweep-Fy")]


def test_channels_and_loads_of_some_runs(tmp_path):
    """An exciter that was moved, a box that statics lack and another unit of their loads are one map."""
    files = write_unlike_files(tmp_path)
    sweep = {"kind": "sweep", "excitation": "random"}
    runs = [
        {"file": "wind-*", "kind": "wind", "rotor_speed": 0.0, "loads": {"Fx": None}},
        {"file": "static-*", "kind": "static", "trim": "bare", "channels": {"p1": None}},
        *({"file": f"sweep-{c}*", "excited": c, "loads": {"Fx": None, "cell": c}, **sweep} for c in ("Fx", "Fy")),
    ]
    mapping = base_map(channels={"s1": "x.strain", "p1": "x.piezo"}, loads={"Fx": "Fx"}, time="t", runs=runs)
    run_import(tmp_path, mapping, *files)
    static, moved = (open_run(tmp_path / "runs" / f"{name}.h5") for name in ("static-1", "sweep-Fy"))
    assert static.channel_names == ("x.strain",) and moved.channel_names == ("x.strain", "x.piezo")
    assert np.allclose(static.read().loads[:, 0], 9.80665 * (np.arange(400) % 7.0))
    assert not moved.read().loads[:, 0].any() and moved.read().loads[:, 1].std() == pytest.approx(1.0, rel=0.1)


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"channels": {"p1": "x.strain"}}, "are the channel `x.strain`"),
        ({"loads": {"cell": "Fx"}}, "are the component `Fx`"),
        ({"channels": {"p1": None, "s1": None}}, "no entries"),
        ({}, "`p1: null` in the entry of `runs` leaves it out"),
    ],
)
def test_bad_entries_of_some_runs(tmp_path, entry, words):
    files = write_unlike_files(tmp_path)
    runs = [{"file": "*", "kind": "static", "trim": "bare", **entry}]
    mapping = base_map(channels={"s1": "x.strain", "p1": "x.piezo"}, loads={"Fx": "Fx"}, runs=runs)
    assert words in run_import(tmp_path, mapping, files[1], status=2).stderr


def test_loads_that_a_sweep_did_not_record_are_zero_unless_they_were_excited(tmp_path):
    """Of several exciters the record of a sweep has the one that ran."""
    files = write_unlike_files(tmp_path)
    loads = {"cell": "Fx", "cell 2": "Fy"}
    runs = [{"file": "sweep-{c}.csv", "kind": "sweep", "excited": "{c}", "excitation": "random"}]
    mapping = base_map(channels={"s1": "x.strain"}, loads=loads, time="t", runs=runs)
    assert "declared to be zero: cell 2" in run_import(tmp_path, mapping, files[2]).output
    (tmp_path / "runs" / "sweep-Fx.h5").rename(tmp_path / "sweep-Fx.h5")
    (tmp_path / "runs").rmdir()
    assert "has no channel `cell 2`" in run_import(tmp_path, mapping, files[3], status=2).stderr


def test_a_sketch_of_files_that_differ_is_a_map_of_all(tmp_path):
    """The map is that of the file with most channels; what others lack or have in other units is in their entries."""
    files = write_unlike_files(tmp_path)[:2]
    text = invoke("import", "--sketch", *files).stdout
    text = text.replace("rig: TODO", "rig: RTS-6").replace("trim: TODO", "trim: bare")
    assert "p1: null" in text and "unit: kgf" in text
    (tmp_path / "map.yaml").write_text(text.replace("kind: wind", "kind: zero"), encoding="utf-8")
    done = invoke("import", tmp_path / "map.yaml", *files, "-o", tmp_path / "runs")
    assert done.exit_code == 0, done.output
    assert open_run(tmp_path / "runs" / "static-1.h5").read().loads[1, 0] == pytest.approx(9.80665)


def test_a_sketch_has_the_channels_that_a_file_alone_has(tmp_path):
    """Only those of the file with most channels were in the map: bridges of sweeps and the tachometer were missing."""
    geometry = tmp_path / "geometry.yaml"
    declared = "channels: [{name: k1, unit: mV/V}, {name: k2, unit: mV/V}]\ncomponents: [Fx, Fz]\n"
    geometry.write_text("format: balance-geometry/1\nname: n\nrig: r\n" + declared, encoding="utf-8")
    rows = "".join(f"{k * k},0,{0.1 * k},{0.2 * k}\n" for k in range(5))
    (tmp_path / "Static 1.csv").write_text("Fx [N],Fz [N],SG k1 [mV/V],SG k2 [mV/V]\n" + rows, encoding="utf-8")
    scipy.io.savemat(tmp_path / "sweep Fz.mat", {"k1": np.arange(50.0), "k2": np.arange(50.0), "fs": 100.0})
    for name, tachometer in (("Run 1", True), ("Run 2", True), ("Wind Off", False)):
        write_two_groups(tmp_path / f"{name}.tdms", tachometer)
    names = ("Static 1.csv", "sweep Fz.mat", "Run 1.tdms", "Run 2.tdms", "Wind Off.tdms")
    text = invoke("import", "--sketch", "-g", geometry, *(tmp_path / name for name in names)).stdout
    sketch = yaml.safe_load(text)
    assert sketch["channels"]["SG k1"] == {"name": "k1", "unit": "mV/V"}  # the geometry declares a ratio: no scale
    assert sketch["rotor"]["channel"] == "Tach/OPR"
    runs = {run["file"]: run for run in sketch["runs"]}
    assert runs["sweep Fz.mat"]["channels"]["k1"]["name"] == "k1"
    assert runs["Wind Off.tdms"]["kind"] == "zero"
    assert all("channels" not in runs[name] for name in names[2:])
    alone = yaml.safe_load(invoke("import", "--sketch", "-g", geometry, tmp_path / "Run 1.tdms").stdout)
    assert alone["channels"]["Balance/SG k2"]["name"] == "k2"


def write_two_groups(path, tachometer):
    nptdms = pytest.importorskip("nptdms")
    volts = {"wf_increment": 0.01, "unit_string": "V"}
    ratio = {"wf_increment": 0.01, "unit_string": "mV/V"}
    channels = [nptdms.ChannelObject("Balance", f"SG k{k}", np.arange(50.0), properties=ratio) for k in (1, 2)]
    channels += [nptdms.ChannelObject("Tach", "OPR", np.arange(50.0), properties=volts)] if tachometer else []
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment(channels)


def test_channels_of_files_with_and_without_a_second_group(tmp_path):
    """LabVIEW: a tachometer in a group of its own gives all channels of its file the names of their groups."""
    nptdms = pytest.importorskip("nptdms")
    rotor = RotorKinematics(17.5, drift=0.0)
    time, fast = np.arange(4000) / 1000.0, np.arange(40_000) / 10_000.0
    pulses = 5.0 * ((rotor.azimuth(fast) / (2 * np.pi)) % 1.0 < 0.1)
    for name, tachometer in (("zero", ()), ("wind", (("speed", "tacho", pulses, 1e-4),))):
        channels = [
            nptdms.ChannelObject(group, channel, values, properties={"wf_increment": step, "unit_string": "V"})
            for group, channel, values, step in (("record", "a", np.cos(rotor.azimuth(time)), 1e-3), *tachometer)
        ]
        with nptdms.TdmsWriter(tmp_path / f"{name}-1.tdms") as writer:
            writer.write_segment(channels)
    files = [tmp_path / "zero-1.tdms", tmp_path / "wind-1.tdms"]
    sketch = invoke("import", "--sketch", *files).stdout.replace("rig: TODO", "rig: RTS-6")
    assert "null" not in sketch and "  a: {" in sketch
    run_import(tmp_path, yaml.safe_load(sketch), *files)
    runs = {name: open_run(tmp_path / "runs" / f"{name}-1.h5") for name in ("zero", "wind")}
    assert runs["zero"].channel_names == runs["wind"].channel_names == ("a",)
    assert runs["wind"].rotor_speed == pytest.approx(17.5, rel=1e-3)


def test_a_speed_is_no_tachometer(tmp_path):
    write_wind_hdf5(tmp_path / "record", duration=1.0)
    with h5py.File(tmp_path / "record", "r+") as file:
        file["tacho"].attrs["unit"] = "rpm"
        file["tacho"][:] = 1050.0 + np.random.default_rng(1).normal(size=len(file["tacho"]))
    result = run_import(tmp_path, wind_map(), tmp_path / "record", status=2)
    assert "is in rpm: a speed, which tells no azimuth" in result.stderr and "rotor_speed: 0" in result.stderr


def test_an_encoder_with_few_samples_for_each_pulse_needs_a_speed(tmp_path):
    rotor = write_wind_hdf5(tmp_path / "record", duration=2.0)
    with h5py.File(tmp_path / "record", "r+") as file:
        time = np.arange(len(file["tacho"])) / 20_000.0
        file["tacho"][:] = 5.0 * ((180 * rotor.azimuth(time) / (2 * np.pi)) % 1.0 < 0.5)
    mapping = wind_map()
    mapping["rotor"]["pulses_per_revolution"] = 180
    result = run_import(tmp_path, mapping, tmp_path / "record", status=2)
    assert "look the same as these" in result.stderr and "state `rotor_speed`" in result.stderr
    mapping["runs"][0]["rotor_speed"] = 17.5
    run_import(tmp_path, mapping, tmp_path / "record")


@pytest.mark.parametrize(("step", "unit", "is_named"), [(1, None, True), (1, "ms", False), (0.001, None, False)])
def test_whole_numbers_as_times_without_a_unit_are_named(tmp_path, step, unit, is_named):
    """Milliseconds were taken as seconds, a thousandth of the rate, without a word."""
    values = np.random.default_rng(1).normal(size=300)
    rows = "".join(f"{step * k:g},{value:.6f}\n" for k, value in enumerate(values))
    (tmp_path / "a.csv").write_text("t,F1 [V]\n" + rows)
    keys = {} if unit is None else {"time_unit": unit}
    runs = [{"file": "*", "kind": "zero", "run": "a"}]
    mapping = base_map(time="t", channels={"F1": {"name": "z1.strain", "unit": "V"}}, runs=runs, **keys)
    result = run_import(tmp_path, mapping, tmp_path / "a.csv")
    assert ("`t` have no unit and were taken as seconds, 1 Hz" in result.stdout) == is_named


def test_a_recorded_time_that_is_none_is_named(tmp_path):
    (tmp_path / "a.csv").write_text("F1 [V]\n" + "".join(f"{np.sin(k):.6f}\n" for k in range(300)))
    runs = [{"file": "*", "kind": "zero", "run": "a", "recorded": "2024-13-05T10:00:00"}]
    mapping = base_map(sample_rate=100.0, channels={"F1": {"name": "z1.strain", "unit": "V"}}, runs=runs)
    result = run_import(tmp_path, mapping, tmp_path / "a.csv")
    assert "`recorded` is `2024-13-05T10:00:00`, which is no time in ISO 8601" in result.stdout
