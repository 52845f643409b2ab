"""The import graph of the package by its top-level parts, and the sizes of modules and functions (`make figures`).

    python tools/import_graph.py [--save FILE]

Draws `docs/pictures/imports-before.svg` from the graph stored in `docs/pictures/imports-before.json`, and
`docs/pictures/imports.svg` from the sources; writes the table of `docs/architecture.md`. `--save` stores the graph of
the sources instead. A part is a package or a module directly below `balance_cli`; an import counts wherever it stands.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
PACKAGE = "balance_cli"
PICTURES = ROOT / "docs" / "pictures"
BEFORE = PICTURES / "imports-before.json"
ARCHITECTURE = ROOT / "docs" / "architecture.md"
BLOCK = re.compile(r"(?<=<!-- sizes -->\n).*?(?=<!-- end of sizes -->)", re.DOTALL)
NOT_DRAWN = ("__init__", "__main__")
"""The entry points: they import by name at run time, or one part only."""
DOWN, UPWARD, BOX = "#8794a6", "#c0392b", "#eef2f7"


@dataclass(frozen=True)
class ImportGraph:
    """Parts with their files and lines; imports between parts; sizes of all modules and functions, in lines."""

    files: dict[str, int]
    lines: dict[str, int]
    imports: dict[str, dict[str, int]]
    module_sizes: list[int]
    function_sizes: list[int]


def read_package(folder: Path) -> ImportGraph:
    """The graph of the package in a folder, from its sources."""
    paths = sorted(folder.rglob("*.py"))
    parts = {_part(path.relative_to(folder)) for path in paths}
    graph = ImportGraph(dict.fromkeys(parts, 0), dict.fromkeys(parts, 0), {part: {} for part in parts}, [], [])
    for path in paths:
        text, part = path.read_text(encoding="utf-8"), _part(path.relative_to(folder))
        tree = ast.parse(text)
        size = len(text.splitlines())
        graph.files[part] += 1
        graph.lines[part] += size
        graph.module_sizes.append(size)
        graph.function_sizes.extend(_function_sizes(tree))
        for target in _imported_parts(tree, parts):
            if target != part:
                graph.imports[part][target] = graph.imports[part].get(target, 0) + 1
    return graph


def _part(path: Path) -> str:
    return path.parts[0].removesuffix(".py")


def _imported_parts(tree: ast.Module, parts: set[str]) -> Iterator[str]:
    """The part that each import statement of a module reads from."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module == PACKAGE:
            yield from (alias.name for alias in node.names if alias.name in parts)
        elif isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(f"{PACKAGE}."):
            yield node.module.split(".")[1]
        elif isinstance(node, ast.Import):
            yield from (alias.name.split(".")[1] for alias in node.names if alias.name.startswith(f"{PACKAGE}."))


def _function_sizes(tree: ast.Module) -> Iterator[int]:
    """Lines of each function, without decorators and docstring."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            first = node.body[0]
            docstring = first if ast.get_docstring(node, clean=False) is not None else None
            yield node.end_lineno - node.lineno + 1 - (docstring.end_lineno - docstring.lineno + 1 if docstring else 0)


# ---- layers ----------------------------------------------------------------------------------------------------------


def cycles(graph: ImportGraph) -> list[set[str]]:
    """Sets of parts that import each other, directly or through others."""
    reach = {part: _reachable(graph, part) for part in graph.imports}
    sets = {frozenset({part} | {other for other in reach[part] if part in reach[other]}) for part in reach}
    return sorted((set(members) for members in sets if len(members) > 1), key=len, reverse=True)


def _reachable(graph: ImportGraph, part: str) -> set[str]:
    seen, todo = set(), [part]
    while todo:
        for target in graph.imports[todo.pop()]:
            if target not in seen:
                seen.add(target)
                todo.append(target)
    return seen


def layers(graph: ImportGraph) -> dict[str, int]:
    """Layer of each part, 0 at the bottom: one above the highest part that it imports, cycles aside."""
    together = {part: members for members in cycles(graph) for part in members}
    level: dict[str, int] = {}

    def of(part: str) -> int:
        if part not in level:
            members = together.get(part, {part})
            below = {target for member in members for target in graph.imports[member]} - members
            height = 1 + max((of(target) for target in below), default=-1)
            level.update(dict.fromkeys(members, height))
        return level[part]

    for part in graph.imports:
        of(part)
    return level


# ---- drawing ---------------------------------------------------------------------------------------------------------


def draw(graph: ImportGraph, path: Path, title: str) -> None:
    """Parts as boxes in layers; imports downward in gray, those between parts of a cycle in red."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": PACKAGE, "font.family": "sans-serif"})
    from matplotlib import pyplot

    drawn = [part for part in graph.imports if part not in NOT_DRAWN]
    level = {part: height for part, height in layers(graph).items() if part in drawn}
    rows = _rows(graph, level)
    width = 1.7 * max(len(row) for row in rows)
    figure, axes = pyplot.subplots(figsize=(max(width, 7.0), 0.95 * len(rows) + 0.5))
    place = {part: (_across(row, i), y) for y, row in enumerate(rows) for i, part in enumerate(row)}
    together = cycles(graph)
    for part in drawn:
        for target, count in graph.imports[part].items():
            if target in place:
                in_cycle = any(part in members and target in members for members in together)
                _arrow(axes, place[part], place[target], count, in_cycle)
    for part, (x, y) in place.items():
        files = graph.files[part]
        label = f"{part}\n{files} file{'s' * (files > 1)}, {graph.lines[part]} lines"
        style = {"boxstyle": "round,pad=0.35", "facecolor": BOX, "edgecolor": "#2c3e50"}
        axes.text(x, y, label, ha="center", va="center", fontsize=8, bbox=style, zorder=3)
    axes.set_xlim(-1.0, 1.0)
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.set_axis_off()
    axes.set_title(title, fontsize=10)
    figure.savefig(path, bbox_inches="tight", metadata={"Date": None})
    pyplot.close(figure)


def _rows(graph: ImportGraph, level: Mapping[str, int], most: int = 9) -> list[list[str]]:
    """Parts of each layer from the bottom, a layer of many parts in several rows."""
    rows = []
    for height in sorted(set(level.values())):
        members = sorted(part for part in level if level[part] == height)
        count = -(-len(members) // most)
        rows += [members[i::count] for i in range(count)]
    return rows


def _across(row: Sequence[str], i: int) -> float:
    return 1.9 * ((i + 0.5) / len(row) - 0.5)


def _arrow(axes: object, start: tuple[float, float], end: tuple[float, float], count: int, in_cycle: bool) -> None:
    style = {
        "arrowstyle": "-|>",
        "color": UPWARD if in_cycle else DOWN,
        "linewidth": 0.5 + 0.25 * np.log2(count),
        "alpha": 0.9 if in_cycle else 0.6,
        "shrinkA": 14,
        "shrinkB": 14,
        "connectionstyle": "arc3,rad=0.08",
    }
    axes.annotate("", xy=end, xytext=start, arrowprops=style, zorder=1)


# ---- table -----------------------------------------------------------------------------------------------------------


def table(graphs: Mapping[str, ImportGraph]) -> str:
    """Counts and sizes of the graphs, as a Markdown table with one column each."""
    rows = {
        "files": lambda graph: sum(graph.files.values()),
        "modules and packages at the top": lambda graph: len(graph.files),
        "layers": lambda graph: 1 + max(layers(graph).values()),
        "parts in import cycles": lambda graph: sum(len(members) for members in cycles(graph)),
        "lines of a module: median, 90 %, largest": lambda graph: _percentiles(graph.module_sizes),
        "lines of a function: median, 90 %, largest": lambda graph: _percentiles(graph.function_sizes),
        "functions over 40 lines": lambda graph: sum(size > 40 for size in graph.function_sizes),
    }
    head = f"| | {' | '.join(graphs)} |\n|---|{'---|' * len(graphs)}\n"
    return head + "".join(
        f"| {name} | {' | '.join(str(value(graph)) for graph in graphs.values())} |\n" for name, value in rows.items()
    )


def _percentiles(sizes: Sequence[int]) -> str:
    return f"{np.median(sizes):.0f}, {np.percentile(sizes, 90):.0f}, {max(sizes)}"


def main() -> None:
    """Draw both graphs and write the table, or store the graph of the sources."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--save", type=Path, metavar="FILE", help="store the graph of the sources, and draw nothing")
    parser.add_argument("--package", type=Path, default=ROOT / PACKAGE, help="folder of the package")
    arguments = parser.parse_args()
    now = read_package(arguments.package)
    if arguments.save:
        arguments.save.write_text(json.dumps(asdict(now), sort_keys=True) + "\n", encoding="utf-8")
        return
    before = ImportGraph(**json.loads(BEFORE.read_text(encoding="utf-8")))
    draw(before, PICTURES / "imports-before.svg", "Version 0.1: red arrows belong to import cycles")
    draw(now, PICTURES / "imports.svg", "Imports between the packages")
    sizes = table({"version 0.1": before, "now": now})
    text = ARCHITECTURE.read_text(encoding="utf-8")
    ARCHITECTURE.write_text(BLOCK.sub(lambda _: sizes, text), encoding="utf-8")
    print(sizes, end="")


if __name__ == "__main__":
    main()
