"""Artefacts: content, provenance and digest survive; what is damaged, changed or something else is refused."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.io.artefacts import (
    Input,
    Provenance,
    content_digest,
    load_artefact,
    make_provenance,
    read_stored,
    save_artefact,
)
from balance_cli.io.errors import UserError
from balance_cli.io.formats import ARTEFACT_FORMATS
from balance_cli.io.hdf5_tree import from_tree, to_tree, tree_digest

ROOT = Path(__file__).parents[2]
QUICK = settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
FORMAT = "balance-model/1"


@dataclass(frozen=True)
class Parameter:
    value: float
    sigma: float | None
    unit: str = "N/m"


@dataclass(frozen=True)
class Result:
    """One field of every type that an artefact may hold."""

    geometry: Geometry
    name: str
    count: int
    ratio: float
    pole: complex
    sound: bool
    nothing: NDArray[np.float64] | None
    names: tuple[str, ...]
    numbers: tuple[float, ...]
    pair: tuple[str, int]
    parts: tuple[Parameter, ...]
    spectra: tuple[NDArray[np.complex128], ...]
    parameters: dict[str, Parameter]
    harmonics: Mapping[int, dict[str, float]]
    response: NDArray[np.complex128]
    label: str | float
    later: tuple[float, ...] = field(default=(1.0,))


NAMES = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=5)
FLOATS = st.floats(allow_nan=True, allow_infinity=True)
PARAMETERS = st.builds(Parameter, FLOATS, st.none() | FLOATS, NAMES)


def arrays(kind: type) -> st.SearchStrategy[NDArray[Any]]:
    shapes = st.sampled_from([(0,), (3,), (2, 3), (40, 6, 6), ()])
    seeds = st.integers(0, 5)
    return st.builds(lambda shape, seed: _array(shape, seed, kind), shapes, seeds)


def _array(shape: tuple[int, ...], seed: int, kind: type) -> NDArray[Any]:
    rng = np.random.default_rng(seed)
    values = np.array(rng.normal(size=shape))
    return np.asarray((values + 1j * values[::-1] if shape else values * 1j) if kind is complex else values)


def results() -> st.SearchStrategy[Result]:
    return st.builds(
        Result,
        geometry=st.just(load_geometry(ROOT / "configs" / "rts-6.yaml")),
        name=NAMES,
        count=st.integers(-(2**62), 2**62),
        ratio=FLOATS,
        pole=st.complex_numbers(),
        sound=st.booleans(),
        nothing=st.none() | arrays(float),
        names=st.lists(NAMES).map(tuple),
        numbers=st.lists(FLOATS).map(tuple),
        pair=st.tuples(NAMES, st.integers(0, 9)),
        parts=st.lists(PARAMETERS, max_size=12).map(tuple),
        spectra=st.lists(arrays(complex), max_size=3).map(tuple),
        parameters=st.dictionaries(NAMES, PARAMETERS, max_size=4),
        harmonics=st.dictionaries(st.integers(0, 8), st.dictionaries(NAMES, FLOATS, max_size=2), max_size=12),
        response=arrays(complex),
        label=NAMES | FLOATS,
        later=st.just((2.0, 3.0)),
    )


def a_provenance(**changes: Any) -> Provenance:
    made = make_provenance("identify", {"form": "paper"}, (Input("r1", "run", "aa"), Input("r2", "run", "bb")))
    return replace(made, **changes)


def a_result() -> Result:
    parameter = Parameter(1.0, None)
    rig = load_geometry(ROOT / "configs" / "rts-6.yaml")
    scalars = ("n", 1, 0.5, 1j, True, None, ("a", "b"), (1.0, 2.0), ("a", 1))
    spectra = (np.ones(3) * 1j,)
    return Result(rig, *scalars, (parameter,), spectra, {"k": parameter}, {1: {"Fx": 2.0}}, np.eye(3) * 1j, "l")


def saved(path: Path, content: object = None, provenance: Provenance | None = None) -> str:
    return save_artefact(path, FORMAT, content or a_result(), provenance or a_provenance())


@QUICK
@given(results())
def test_a_result_survives_saving_and_loading(tmp_path: Path, result: Result) -> None:
    path = tmp_path / "model.h5"
    provenance = a_provenance()
    digest = save_artefact(path, FORMAT, result, provenance)
    artefact = load_artefact(path, {"balance-transfer/1": Parameter, FORMAT: Result})
    assert (artefact.format, artefact.provenance, artefact.digest) == (FORMAT, provenance, digest)
    read = artefact.content
    assert isinstance(read, Result)
    assert content_digest(FORMAT, read, provenance) == digest
    assert read.geometry == result.geometry
    assert read.response.dtype == result.response.dtype
    assert list(read.parameters) == list(result.parameters)
    assert list(read.harmonics) == list(result.harmonics)
    assert repr(read) == repr(result)


def test_the_digest_covers_data_options_inputs_and_format_but_not_the_rest() -> None:
    result, provenance = a_result(), a_provenance()
    digest = content_digest(FORMAT, result, provenance)
    same = [
        replace(provenance, created="1985-01-01", versions={"numpy": "0"}, command="diagnose"),
        replace(provenance, inputs=(Input("elsewhere", "run", "bb"), Input("r1", "run", "aa"))),
    ]
    other = [
        replace(provenance, options={}),
        replace(provenance, inputs=(Input("r1", "run", "aa"), Input("r2", "run", "cc"))),
        replace(provenance, inputs=(Input("r1", "run", "aa"), Input("r2", "hold-out", "bb"))),
    ]
    assert [content_digest(FORMAT, result, item) == digest for item in same] == [True] * 2
    assert [content_digest(FORMAT, result, item) == digest for item in other] == [False] * 3
    assert content_digest("balance-diagnosis/1", result, provenance) != digest
    nudged = np.array(result.response)
    nudged[0, 0] += 1e-16j * 4
    assert content_digest(FORMAT, replace(result, response=nudged), provenance) != digest


def test_numbers_of_numpy_are_numbers(tmp_path: Path) -> None:
    """np.float64 is a float, and yet prints otherwise."""
    plain, numpy = Parameter(0.5, 2.0), Parameter(np.float64(0.5), np.float32(2.0), np.str_("N/m"))  # type: ignore
    assert saved(tmp_path / "a.h5", plain) == saved(tmp_path / "b.h5", numpy)
    assert repr(load_artefact(tmp_path / "b.h5", {FORMAT: Parameter}).content) == repr(plain)


@QUICK
@given(st.recursive(NAMES | FLOATS, lambda inner: st.dictionaries(NAMES, inner, max_size=3), max_leaves=6), st.data())
def test_trees_that_differ_have_different_digests(tree: Any, data: st.DataObject) -> None:
    other = data.draw(
        st.recursive(NAMES | FLOATS, lambda inner: st.dictionaries(NAMES, inner, max_size=3), max_leaves=6)
    )
    assert (tree_digest({"a": tree}) == tree_digest({"a": other})) == (repr(_sorted(tree)) == repr(_sorted(other)))


def _sorted(tree: Any) -> Any:
    return {key: _sorted(tree[key]) for key in sorted(tree)} if isinstance(tree, dict) else tree


def test_the_head_of_an_artefact_is_readable_without_this_program(tmp_path: Path) -> None:
    saved(tmp_path / "model.h5")
    with h5py.File(tmp_path / "model.h5") as file:
        head = {name: str(value) for name, value in file.attrs.items()}
        assert file["content/response"].shape == (3, 3)
        assert file["content/parameters/k/value"][()] == 1.0
    assert (head["format"], head["command"]) == (FORMAT, "identify")
    assert json.loads(head["options"]) == {"form": "paper"}
    assert json.loads(head["inputs"])[1] == {"name": "r2", "role": "run", "digest": "bb"}
    assert {"balance-cli", "python", "numpy", "scipy"} <= set(json.loads(head["versions"]))


def test_large_arrays_are_compressed(tmp_path: Path) -> None:
    saved(tmp_path / "model.h5", replace(a_result(), response=np.zeros((400, 15, 6), complex)))
    assert (tmp_path / "model.h5").stat().st_size < 60_000


def test_an_artefact_of_an_older_program_lacks_a_field_that_has_a_default() -> None:
    tree = to_tree(a_result())
    del tree["later"]
    assert from_tree(tree, Result).later == (1.0,)
    del tree["count"]
    with pytest.raises(TypeError):
        from_tree(tree, Result)


@pytest.mark.parametrize("content", [object(), {"a": {1, 2}}, np.array([object()])])
def test_what_has_no_place_in_an_artefact_is_our_fault(tmp_path: Path, content: object) -> None:
    with pytest.raises(TypeError):
        saved(tmp_path / "model.h5", Parameter(content, None))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="unknown format"):
        save_artefact(tmp_path / "model.h5", "balance-geometry/1", a_result(), a_provenance())
    assert list(tmp_path.iterdir()) == []


def test_something_else_is_refused_with_what_it_is(tmp_path: Path) -> None:
    saved(tmp_path / "model.h5")
    (tmp_path / "empty.h5").touch()
    (tmp_path / "text.h5").write_text("format: balance-calibration/1\n", encoding="utf-8")
    h5py.File(tmp_path / "bare.h5", "w").close()
    files = {
        tmp_path / "model.h5": "`balance-model/1`",
        tmp_path / "empty.h5": "an empty file",
        tmp_path / "text.h5": "`balance-calibration/1`",
        tmp_path / "bare.h5": "without a readable `format`",
        tmp_path / "missing.h5": "no such file",
        tmp_path: "a folder",
        ROOT / "configs" / "rts-6.yaml": "`balance-geometry/1`",
        ROOT / "sample_data" / "wind-1.h5": "`balance-run/1`",
    }
    for path, words in files.items():
        with pytest.raises(UserError) as caught:
            load_artefact(path, {"balance-calibration/1": Result})
        assert words in str(caught.value)
        assert str(path) in str(caught.value)


def test_an_artefact_edited_by_hand_is_refused(tmp_path: Path) -> None:
    def edit(change: Any) -> str:
        saved(tmp_path / "model.h5")
        with h5py.File(tmp_path / "model.h5", "a") as file:
            change(file)
        with pytest.raises(UserError) as caught:
            load_artefact(tmp_path / "model.h5", {FORMAT: Result})
        return str(caught.value)

    assert "balance identify" in edit(lambda file: file["content/parameters/k/value"].write_direct(np.array(2.0)))
    assert "changed after" in edit(lambda file: file.attrs.__setitem__("options", "{}"))
    assert "changed after" in edit(lambda file: file.__delitem__("content/label"))
    assert "does not match" in edit(lambda file: file.attrs.__delitem__("inputs"))
    assert "does not match" in edit(lambda file: file.attrs.__setitem__("inputs", "no JSON"))
    assert "does not match" in edit(lambda file: file.__delitem__("content"))
    assert "are not tables" in edit(lambda file: file.attrs.__setitem__("versions", '"x"'))
    assert "is not text" in edit(lambda file: file.attrs.__setitem__("versions", '{"python": 3}'))
    assert "needs the attribute `command`" in edit(lambda file: file.attrs.__delitem__("command"))
    assert "a link to the group" in edit(lambda file: file["content"].__setitem__("again", file["content"]))
    elsewhere = h5py.ExternalLink("/etc/other.h5", "/")
    assert "a link to elsewhere" in edit(lambda file: file["content"].__setitem__("again", elsewhere))
    unwritten = {"shape": (10**11,), "dtype": "f8", "chunks": (10**6,)}
    assert "of which 0 are stored" in edit(lambda file: file["content"].create_dataset("z", **unwritten))


@pytest.mark.parametrize("seed", range(6))
def test_a_damaged_artefact_is_refused(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "model.h5"
    noise = np.random.default_rng(seed).normal(size=(200, 6, 6)) + 0j
    saved(path, replace(a_result(), response=noise))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * (seed + 1) // 7])
    with pytest.raises(UserError):
        load_artefact(path, {FORMAT: Result})
    with h5py.File(path, "w") if seed == 0 else h5py.File(tmp_path / "other.h5", "w"):
        pass
    start = whole.index(b"\x78\x5e") if b"\x78\x5e" in whole else len(whole) // 2
    path.write_bytes(whole[: start + 500] + bytes(64) + whole[start + 564 :])
    with pytest.raises(UserError):
        load_artefact(path, {FORMAT: Result})


def test_content_of_another_type_is_refused(tmp_path: Path) -> None:
    saved(tmp_path / "model.h5", Parameter(1.0, None))
    with pytest.raises(UserError, match="does not match its format"):
        load_artefact(tmp_path / "model.h5", {FORMAT: Result})
    assert read_stored(tmp_path / "model.h5").tree == {"value": 1.0, "sigma": None, "unit": "N/m"}


def test_saving_again_replaces_the_whole_file_or_nothing(tmp_path: Path) -> None:
    path = tmp_path / "model.h5"
    first = saved(path)
    with pytest.raises(TypeError):
        saved(path, Parameter(object(), None))  # type: ignore[arg-type]
    assert load_artefact(path, {FORMAT: Result}).digest == first
    second = saved(path, replace(a_result(), count=2))
    assert load_artefact(path, {FORMAT: Result}).digest == second != first
    assert [item.name for item in tmp_path.iterdir()] == ["model.h5"]


def test_the_formats_are_those_of_the_results() -> None:
    kinds = ("calibration", "transfer", "model", "diagnosis", "loads", "spectra")
    assert tuple(f"balance-{kind}/1" for kind in kinds) == ARTEFACT_FORMATS
