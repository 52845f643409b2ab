"""Artefacts of former versions stay readable: one of each format and version is kept for ever, with its digest."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import balance_cli
from balance_cli.api.artefacts import ARTEFACT_TYPES
from balance_cli.cli.file_check import check_file
from balance_cli.io.artefacts import load_artefact, read_stored
from balance_cli.io.formats import ARTEFACT_FORMATS, SPECTRA_FORMAT
from balance_cli.io.hdf5_tree import to_tree
from balance_cli.report.page import build_page
from balance_cli.report.sources import group_sources

VERSIONS = ("0.1.0", "0.2.0")
FOLDER = Path(__file__).parent / "old_artefacts"
DIGESTS = {
    "calibration": "0cb01ea7b68ca8c2d97b4f549fd1824aa0d370f78ecbb63a4250655170a98f86",
    "calibration-0.2": "fefae2d693711595df3d850a916aeb7d6ea40302555556334051992f9bacc50a",
    "calibration-direct": "581e7d17409a80305289c7515deef7fbfac11c96ab3d0c20871d745a0ed908ec",
    "diagnosis": "c2476af22071c3fa32d488ac65f6c03c42d58c19509c7fe45ba526a6b4c9f879",
    "diagnosis-0.2": "0b06e0f75dc6a857dd66249313df458d8f41de7fe0925b02cd175a507c332625",
    "loads-0.2": "5ed27228283d12a56c593c518e6a5089d085207187d8ec3f47ee929b0f55c6e7",
    "loads-closed": "ea316eed74dc965ddb397730d1cee48b2153351c62009de187ab2c3897cb825a",
    "loads-paper-full": "aabed42c7e8e5e7daeb13b3987d20ebc127fad635b4cf52316dd2d1ac3d43a44",
    "loads-smoother": "40dd2b32004b25e51baef341a2575e7172293a726e31a02966b9416ab3f53cd8",
    "loads-static": "68ea9b1a6a331b933362e7192598a6a3989e94b590a811ba300b9f2b9a4b219a",
    "loads-transfer": "bf33576722ce0fbfc9b7b7ef69987230f551a496c2910e5fe46d590e573870f9",
    "model-0.2": "f1041189ff6465329a549d6922f67ee0efb4b9e99ceda0e842498ababce04f72",
    "model-closed": "72f0e871c1bc0f490caabb25aa7cecf7ff12bc957429c0c5757a121a13ac97f8",
    "model-paper": "e9ceda28b8b5907acc73be03f6b1bb6961188ab3824c4192eea29e3165aa03e4",
    "spectra": "8a329d6316422f54b96f6853f59407a1f15883558903a8214f06d3f3b5c0ce60",
    "transfer": "ec187b598dc270e3ea0135434efd843777df69bff4efe3b75d161cc35c666210",
    "transfer-0.2": "317897e1505e3e95804dc515f344f8fd307225bf445b87a437c4b076397b05c4",
}
LOADS_LABELS = {
    "loads-static.h5": "static matrix",
    "loads-transfer.h5": "measured response",
    "loads-paper-full.h5": "paper\N{RIGHT SINGLE QUOTATION MARK}s form (LS+ML, full damping)",
    "loads-closed.h5": "updated model (3 effects)",
    "loads-smoother.h5": "updated model (3 effects), smoother",
    "loads-0.2.h5": "computed model with time-delay",
}


def old_artefact(name: str):
    return load_artefact(FOLDER / f"{name}.h5", ARTEFACT_TYPES)


def test_every_format_and_every_file_is_covered():
    assert {path.stem for path in FOLDER.iterdir()} == set(DIGESTS)
    artefacts = [old_artefact(name) for name in DIGESTS]
    # Spectra came with version 0.2.
    kept = {(artefact.format, artefact.provenance.versions["balance-cli"]) for artefact in artefacts}
    assert kept == {(name, version) for name in ARTEFACT_FORMATS for version in VERSIONS} - {(SPECTRA_FORMAT, "0.1.0")}
    assert VERSIONS[-1] == balance_cli.__version__


@pytest.mark.parametrize("name", DIGESTS)
def test_an_old_artefact_is_read_with_its_digest(name):
    """`load_artefact` computes the digest of what it reads and compares it with the one stated."""
    artefact = old_artefact(name)
    assert isinstance(artefact.content, ARTEFACT_TYPES[artefact.format])
    assert artefact.digest == DIGESTS[name]


@pytest.mark.parametrize("name", DIGESTS)
def test_what_was_stored_is_stored_again_under_the_same_names(name):
    """A field may be added or renamed in the code; what files hold keeps its name and value."""
    stored = read_stored(FOLDER / f"{name}.h5").tree
    assert list(differences(stored, to_tree(old_artefact(name).content), "content")) == []


def test_a_file_given_twice_is_two_sources_of_the_page():
    smoother = (FOLDER / "loads-smoother.h5", old_artefact("loads-smoother"))
    again = (FOLDER / "loads-smoother.h5", old_artefact("loads-smoother"))
    assert "in-time" in build_page(group_sources([smoother, again])).sections


@pytest.mark.parametrize("name", DIGESTS)
def test_check_accepts_an_old_artefact(name):
    assert check_file(FOLDER / f"{name}.h5", None).faults == ()


def test_the_labels_of_loads_do_not_need_the_model_on_the_page():
    loads = group_sources([(FOLDER / f"{name}.h5", old_artefact(name)) for name in DIGESTS if "loads" in name]).loads
    assert {source.file: source.label for source in loads} == LOADS_LABELS


def test_a_page_of_old_artefacts_has_all_sections():
    shown = [(FOLDER / f"{name}.h5", old_artefact(name)) for name in DIGESTS]
    page = build_page(group_sources(shown))
    assert list(page.sections) == [
        "summary",
        "wind-on",
        "load-spectra",
        "in-time",
        "diagnosis",
        "eigenfrequencies",
        "shapes",
        "responses",
        "parameters",
        "check-runs",
        "sweeps",
        "calibration",
        "calibration-history",
        "provenance",
    ]


def differences(old: Any, new: Any, place: str):
    """Places where a tree lacks what the old one holds, or holds another value."""
    if isinstance(old, dict):
        for key, value in old.items():
            if not isinstance(new, dict) or key not in new:
                yield f"{place}/{key} is missing"
            else:
                yield from differences(value, new[key], f"{place}/{key}")
    elif isinstance(old, np.ndarray):
        if not (old.dtype == new.dtype and np.array_equal(old, new, equal_nan=old.dtype.kind in "fc")):
            yield f"{place} differs"
    elif old != new and not (isinstance(old, float) and isinstance(new, float) and math.isnan(old) and math.isnan(new)):
        yield f"{place}: {old!r} became {new!r}"
