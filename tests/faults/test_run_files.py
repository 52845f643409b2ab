"""Malformed run files: damaged, of other types and shapes, declared and not stored, beyond sense."""

import shutil

import h5py
import numpy as np
import pytest

from tests.faults.conftest import assert_refused, call

NAN, INF = float("nan"), float("inf")
OWN = {"static": "calibrate", "sweep": "sweep-tf", "check": "reduce", "wind": "reduce"}


def attribute(name, value=None):
    def change(file):
        if value is None:
            del file.attrs[name]
        else:
            file.attrs[name] = value

    return change


def declare(name, shape, **options):
    """A dataset of this shape of which nothing is stored, with the attributes of the one that it replaces."""

    def change(file):
        attributes = dict(file[name].attrs) if name in file else {}
        if name in file:
            del file[name]
        dataset = file.create_dataset(name, shape, options.pop("dtype", "f4"), **options)
        copy_attributes(dataset, attributes)

    return change


def copy_attributes(dataset, attributes):
    for key, value in attributes.items():
        text = isinstance(value, np.ndarray) and value.dtype == object
        dataset.attrs.create(key, value, dtype=h5py.string_dtype() if text else None)


def data(name, make):
    def change(file):
        attributes, values = dict(file[name].attrs), file[name][()]
        del file[name]
        copy_attributes(file.create_dataset(name, data=make(values)), attributes)

    return change


def link(name, target):
    def change(file):
        if name in file:
            del file[name]
        file[name] = target

    return change


def bomb(file):
    """Twelve million rows of zeros in a megabyte: one compressed chunk, referred to a hundred times."""
    rows, chunk = 12_000_000, 100_000
    for name, kind in (("channels", "f8"), ("loads", "f4")):
        columns = file[name].shape[1]
        declare(name, (rows, columns), dtype=kind, chunks=(chunk, columns), compression="gzip")(file)
        file[name][:chunk] = np.zeros((chunk, columns))
        raw = file[name].id.read_direct_chunk((0, 0))[1]
        for start in range(chunk, rows, chunk):
            file[name].id.write_direct_chunk((start, 0), raw)


CHECK = {
    "no format": (attribute("format"), "format"),
    "format 2": (attribute("format", "balance-run/2"), "balance-run/2"),
    "format of a model": (attribute("format", "balance-model/1"), "balance-model/1"),
    "no kind": (attribute("kind"), "kind"),
    "kind 3": (attribute("kind", 3), "kind"),
    "no run": (attribute("run"), "attribute run"),
    "run blank": (attribute("run", "  "), "attribute run"),
    "rig of another": (attribute("rig", "B9"), "B9", ("reduce", "check -g")),
    "rate 0": (attribute("sample_rate", 0.0), "sample_rate"),
    "rate NaN": (attribute("sample_rate", NAN), "sample_rate"),
    "rate as text": (attribute("sample_rate", "800"), "sample_rate"),
    "rate of two": (attribute("sample_rate", [800.0, 800.0]), "sample_rate"),
    "rate complex": (attribute("sample_rate", 800j), "sample_rate"),
    "rate empty": (attribute("sample_rate", h5py.Empty("f8")), "sample_rate"),
    "rate 1e-300": (attribute("sample_rate", 1e-300), "sample_rate"),
    "rate 1e300": (attribute("sample_rate", 1e300), "sample_rate"),
    "speed negative": (attribute("rotor_speed", -1.0), "rotor_speed"),
    "speed twice that of the pulses": (attribute("rotor_speed", 40.0), ""),
    "no channels": (lambda f: f.__delitem__("channels"), "channels"),
    "channels a group": (lambda f: (f.__delitem__("channels"), f.create_group("channels")), "channels"),
    "channels a type": (lambda f: (f.__delitem__("channels"), f.__setitem__("channels", np.dtype("f8"))), "channels"),
    "link to itself": (link("channels", h5py.SoftLink("/channels")), "channels"),
    "link to nothing": (link("channels", h5py.SoftLink("/none")), "channels"),
    "link to another file": (link("channels", h5py.ExternalLink("/etc/passwd", "/x")), "channels"),
    "one dimension": (data("channels", lambda a: a[:, 0]), "channels"),
    "three dimensions": (data("channels", lambda a: a[None]), "channels"),
    "no rows": (data("channels", lambda a: a[:0]), "channels"),
    "a scalar": (data("channels", lambda a: 3.0), "channels"),
    "text": (data("channels", lambda a: a.astype("S8")), "channels"),
    "complex": (data("channels", lambda a: a.astype("c16")), "channels"),
    "boolean": (data("channels", lambda a: a > 0), "channels"),
    "compound": (data("channels", lambda a: np.zeros(a.shape, [("a", "f4")])), "channels"),
    "all NaN": (data("channels", lambda a: a * NAN), ""),
    "all zero": (data("channels", lambda a: a * 0), ""),
    "no names": (lambda f: f["channels"].attrs.__delitem__("names"), "names"),
    "names twice": (lambda f: f["channels"].attrs.__setitem__("names", ["z1.strain"] * 3), "names"),
    "names of nobody": (lambda f: f["channels"].attrs.__setitem__("names", list("abc")), "", ("reduce", "check -g")),
    "mV": (lambda f: f["channels"].attrs.__setitem__("unit", "mV"), "unit"),
    "no loads": (lambda f: f.__delitem__("loads"), "loads"),
    "loads NaN": (data("loads", lambda a: np.where(np.arange(len(a))[:, None] == 9, NAN, a)), "loads"),
    "loads shorter": (data("loads", lambda a: a[:-5]), "loads"),
    "loads of five": (data("loads", lambda a: a[:, :5]), "loads"),
    "loads in kN": (lambda f: f["loads"].attrs.__setitem__("units", ["kN"] * 3 + ["N m"] * 3), "units"),
    "no pulses": (lambda f: f.__delitem__("rotor/pulse_times"), "pulse"),
    "rotor a dataset": (lambda f: (f.__delitem__("rotor"), f.create_dataset("rotor", data=[1.0])), "pulse"),
    "pulses text": (data("rotor/pulse_times", lambda a: a.astype("S8")), "pulse"),
    "pulse NaN": (data("rotor/pulse_times", lambda a: np.where(np.arange(len(a)) == 7, NAN, a)), "pulse"),
    "pulses decreasing": (data("rotor/pulse_times", lambda a: a[::-1]), "pulse"),
    "one pulse": (data("rotor/pulse_times", lambda a: a[:1]), "pulse"),
    "pulses after the record": (data("rotor/pulse_times", lambda a: a + 100.0), "pulse"),
    "pulses of 5e-302 s": (
        data("rotor/pulse_times", lambda a: a * 1e-300),
        "pulse",
        ("check", "reduce", "reduce in time"),
    ),
    "pulses in ms": (data("rotor/pulse_times", lambda a: a * 1000), "pulse"),
    "every other pulse": (data("rotor/pulse_times", lambda a: a[::2]), "pulse"),
    "two pulses a revolution": (data("rotor/pulse_times", lambda a: np.sort(np.r_[a, a[:-1] + 0.025])), "pulse"),
    "never written": (declare("channels", (3200, 3), chunks=(800, 3)), "channels"),
    "1e12 rows": (declare("channels", (10**12, 3), chunks=(10**6, 3)), "channels"),
    "1e12 rows at once": (declare("channels", (10**12, 3)), "channels"),
    "1e12 pulses": (declare("rotor/pulse_times", (10**12,), chunks=(10**6,)), "pulse"),
    "1e9 pulses": (declare("rotor/pulse_times", (10**9,), chunks=(10**6,)), "pulse"),
    "decompression bomb": (bomb, ""),
}
SWEEP = {
    **{f"no {name}": (attribute(name), name) for name in ("excited", "excitation", "level", "period")},
    "excited unknown": (attribute("excited", "Fq"), "excited"),
    "excited another": (attribute("excited", "Fx"), "Fx"),
    "level 0": (attribute("level", 0.0), "level"),
    "level of two": (attribute("level", [1.0, 2.0]), "level"),
    "period 1e-300": (attribute("period", 1e-300), "period"),
    "period of half a sample": (attribute("period", 0.00125), "period"),
    "load constant": (data("loads", lambda a: a * 0 + 3.0), "", ("sweep-tf",)),
    "load zero though excited": (data("loads", lambda a: a * 0), "loads"),
}
STATIC = {
    "no trim": (attribute("trim"), "trim"),
    "channels all zero": (data("channels", lambda a: a * 0), "channels", ("calibrate",)),
    "loads all zero": (data("loads", lambda a: a * 0), "", ("calibrate",)),
    "loads NaN": (data("loads", lambda a: np.where(np.arange(len(a))[:, None] == 9, NAN, a)), "loads", ("check",)),
    "three rows": (lambda f: [data(name, lambda a: a[:3])(f) for name in ("channels", "loads")], "", ("calibrate",)),
    "attitude of 1e11 rows": (declare("attitude", (10**11, 2), chunks=(10**6, 2)), "attitude"),
}


def cases():
    for kind, changes in (("check", CHECK), ("sweep", SWEEP), ("static", STATIC)):
        for name, (change, word, *commands) in changes.items():
            for command in commands[0] if commands else (OWN[kind], "check"):
                yield pytest.param(kind, change, word, command, id=f"{kind}-{name}-{command}")


@pytest.mark.parametrize(("kind", "change", "word", "command"), list(cases()))
def test_a_malformed_run_is_refused(examples, tmp_path, out, kind, change, word, command):
    path = tmp_path / "bad.h5"
    shutil.copy(examples / f"{kind}.run.h5", path)
    with h5py.File(path, "r+") as file:
        change(file)
    assert_refused(call(*examples.words(command, path, out)), out, "bad.h5", word)


BYTES = {
    **{f"first {count}": (lambda b, n=count: b[:n]) for count in (0, 4, 8, 100, 600, 2048, 5000)},
    "half": lambda b: b[: len(b) // 2],
    "all but one": lambda b: b[:-1],
    "superblock": lambda b: b[:8] + b"\xff" * 88 + b[96:],
    "text": lambda b: b"hello\n" * 100,
}


@pytest.mark.parametrize("change", BYTES.values(), ids=BYTES)
@pytest.mark.parametrize("kind", ["check", "static"])
def test_a_damaged_run_is_refused(examples, tmp_path, out, kind, change):
    path = tmp_path / "bad.h5"
    path.write_bytes(change((examples / f"{kind}.run.h5").read_bytes()))
    assert_refused(call(*examples.words(OWN[kind], path, out)), out, "bad.h5")


USUAL = {
    "big endian": data("channels", lambda a: a.astype(">f8")),
    "another order": lambda f: (
        data("channels", lambda a: a[:, ::-1])(f),
        f["channels"].attrs.create("names", f["channels"].attrs["names"][::-1], dtype=h5py.string_dtype()),
    ),
    "a group that contains itself": lambda f: f["rotor"].__setitem__("again", f["rotor"]),
    "other datasets": lambda f: [f.create_dataset(f"x/{i}", data=0) for i in range(500)],
}


@pytest.mark.parametrize("change", USUAL.values(), ids=USUAL)
def test_unusual_but_sound_runs_are_accepted(examples, tmp_path, out, change):
    path = tmp_path / "good.h5"
    shutil.copy(examples / "check.run.h5", path)
    with h5py.File(path, "r+") as file:
        change(file)
    assert call(*examples.words("reduce", path, out)).exit_code == 0


def test_a_copy_under_another_name_is_no_hold_out(examples, tmp_path, out):
    path = tmp_path / "copy.h5"
    shutil.copy(examples / "sweep.run.h5", path)
    with h5py.File(path, "r+") as file:
        file.attrs["run"] = "fresh"
    runs = [examples / "sweep.run.h5", examples / "tilt.run.h5", "--hold-out", path]
    done = call("diagnose", examples / "model.h5", *runs, "-o", out / "d.h5", "--model-out", out / "m.h5")
    assert_refused(done, out, "copy.h5", "samples of run `sweep`")


def test_channels_in_millivolts_are_named(examples, tmp_path, out):
    path = tmp_path / "bad.h5"
    shutil.copy(examples / "static.run.h5", path)
    with h5py.File(path, "r+") as file:
        data("channels", lambda a: a * 1000.0)(file)
    assert_refused(call(*examples.words("check -g", path, out)), out, "bad.h5", "z1.strain", "mV")
