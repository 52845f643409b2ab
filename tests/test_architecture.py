"""The layers of the package, the sizes of its modules and functions, and what the manual says of them."""

import re
import tomllib
from pathlib import Path

import pytest

from tests.support.tools import tool

ROOT = Path(__file__).parents[1]
MAX_MODULE_LINES = 300
MAX_FUNCTION_LINES = 40


@pytest.fixture(scope="module")
def graph():
    return tool("import_graph").read_package(ROOT / "balance_cli")


def contract_layers():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    return [[name.strip() for name in layer.split("|")] for layer in contracts[0]["layers"]]


def test_imports_go_downward(graph):
    rank = {name: i for i, layer in enumerate(contract_layers()) for name in layer}
    upward = [(part, target) for part in rank for target in graph.imports[part] if rank[target] <= rank[part]]
    assert upward == []
    assert tool("import_graph").cycles(graph) == []


def test_table_of_layers_is_that_of_the_contract():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").partition("## Layers")[2]
    rows = re.findall(r"^\| [a-z, ]+ \| (`[a-z]+`(?:, `[a-z]+`)*) \|", text, re.MULTILINE)
    assert [sorted(re.findall(r"`(\w+)`", row)) for row in rows] == [sorted(layer) for layer in contract_layers()]


def test_modules_and_functions_are_small(graph):
    assert max(graph.module_sizes) <= MAX_MODULE_LINES
    assert max(graph.function_sizes) <= MAX_FUNCTION_LINES


def test_graph_of_a_package(tmp_path):
    sources = {
        "a.py": "from balance_cli.b import f\nfrom balance_cli import c\n",
        "b/__init__.py": "def f():\n    '''Text\n\n    of the docstring.'''\n    import balance_cli.a\n",
        "c.py": "",
    }
    for name, text in sources.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    import_graph = tool("import_graph")
    graph = import_graph.read_package(tmp_path)
    assert graph.imports == {"a": {"b": 1, "c": 1}, "b": {"a": 1}, "c": {}}
    assert graph.function_sizes == [2]
    assert import_graph.cycles(graph) == [{"a", "b"}]
    assert import_graph.layers(graph) == {"a": 1, "b": 1, "c": 0}
