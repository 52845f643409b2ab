"""What the README and the package metadata say: the table of errors, versions, and the example of the interface."""

import json
import re
import tomllib
from pathlib import Path

import pytest
import yaml

import balance_cli
from benchmarks import table
from tests.support.tools import tool

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results"


def test_table_of_errors_is_that_of_the_stored_errors():
    error_table = tool("error_table")
    stored = json.loads(error_table.STORED.read_text(encoding="utf-8"))
    (written,) = error_table.BLOCK.findall(error_table.README.read_text(encoding="utf-8"))
    assert written == error_table.table(stored), "the table of errors is out of date: run `make figures`"


@pytest.mark.skipif(not (RESULTS / "loads-closed.h5").exists(), reason="no results of the sample campaign")
def test_stored_errors_are_those_of_the_results():
    error_table = tool("error_table")
    if Path((RESULTS / "inputs.txt").read_text(encoding="utf-8").split()[-1]).parent.name != "sample_data":
        pytest.skip("the results are those of another campaign")
    stored = json.loads(error_table.STORED.read_text(encoding="utf-8"))
    for method, errors in error_table.errors_of(RESULTS).items():
        assert errors == pytest.approx(stored[method], rel=0.05), f"{method}: run `make figures`"


def test_updated_model_is_the_best_of_the_table():
    stored = json.loads(tool("error_table").STORED.read_text(encoding="utf-8"))
    for component, error in stored["closed"].items():
        assert error <= min(stored[method][component] for method in ("static", "computed", "rigid", "transfer"))


def test_table_of_benchmarks_is_that_of_the_stored_results():
    (written,) = table.BLOCK.findall(table.README.read_text(encoding="utf-8"))
    assert written == table.table(), "the table of benchmarks is out of date: run `make bench`"


def test_version_is_the_same_everywhere():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert str(citation["version"]) == balance_cli.__version__
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    heads = re.findall(r"^## (.*)$", changes, re.MULTILINE)
    assert heads[0] == f"{balance_cli.__version__} - {citation['date-released']}"


def test_license_is_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["license"] == "BSD-3-Clause"
    assert (ROOT / "LICENSE").read_text(encoding="utf-8").startswith("BSD 3-Clause License")
    assert "license: BSD-3-Clause" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_example_of_the_interface(monkeypatch):
    monkeypatch.chdir(ROOT)
    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    example = re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)[1]
    names = {}
    exec(compile(example, "docs/api.md", "exec"), names)
    (printed,) = re.findall(r"^```text\n(Hub loads.*?)^```", text, re.DOTALL | re.MULTILINE)
    assert repr(names["loads"]) == printed.strip()
    assert len(names["usable"]) > 0


def test_pages_are_listed():
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    assert [page.name for page in ROOT.glob("docs/*.md") if page.name != "README.md" and page.name not in index] == []
