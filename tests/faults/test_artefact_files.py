"""Malformed artefacts, and artefacts in the wrong place."""

import json
import shutil

import h5py
import numpy as np
import pytest

from tests.faults.conftest import assert_refused, call

NAMES = ("cal", "tf", "model", "diagnosis", "loads")


def nudge(file):
    found = []
    file["content"].visititems(
        lambda _, item: found.append(item) if isinstance(item, h5py.Dataset) and item.dtype.kind == "f" else None
    )
    item = next(item for item in found if item.shape is not None and np.any(np.abs(item[()]) > 1e-3))
    item[...] = np.asarray(item[()]) * (1 + 1e-9) + 1e-12


def set_attribute(name, value):
    return lambda file: file.attrs.__setitem__(name, value)


def deep_groups(file):
    group = file["content"]
    for _ in range(1500):
        group = group.create_group("g")


CHANGES = {
    "version 2": lambda f: f.attrs.__setitem__("format", str(f.attrs["format"])[:-1] + "2"),
    "last digits": nudge,
    "options": set_attribute("options", '{"method": "ml"}'),
    "no digest": lambda f: f.attrs.__delitem__("digest"),
    "inputs no JSON": set_attribute("inputs", "{"),
    "inputs of another shape": set_attribute("inputs", '[{"a": 1}]'),
    "inputs deep": set_attribute("inputs", "[" * 30000 + "]" * 30000),
    "input names numbers": set_attribute("inputs", json.dumps([{"name": 1, "role": "run", "digest": "x"}])),
    "options a list": set_attribute("options", "[1]"),
    "versions a word": set_attribute("versions", '"x"'),
    "no content": lambda f: f.__delitem__("content"),
    "content a number": lambda f: (f.__delitem__("content"), f.__setitem__("content", 3.0)),
    "content in itself": lambda f: f["content"].__setitem__("again", f["content"]),
    "link to another file": lambda f: f["content"].__setitem__("zz", h5py.ExternalLink("/etc/passwd", "/")),
    "1e12 numbers": lambda f: f["content"].create_dataset("zz", (10**12,), "f8", chunks=(10**6,)),
    "5e8 numbers": lambda f: f["content"].create_dataset("zz", (5 * 10**8,), "f8", chunks=(10**6,)),
    "a dataset missing": lambda f: f["content"].__delitem__(sorted(f["content"])[0]),
    "deep groups": deep_groups,
    "strange key": lambda f: f["content"].__setitem__("%zz%2F", 1.0),
    "compound": lambda f: f["content"].create_dataset("zz", data=np.zeros(3, [("a", "f4")])),
    "reference": lambda f: f["content"].create_dataset("zz", data=f["content"].ref, dtype=h5py.ref_dtype),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
@pytest.mark.parametrize("name", NAMES)
def test_a_malformed_artefact_is_refused(examples, tmp_path, out, name, change):
    path = tmp_path / "bad.h5"
    shutil.copy(examples / f"{name}.h5", path)
    with h5py.File(path, "r+") as file:
        change(file)
    assert_refused(call("report", path, "-o", out / "r.html"), out, "bad.h5")


@pytest.mark.parametrize("attribute", ["created", "command"])
def test_text_that_is_not_utf8_reaches_the_page(examples, tmp_path, out, attribute):
    path = tmp_path / "a.h5"
    shutil.copy(examples / "loads.h5", path)
    with h5py.File(path, "r+") as file:
        file.attrs.create(attribute, b"caf\xe9", dtype=h5py.string_dtype())
    assert call("report", path, "-o", out / "r.html").exit_code == 0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("size", [0, 8, 3000, -1])
def test_a_truncated_artefact_is_refused(examples, tmp_path, out, name, size):
    path = tmp_path / "bad.h5"
    path.write_bytes((examples / f"{name}.h5").read_bytes()[:size])
    assert_refused(call("check", path), out, "bad.h5")


@pytest.mark.parametrize(
    ("calibration", "option", "response", "run", "named"),
    [
        ("model.h5", "--model", "model.h5", "check.run.h5", "model.h5"),
        ("cal.h5", "--model", "cal.h5", "check.run.h5", "cal.h5"),
        ("cal.h5", "--transfer", "loads.h5", "check.run.h5", "loads.h5"),
        ("cal.h5", "--model", "wind.run.h5", "check.run.h5", "wind.run.h5"),
        ("geometry.yaml", "--model", "model.h5", "check.run.h5", "geometry.yaml"),
        ("cal.h5", "--model", "model.h5", "model.h5", "model.h5"),
        ("cal.h5", "--model", "model.h5", "points.csv", "points.csv"),
        ("cal.h5", "--model", "model.h5", "none.h5", "none.h5"),
    ],
)
def test_a_file_in_the_wrong_place_is_named(examples, out, calibration, option, response, run, named):
    words = ["reduce", "--calibration", examples / calibration, option, examples / response, examples / run]
    assert_refused(call(*words, "-o", out / "o.csv"), out, named)


@pytest.mark.parametrize("name", ["check.run.h5", "geometry.yaml", "matrix.csv", "history.h5", "none.h5", ""])
def test_only_artefacts_are_reported(examples, out, name):
    assert_refused(call("report", examples / name, "-o", out / "r.html"), out)
