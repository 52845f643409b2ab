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


def test_file_names_need_not_be_text(examples, tmp_path):
    """A name of bytes that are not UTF-8, with a line break and an escape sequence of terminals."""
    odd = os.fsdecode(b"a\xff\x1b[31m\nb")
    for name in ("wind.run.h5", "points.csv", "loads.h5", "model.h5"):
        try:
            shutil.copy(examples / name, tmp_path / f"{odd}{name}")
        except OSError:
            pytest.skip("a file system of text names")
    run, table, loads, model = (
        tmp_path / f"{odd}{name}" for name in ("wind.run.h5", "points.csv", "loads.h5", "model.h5")
    )
    cal, out = examples / "cal.h5", tmp_path / f"{odd}out"
    calls = (
        ("reduce", "--calibration", cal, "--model", model, run, "-o", f"{out}.h5", "--json", f"{out}.json"),
        ("calibrate", "-g", examples / "geometry.yaml", table, "-o", f"{out}.h5", "--json", "-"),
        ("apply", cal, table, "-o", f"{out}.csv"),
        ("report", loads, model, "-o", f"{out}.html"),
        ("trend", loads, examples / "wind-loads.h5", "-o", f"{out}.csv"),
        ("watch", tmp_path, "--once", "--model", model, "-o", tmp_path / "results"),
    )
    for words in calls:
        done = call(*words)
        assert done.exit_code in (0, 4), done.stderr
        assert "\x1b[31m" not in done.stderr + done.stdout
    done = call("merge", tmp_path / f"{odd}none.h5", "-o", f"{out}.h5")
    assert done.stderr.count("\n") == 1
    assert "a\\xff\\x1b[31m\\nbnone.h5: there is no such file" in done.stderr


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
