"""Calls that cannot be meant: outputs over inputs, places that cannot be written or read, names that mislead."""

import csv
import os
import shutil

import h5py
import pytest
import yaml

from studies.mutation.readers import GEOMETRY
from tests.faults.conftest import assert_refused, call

pytestmark = pytest.mark.skipif(os.name != "posix", reason="files of POSIX")


def copy_run(examples, path, name):
    shutil.copy(examples / "check.run.h5", path)
    with h5py.File(path, "r+") as file:
        file.attrs["run"] = name
    return path


@pytest.mark.parametrize("name", ["../x", "/tmp/x", "n" * 300, "a/b"])
def test_a_history_stays_in_its_folder(examples, tmp_path, out, name):
    run = copy_run(examples, tmp_path / "bad.h5", name)
    done = call("reduce", *examples.response, run, "-o", out / "o.csv", "--history", out)
    assert_refused(done, out, "bad.h5")


def test_an_output_over_an_input_is_refused(examples, tmp_path, out):
    run = copy_run(examples, tmp_path / "check.h5", "check")
    before = run.read_bytes()
    for output in (run, tmp_path / "out" / ".." / "check.h5"):
        assert_refused(call("reduce", *examples.response, run, "-o", output), out)
    assert_refused(call("reduce", *examples.response, run, "-o", out / "o.csv", "--history", tmp_path), out, "check.h5")
    assert run.read_bytes() == before


@pytest.mark.parametrize("words", [["modes", "-g"], ["report"], ["check"]])
def test_what_is_no_ordinary_file_is_not_opened(examples, tmp_path, out, words):
    os.mkfifo(tmp_path / "fifo.h5")
    (tmp_path / "loop.h5").symlink_to(tmp_path / "loop.h5")
    more = ["-o", out / "r.html"] if words == ["report"] else []
    for name in ("fifo.h5", "loop.h5", "none.h5", "out"):
        assert_refused(call(*words, tmp_path / name, *more), out, name)


def renamed_campaign(examples, folder, suffix):
    geometry = yaml.safe_load(yaml.safe_dump(GEOMETRY))
    for item in (*geometry["cells"], *geometry["channels"]):
        item["name"] += suffix
    for channel in geometry["channels"]:
        channel["cell"] += suffix
    geometry["effects"][0]["where"] = [geometry["channels"][2]["name"]]
    (folder / "g.yaml").write_text(yaml.safe_dump(geometry, allow_unicode=True), encoding="utf-8")
    for name in ("static", "check"):
        path = folder / f"{name}.h5"
        shutil.copy(examples / f"{name}.run.h5", path)
        with h5py.File(path, "r+") as file:
            file.attrs["run"] = str(file.attrs["run"]) + suffix
            names = [f"{channel}{suffix}" for channel in file["channels"].attrs["names"]]
            file["channels"].attrs.create("names", names, dtype=h5py.string_dtype())
    return ["-g", folder / "g.yaml"]


@pytest.mark.filterwarnings("ignore:Glyph")  # the font of the pictures has no Japanese
@pytest.mark.parametrize("suffix", ["<script>alert(1)</script>\"'", "$\\foo{$_", "\n\x1b[31mX", "日本", "=cmd|1!A1"])
def test_names_reach_page_matrix_and_table_as_text(examples, tmp_path, suffix):
    g = renamed_campaign(examples, tmp_path, suffix)
    cal, page = tmp_path / "cal.h5", tmp_path / "r.html"
    assert call("calibrate", *g, tmp_path / "static.h5", "-o", cal, "--matrix", tmp_path / "m.csv").exit_code == 0
    table = tmp_path / "l.h5"
    assert call("reduce", "--calibration", cal, "--static", tmp_path / "check.h5", "-o", table).exit_code == 0
    assert call("report", cal, table, "-o", page).exit_code == 0
    assert "<script>alert" not in page.read_text(encoding="utf-8")
    done = call("calibrate", *g, "--from-matrix", tmp_path / "m.csv", "-o", tmp_path / "again.h5")
    assert done.exit_code == 0, done.stderr


@pytest.mark.parametrize(("name", "cell"), [("=1+1", "'=1+1"), ("@x", "'@x"), ("+1|x", "'+1|x"), ("-5deg", "-5deg")])
def test_a_run_name_is_no_formula(examples, tmp_path, name, cell):
    run = copy_run(examples, tmp_path / "r.h5", name)
    table = tmp_path / "o.csv"
    assert call("reduce", *examples.response, run, "-o", table).exit_code == 0
    with table.open(newline="", encoding="utf-8") as file:
        assert {row["run"] for row in csv.DictReader(file)} == {cell}


def test_the_error_of_a_run_names_its_file(examples, tmp_path, out):
    path = tmp_path / "one-cell.h5"
    shutil.copy(examples / "check.run.h5", path)
    with h5py.File(path, "r+") as file:
        samples = file["channels"][()][:, :1]
        del file["channels"]
        dataset = file.create_dataset("channels", data=samples)
        dataset.attrs["names"], dataset.attrs["unit"] = ["z1.strain"], "V"
    assert_refused(call(*examples.words("reduce", path, out)), out, "one-cell.h5", "channels")
