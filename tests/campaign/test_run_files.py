"""Run files: what is sound survives writing and reading; what is not is refused by name, never with a traceback."""

import shutil
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from balance_cli.campaign.recording.attribute_checks import kind_faults
from balance_cli.campaign.recording.dataset_checks import MOST_PULSES
from balance_cli.campaign.recording.run import MemorySource, Run, read_channels, run_digest
from balance_cli.campaign.recording.run_file import open_run, open_runs, read_run, write_run
from balance_cli.campaign.rig.components import COMPONENTS, EXCITATIONS, UNITS
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.io.errors import UserError
from tests.support.run_content import a_run

ROOT = Path(__file__).parents[2]
SAMPLES = sorted((ROOT / "sample_data").glob("*.h5"))
QUICK = settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
TEXT = st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "Zs")), min_size=1, max_size=8).filter(str.strip)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.h5"


def assert_same(read: Run, written: Run) -> None:
    own = ("source", "path", "digest", "pulse_times")
    assert {k: v for k, v in vars(read).items() if k not in own} == {
        k: v for k, v in vars(written).items() if k not in own
    }
    assert np.array_equal(np.asarray(read.pulse_times), np.asarray(written.pulse_times))
    block, expected = read.read(), written.read()
    assert block.channels.dtype == np.float64
    assert np.array_equal(block.channels, expected.channels, equal_nan=True)
    assert (block.loads is None) == (expected.loads is None)
    assert block.loads is None or np.array_equal(block.loads, expected.loads)


@st.composite
def runs(draw: st.DrawFn) -> Run:
    kind = draw(st.sampled_from(["static", "zero", "sweep", "check", "wind"]))
    changes: dict[str, Any] = {"name": draw(TEXT), "rig": draw(TEXT), "note": draw(st.none() | TEXT)}
    changes["channel_names"] = tuple(draw(st.lists(TEXT, min_size=1, max_size=5, unique=True)))
    samples = changes["samples"] = draw(st.integers(95, 9000))
    rng = np.random.default_rng(draw(st.integers(0, 9)))
    size = draw(st.sampled_from([np.float32, np.float64]))
    channels = rng.normal(size=(samples, len(changes["channel_names"]))).astype(size).astype(float)
    loads = rng.normal(size=(samples, 6)) if kind in ("static", "sweep", "check") else None
    if kind == "sweep":
        excited = draw(st.lists(st.sampled_from(COMPONENTS), min_size=1, unique=True))
        level = draw(st.lists(st.floats(0.1, 100), min_size=len(excited), max_size=len(excited)))
        excitation = draw(st.sampled_from(EXCITATIONS))
        changes |= {"excited": tuple(excited), "level": tuple(level), "excitation": excitation}
    return a_run(kind, source=MemorySource(channels, loads), **changes)


@QUICK
@given(runs())
def test_a_run_survives_writing_and_reading(tmp_path: Path, run: Run) -> None:
    path = tmp_path / "run.h5"
    write_run(path, run)
    read = open_run(path)
    assert_same(read, run)
    assert read.digest == run_digest(run)
    assert sum(len(block.channels) for block in read.blocks(1000)) == run.samples
    assert np.array_equal(read.read(10, 20).channels, run.read(10, 20).channels)


def test_samples_that_float32_holds_are_stored_as_such(path: Path) -> None:
    for size in (np.float32, np.float64):
        exact = np.random.default_rng(0).normal(size=(100, 3)).astype(size)
        write_run(path, a_run("wind", source=MemorySource(exact.astype(float), None)))
        with h5py.File(path) as file:
            assert file["channels"].dtype == size


def test_the_digest_is_of_the_content_and_not_of_path_storage_or_order_of_loads(path: Path, tmp_path: Path) -> None:
    run = a_run()
    write_run(path, run)
    other = tmp_path / "other.h5"
    with h5py.File(other, "w") as file, h5py.File(path) as first:
        for name, value in reversed(list(first.attrs.items())):
            file.attrs[name] = np.bytes_(value) if isinstance(value, str) else value
        file.attrs["operator"] = "not ours to know"
        file["channels"] = first["channels"][()]
        file["channels"].attrs["names"] = np.array(run.channel_names, "S")
        file["channels"].attrs["unit"] = "V"
        file["loads"] = first["loads"][()][:, ::-1]
        file["loads"].attrs.create("names", COMPONENTS[::-1], dtype=h5py.string_dtype())
        file["loads"].attrs.create("units", UNITS[::-1], dtype=h5py.string_dtype())
        file["rotor/pulse_times"] = first["rotor/pulse_times"][()]
    assert_same(open_run(other), run)
    assert open_run(other).digest == open_run(path).digest
    samples = run.read().channels.copy()
    samples[50, 1] = np.nextafter(samples[50, 1], 9.0)
    write_run(path, replace(run, source=MemorySource(samples, run.read().loads)))
    assert open_run(path).digest != open_run(other).digest


def test_scalar_and_array_attributes_say_the_same(path: Path) -> None:
    write_run(path, a_run("sweep"))
    plain = open_run(path)
    with h5py.File(path, "a") as file:
        file.attrs["excited"] = ["Fx"]
        file.attrs["level"] = [2]
        file.attrs["period"] = np.array([0.5])
    assert open_run(path).digest == plain.digest


def test_what_other_programs_write_says_the_same(path: Path) -> None:
    """Text of a fixed length filled up with blanks, `Nm`, and optional items that hold nothing."""
    write_run(path, replace(a_run("sweep", excitation="random"), period=None))
    digest = open_run(path).digest
    with h5py.File(path, "a") as file:
        padded = [name.ljust(20) for name in file["loads"].attrs["names"]]
        file["loads"].attrs["names"] = np.array(padded, "S20")
        file["loads"].attrs["units"] = ["N"] * 3 + ["Nm", "N*m", "N.m"]
        file.attrs["kind"] = np.bytes_(b"sweep   ")
        file.attrs["period"] = np.nan
        file.create_dataset("temperature", data=np.zeros((0, 1)))
        file.create_dataset("attitude", data=np.zeros((0, 2)))
        file.create_dataset("series", data=h5py.Empty("i4"))
    assert open_run(path).digest == digest


def test_storage_of_other_programs_says_the_same(path: Path, tmp_path: Path) -> None:
    """A user block, attributes as arrays, and pulses of an earlier trigger."""
    write_run(path, a_run("wind"))
    other = tmp_path / "other.h5"
    with h5py.File(other, "w", userblock_size=512) as file, h5py.File(path) as first:
        for name, value in first.attrs.items():
            file.attrs[name] = [value]
        first.copy("channels", file)
        pulses = first["rotor/pulse_times"][()]
        file["rotor/pulse_times"] = np.concatenate([[pulses[0] - 9.0, pulses[0] - 8.0], pulses])
    assert open_run(other).digest == open_run(path).digest


def damage(path: Path, change: Any) -> list[UserError]:
    with h5py.File(path, "a") as file:
        change(file)
    _, faults = read_run(path)
    assert all(fault.file == str(path) and fault.remedy for fault in faults)
    return list(faults)


def put(name: str, value: Any, of: str = "/") -> Any:
    return lambda file: file[of].attrs.__setitem__(name, value)


def drop(name: str, of: str = "/") -> Any:
    return lambda file: file[of].attrs.__delitem__(name)


def replaced(name: str, change: Any) -> Any:
    def apply(file: h5py.File) -> None:
        data, attributes = change(file[name][()]), dict(file[name].attrs)
        del file[name]
        file[name] = data
        file[name].attrs.update(attributes)

    return apply


def linked(name: str, link: Any) -> Any:
    def apply(file: h5py.File) -> None:
        del file[name]
        file[name] = link

    return apply


@pytest.mark.parametrize(
    ("kind", "change", "place", "words"),
    [
        ("check", put("format", "balance-run/2"), "", "balance-run/2"),
        ("check", put("kind", "trim"), "attribute kind", "'trim'"),
        ("check", drop("rig"), "attribute rig", "missing"),
        ("check", put("run", " "), "attribute run", "' '"),
        ("check", put("sample_rate", -1.0), "attribute sample_rate", "-1.0"),
        ("check", put("sample_rate", np.nan), "attribute sample_rate", "nan"),
        ("check", put("sample_rate", 1e12), "attribute sample_rate", "1000000000000.0"),
        ("check", put("rotor_speed", 51.0), "attribute rotor_speed", "51.0"),
        ("wind", drop("rotor_speed"), "attribute rotor_speed", "missing"),
        ("static", drop("trim"), "attribute trim", "missing"),
        ("sweep", put("excited", "Fq"), "attribute excited", "'Fq'"),
        ("sweep", put("excited", ["Fx", "Fx"]), "attribute excited", "Fx"),
        ("sweep", put("excitation", "noise"), "attribute excitation", "'noise'"),
        ("sweep", put("level", [1.0, 2.0]), "attribute level", "2.0"),
        ("sweep", put("level", 1e300), "attribute level", "1e+300"),
        ("sweep", drop("period"), "attribute period", "missing"),
        ("sweep", put("period", 1e-300), "attribute period", "1e-300"),
        ("sweep", put("period", 0.019), "attribute period", "0.019"),
        ("check", drop("names", "channels"), "channels, attribute names", "0 names for 3 columns"),
        ("check", put("names", ["a", "a", "b"], "channels"), "channels, attribute names", "`a` is used twice"),
        ("check", put("unit", "N", "channels"), "channels, attribute unit", "is N"),
        ("check", put("units", ["N"] * 6, "loads"), "loads, attribute units", "N, N"),
        ("check", put("names", list("abcdef"), "loads"), "loads, attribute names", "a, b"),
        ("check", lambda file: file.__delitem__("loads"), "loads", "missing"),
        ("check", lambda file: file.__delitem__("rotor"), "rotor/pulse_times", "missing"),
        ("wind", lambda file: file.create_dataset("loads", data=np.zeros((100, 6))), "loads", "has no loads"),
        ("check", replaced("loads", lambda data: data[:60]), "loads", "60 rows, but 100"),
        ("check", replaced("channels", lambda data: data[:, 0]), "channels", "shape (100,)"),
        ("check", replaced("channels", lambda data: data.astype("S8")), "channels", "real numbers"),
        ("check", replaced("channels", lambda data: data[:, :0]), "channels", "no columns"),
        ("check", linked("channels", h5py.SoftLink("/channels")), "channels", "cannot be read"),
        ("check", linked("loads", h5py.ExternalLink("/tmp/other.h5", "/loads")), "loads", "in another file"),
        ("wind", replaced("channels", lambda data: data[:1]), "channels", "holds 1 samples"),
        ("check", replaced("rotor/pulse_times", lambda data: data[:1]), "rotor/pulse_times", "holds 1 pulses"),
        ("check", replaced("rotor/pulse_times", lambda data: data[::-1]), "rotor/pulse_times", "not later"),
        ("check", replaced("rotor/pulse_times", lambda data: data * np.nan), "rotor/pulse_times", "not finite"),
        ("check", replaced("rotor/pulse_times", lambda data: data + 9.0), "rotor/pulse_times", "within the record"),
        ("check", replaced("loads", lambda data: data * np.nan), "loads, column Fx", "100 of 100"),
        (
            "check",
            replaced("rotor/pulse_times", lambda data: data * 1e300),
            "rotor/pulse_times",
            "not finite, or beyond",
        ),
        ("static", replaced("loads", lambda data: data * 1e300), "loads, column Mz", "100 of 100"),
        ("sweep", replaced("loads", lambda data: data * 0.0), "loads, column Fx", "all samples are zero"),
    ],
)
def test_each_fault_is_named_with_its_place(path: Path, kind: str, change: Any, place: str, words: str) -> None:
    write_run(path, a_run(kind))
    faults = damage(path, change)
    assert (place, True) in [(fault.place, words in fault.fault) for fault in faults]
    with pytest.raises(UserError):
        open_run(path)


def test_loads_not_measured_are_zeros_and_no_fault(path: Path) -> None:
    run = a_run("sweep")
    loads = np.array(run.read().loads) * [1, 0, 0, 0, 0, 0]
    write_run(path, replace(run, source=MemorySource(run.read().channels, loads)))
    assert np.array_equal(np.asarray(open_run(path).read().loads), loads)


def test_a_record_that_broke_off_is_not_read_as_zeros(path: Path) -> None:
    def break_off(file: h5py.File) -> None:
        attributes = dict(file["channels"].attrs)
        del file["channels"]
        file.create_dataset("channels", (100, 3), "f4", chunks=(20, 3))[:50] = 1.0
        file["channels"].attrs.update(attributes)

    write_run(path, a_run("wind"))
    assert "not all samples" in damage(path, break_off)[0].fault


@pytest.mark.parametrize(
    ("kind", "name", "shape", "words"),
    [
        ("wind", "rotor/pulse_times", (10**11,), "not all of them were written"),
        ("static", "attitude", (10**11, 2), "not all samples were written"),
        ("wind", "channels", (10**11, 3), "not all samples were written"),
    ],
)
def test_sizes_that_are_declared_and_not_stored_are_refused_unread(
    path: Path, kind: str, name: str, shape: tuple[int, ...], words: str
) -> None:
    def declare(file: h5py.File) -> None:
        attributes = dict(file[name].attrs) if name in file else {"names": ["pitch", "roll"], "unit": "deg"}
        if name in file:
            del file[name]
        file.create_dataset(name, shape, "f8", chunks=(2**16, *shape[1:])).attrs.update(attributes)

    write_run(path, a_run(kind))
    assert any(fault.place == name and words in fault.fault for fault in damage(path, declare))


def test_a_record_of_one_value_that_takes_hardly_any_room_is_refused_unread(path: Path) -> None:
    rows = 12_000_000

    def fill(file: h5py.File) -> None:
        attributes = dict(file["channels"].attrs)
        del file["channels"]
        chunks = (rows // 12, 3)
        dataset = file.create_dataset("channels", (rows, 3), "f8", chunks=chunks, compression="gzip")
        stored = zlib.compress(bytes(8 * chunks[0] * chunks[1]))
        for start in range(0, rows, chunks[0]):
            dataset.id.write_direct_chunk((start, 0), stored)
        dataset.attrs.update(attributes)

    write_run(path, a_run("wind"))
    (fault,) = damage(path, fill)
    assert (fault.place, "the same value" in fault.fault) == ("channels", True)


def test_too_many_pulses_are_refused_unread(path: Path) -> None:
    def fill(file: h5py.File) -> None:
        del file["rotor/pulse_times"]
        count = MOST_PULSES + 1
        dataset = file.create_dataset("rotor/pulse_times", (count,), "f8", chunks=(count,), compression="gzip")
        dataset.id.write_direct_chunk((0,), zlib.compress(bytes(8 * count)))

    write_run(path, a_run("wind"))
    (fault,) = damage(path, fill)
    assert (fault.place, "more than" in fault.fault) == ("rotor/pulse_times", True)


def test_truncated_foreign_and_missing_files_are_refused(tmp_path: Path) -> None:
    whole = SAMPLES[0].read_bytes()
    contents = {"half": whole[: len(whole) // 2], "head": whole[:600], "text": b"format: balance-run/1\n", "empty": b""}
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    for name in (*contents, "missing", "."):
        with pytest.raises(UserError) as caught:
            open_run(tmp_path / name)
        assert str(tmp_path) in str(caught.value)
        assert caught.value.remedy


@pytest.mark.parametrize("seed", range(8))
def test_damage_among_the_samples_is_found(tmp_path: Path, seed: int) -> None:
    """The samples are compressed: whatever is overwritten there shows when they are read."""
    content = bytearray(SAMPLES[-1].read_bytes())
    rng = np.random.default_rng(seed)
    at = int(rng.integers(len(content) // 2, len(content) - 9000))
    content[at : at + 64] = rng.bytes(64)
    path = tmp_path / "damaged.h5"
    path.write_bytes(content)
    with pytest.raises(UserError, match="truncated or damaged"):
        open_run(path)


ODD = (np.array([]), np.array([1.0, 2.0]), ["Fx", "Fy"], np.bytes_(b"\xff\xfe"), h5py.Empty("f8"), True, 1j)
VALUES = st.one_of(
    st.integers(-5, 5),
    st.floats(),
    st.text(st.characters(codec="ascii", min_codepoint=1), max_size=4),
    st.sampled_from(ODD),
)


@QUICK
@given(st.sampled_from(["static", "zero", "sweep", "check", "wind"]), st.data())
def test_whatever_an_attribute_holds_the_run_is_read_or_refused(tmp_path: Path, kind: str, data: st.DataObject) -> None:
    path = tmp_path / "run.h5"
    write_run(path, a_run(kind))
    with h5py.File(path, "a") as file:
        for _ in range(data.draw(st.integers(1, 3))):
            part = file[data.draw(st.sampled_from(sorted({"/", "channels"} | ({"loads"} & set(file)))))]
            part.attrs[data.draw(st.sampled_from([*part.attrs, "recorded", "note"]))] = data.draw(VALUES)
    run, faults = read_run(path)
    assert (run is None) == bool(faults)
    assert all(isinstance(fault, UserError) for fault in faults)
    assert run is None or run_digest(run) == run.digest
    assert all(str(fault).encode() for fault in faults)


DATASETS = st.sampled_from(["channels", "loads", "rotor/pulse_times"])
SHAPES = st.sampled_from([(), (0,), (3,), (100,), (0, 3), (100, 0), (99, 3), (100, 4), (100, 3, 1)])


@QUICK
@given(DATASETS, SHAPES, st.sampled_from(["f8", "S4", "c16", "?", "i2"]))
def test_whatever_a_dataset_holds_the_run_is_read_or_refused(
    tmp_path: Path, name: str, shape: tuple[int, ...], kind: str
) -> None:
    path = tmp_path / "run.h5"
    write_run(path, a_run())
    with h5py.File(path, "a") as file:
        attributes = dict(file[name].attrs)
        del file[name]
        file[name] = np.zeros(shape, kind)
        file[name].attrs.update(attributes)
    assert read_run(path)[1]


def test_groups_where_datasets_belong_are_refused(path: Path) -> None:
    for name in ("channels", "loads", "rotor/pulse_times"):
        write_run(path, a_run())

        def to_group(file: h5py.File, name: str = name) -> None:
            del file[name]
            file.create_group(name)

        assert damage(path, to_group)


def test_channels_are_picked_by_name_and_absent_ones_are_nan() -> None:
    run = a_run()
    picked = read_channels(run, ("torque", "z9", "x.strain"))
    assert np.array_equal(picked[:, [0, 2]], run.read().channels[:, [2, 0]])
    assert np.isnan(picked[:, 1]).all()


@pytest.fixture
def campaign(tmp_path: Path) -> list[Path]:
    return [Path(shutil.copy(path, tmp_path)) for path in SAMPLES if path.name.startswith(("static", "wind"))]


def test_the_sample_campaign_opens() -> None:
    runs, skipped = open_runs(SAMPLES, load_geometry(ROOT / "configs" / "rts-6.yaml"))
    assert (len(runs), skipped) == (20, {})
    assert sorted({run.kind for run in runs}) == ["check", "static", "sweep", "wind"]


def test_bad_runs_stop_the_call_or_are_skipped_and_listed(campaign: list[Path]) -> None:
    geometry = load_geometry(ROOT / "configs" / "rts-6.yaml")
    with h5py.File(campaign[0], "a") as file:
        file.attrs["rig"] = "RTS-7"
    campaign[1].write_bytes(b"no run")
    with pytest.raises(UserError, match="RTS-7"):
        open_runs(campaign, geometry)
    runs, skipped = open_runs(campaign, geometry, skip_bad=True)
    assert [run.name for run in runs] == [path.stem for path in campaign[2:]]
    assert list(skipped) == campaign[:2]
    with pytest.raises(UserError, match="all runs were skipped"):
        open_runs(campaign[:2], geometry, skip_bad=True)


def test_run_names_are_unique(campaign: list[Path]) -> None:
    geometry = load_geometry(ROOT / "configs" / "rts-6.yaml")
    twice = [campaign[0], campaign[1], campaign[0]]
    with pytest.raises(UserError, match="second copy"):
        open_runs(twice, geometry)
    runs, skipped = open_runs(twice, geometry, skip_bad=True)
    assert (len(runs), list(skipped)) == (2, [campaign[0]])
    with h5py.File(campaign[1], "a") as file:
        file.attrs["run"] = campaign[0].stem
    with pytest.raises(UserError, match="same run name"):
        open_runs(campaign, geometry, skip_bad=True)


def test_a_run_without_any_channel_of_the_rig_is_refused(path: Path) -> None:
    write_run(path, a_run("wind", channel_names=("a", "b", "c")))
    with pytest.raises(UserError, match="none of the channels"):
        open_runs([path], load_geometry(ROOT / "configs" / "rts-6.yaml"))


def test_nothing_is_left_of_a_run_that_could_not_be_written(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    broken = a_run(source=MemorySource(np.zeros((100, 2)), np.zeros((100, 6))))
    with pytest.raises(TypeError):
        write_run(path, broken)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(UserError, match="its folder does not exist"):
        write_run(tmp_path / "no" / "run.h5", a_run())


def test_numbers_among_unknown_attributes_are_conditions_of_the_run(path: Path) -> None:
    write_run(path, a_run())
    plain = open_run(path)
    with h5py.File(path, "a") as file:
        file.attrs["collective"] = np.float32(4.5)
        file.attrs["point"] = np.array([12])
        file.attrs["operator"] = "text"
        file.attrs["bad"] = np.nan
        file.attrs["several"] = [1.0, 2.0]
        file.attrs["link"] = file["channels"].ref
    read = open_run(path)
    assert read.conditions == {"collective": 4.5, "point": 12.0}
    assert read.digest != plain.digest  # results keep them
    write_run(path, read)
    assert open_run(path).conditions == read.conditions and open_run(path).digest == read.digest


@pytest.mark.parametrize("value", [h5py.Empty("f8"), [["Fx"]], 3.0, {}, (), [h5py.Empty("f8")]])
@pytest.mark.parametrize("name", ["excited", "excitation", "level", "period", "sample_rate", "rotor_speed"])
def test_attributes_of_any_type_are_faults(name, value):
    attributes = {"excited": "Fx", "excitation": "random", "level": 1.0, "sample_rate": 9.0, "rotor_speed": 0.0}
    faults = tuple(kind_faults({"kind": "sweep", **attributes, name: value}))
    if value != 3.0 or name in ("excited", "excitation"):
        assert [fault.place for fault in faults if name in fault.place]
