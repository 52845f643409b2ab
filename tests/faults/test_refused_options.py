"""Options that cannot be meant, inputs that an output would replace, files of another kind: what the message says."""

import shutil

import h5py
import pytest

from tests.faults.conftest import assert_refused, call

TABLE_OF_ZEROS = "point,Fz [N],My [N m],z1.strain [V],z2.strain [V],z1.piezo [V]\nload,0,0,0.001,0.002,0\n"


@pytest.fixture
def own(examples, tmp_path):
    """Inputs that an output might replace."""
    folder = tmp_path / "own"
    folder.mkdir()
    shutil.copy(examples / "cal.h5", folder / "cal.h5")
    (folder / "terms.csv").write_text("Fz^2\n")
    (folder / "zero.csv").write_text(TABLE_OF_ZEROS)
    return folder


@pytest.mark.parametrize(
    ("words", "output"),
    [
        (["apply", "{e}/cal.h5", "{e}/points.csv", "--zero", "{o}/zero.csv", "-o", "{o}/zero.csv"], "zero.csv"),
        (["calibrate", "{g}", "{e}/static.run.h5", "--terms", "{o}/cal.h5", "-o", "{o}/cal.h5"], "cal.h5"),
        (
            [
                "calibrate",
                "{g}",
                "{e}/static.run.h5",
                "--terms={o}/terms.csv",
                "--matrix={o}/terms.csv",
                "-o",
                "{o}/n.h5",
            ],
            "terms.csv",
        ),
    ],
)
def test_no_output_replaces_an_input(examples, own, out, words, output):
    before = {path: path.read_bytes() for path in own.iterdir()}
    g = f"-g{examples / 'geometry.yaml'}"
    done = call(*(word.format(e=examples.folder, o=own, g=g) for word in words))
    assert_refused(done, out, output, "is also an input")
    assert {path: path.read_bytes() for path in own.iterdir()} == before


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["identify", "{g}", "{e}/sweep.run.h5", "--method", "computed", "-o", "-"], "name of a file"),
        (["import", "{e}/csv.map.yaml", "{e}/csv.csv", "-o", "-"], "name of a folder"),
        (["import", "--sketch", "{e}/csv.csv", "-o", "{out}/runs"], "--sketch"),
        (["import", "{e}/csv.map.yaml", "{e}/csv.csv", "{g}", "-o", "{out}/runs"], "--sketch"),
        (["plan", "{g}", "--minutes", "9", "--hall", "{e}/geometry.yaml", "-o", "{out}/p"], "balance-geometry/1"),
        (["plan", "{g}", "--points", "20", "--hall", "{out}/../hall.yaml", "-o", "{out}/p"], "does not measure Fx"),
        (["plan", "{g}", "--points", "5000", "--hall", "{out}/../fz.yaml", "-o", "{out}/p"], "Give fewer points"),
        (["reduce", "{m}", "--interpolation", "spline", "{e}/wind.run.h5", "-o", "{out}/o.csv"], "--interpolation"),
        (["reduce", "{m}", "--frequencies", "1e300", "{s}", "{e}/wind.run.h5", "-o", "{out}/o.csv"], "half the sample"),
        (["reduce", "{m}", "--frequencies", "1e-9", "{s}", "{e}/wind.run.h5", "-o", "{out}/o.csv"], "holds 0 cycles"),
        (["trend", "{e}/wind-loads.h5", "{m}", "--records", "{out}/none"], "is not a folder"),
        (["run", "{e}", "{g}", "--model", "{out}/../other.h5", "-o", "{out}/r"], "is of rig `B9`"),
        (["watch", "{e}", "{m}", "--zero", "{out}/none.h5", "--once", "-o", "{out}/r"], "--calibration"),
    ],
)
def test_an_option_that_cannot_be_meant_is_refused(examples, tmp_path, out, other_model, words, expected):
    (tmp_path / "hall.yaml").write_text("format: balance-hall/1\nstatic_loads: {Fx: 100}\n")
    (tmp_path / "fz.yaml").write_text("format: balance-hall/1\nstatic_loads: {Fz: 100}\n")
    shutil.copy(other_model, tmp_path / "other.h5")
    g, m = f"-g{examples / 'geometry.yaml'}", f"--model={examples / 'model.h5'}"
    names = {"e": examples.folder, "out": out, "g": g, "m": m, "s": "--method=smoother"}
    assert_refused(call(*(word.format(**names) for word in words)), out, expected)


@pytest.fixture(scope="module")
def other_model(examples, tmp_path_factory):
    """A model of a rig of another name, with the same cells."""
    folder = tmp_path_factory.mktemp("other")
    text = (examples / "geometry.yaml").read_text(encoding="utf-8")
    (folder / "g.yaml").write_text(text.replace("rig: BENCH-2", "rig: B9"), encoding="utf-8")
    run = folder / "s.h5"
    shutil.copy(examples / "sweep.run.h5", run)
    with h5py.File(run, "r+") as file:
        file.attrs["rig"] = "B9"
    done = call("identify", "-g", folder / "g.yaml", run, "--method", "computed", "-o", folder / "m.h5")
    assert done.exit_code == 0, done.output
    return folder / "m.h5"


def test_the_reason_why_a_record_is_of_no_use_is_told(examples, tmp_path, out, other_model):
    folder = tmp_path / "records"
    folder.mkdir()
    shutil.copy(examples / "wind.run.h5", folder)
    done = call("trend", examples / "wind-loads.h5", "--model", other_model, "--records", folder)
    assert_refused(done, out, "First reason", "is of rig `BENCH-2`")


def test_a_unit_that_does_not_fit_is_named_with_file_and_channel(examples, tmp_path, out):
    text = (examples / "csv.map.yaml").read_text(encoding="utf-8")
    (tmp_path / "m.yaml").write_text(text.replace("time: time", "time: z1.strain"), encoding="utf-8")
    done = call("import", tmp_path / "m.yaml", examples / "csv.csv", "-o", out / "runs")
    assert_refused(done, out, "csv.csv", "time `z1.strain`", "unit of V")
