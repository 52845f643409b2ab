"""YAML files that users write: read safely, with their size bounded and every fault named by its line."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from balance_cli.io.errors import UserError

MOST_BYTES = 4 * 2**20
"""Of a file: some hundred times a geometry of 25 channels; read in seconds."""
MOST_ENTRIES = 50_000
"""Values, lists and mappings of a file, aliases expanded: some hundred times those of a geometry of 25 channels."""
PLAIN_TAGS = {
    f"tag:yaml.org,2002:{name}" for name in ("str", "int", "float", "bool", "null", "map", "seq", "timestamp")
}
READ_DIFFERENTLY = ("\t", "?")
"""What libyaml takes in places where PyYAML's own parser refuses it: all that differed in 5000 changed geometries."""
BAD_VALUE_ERRORS = (ValueError, TypeError, LookupError, AttributeError, OverflowError)
"""What the constructors of PyYAML raise for a value that does not fit its tag."""


class _Loader(yaml.SafeLoader):
    """The safe loader, which refuses duplicate keys, bounds aliases and reads 1e-3 as a number as in YAML 1.2."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._entries = 0
        self._entries_of: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node and count its entries; an alias counts as often as it is used."""
        is_alias, before = self.check_event(yaml.AliasEvent), self._entries
        mark: yaml.Mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
        node = super().compose_node(parent, index)
        if is_alias and id(node) not in self._entries_of:
            raise yaml.MarkedYAMLError(problem="an alias is within its own anchor", problem_mark=mark)
        self._entries += self._entries_of[id(node)] if is_alias else 1
        if self._entries > MOST_ENTRIES:
            raise yaml.MarkedYAMLError(problem=f"more than {MOST_ENTRIES} entries", problem_mark=mark)
        if not is_alias:
            self._entries_of[id(node)] = self._entries - before
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """Construct a value of a plain type; a tag that its value does not fit is an error at its line."""
        if node.tag not in PLAIN_TAGS:
            raise yaml.MarkedYAMLError(problem=f"the tag `{node.tag}` is not allowed", problem_mark=node.start_mark)
        try:
            return super().construct_object(node, deep)
        except BAD_VALUE_ERRORS as error:
            problem = f"`{node.value}` is not a value of the type `{node.tag.rpartition(':')[2]}`"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark) from error

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping whose keys differ."""
        if not isinstance(node, yaml.MappingNode):
            raise yaml.MarkedYAMLError(problem="keys with values were expected", problem_mark=node.start_mark)
        keys: set[str] = set()
        for key_node, _ in node.value:
            key = str(getattr(key_node, "value", key_node))
            if key in keys:
                line = key_node.start_mark.line + 1
                raise UserError(f"key `{key}` is given twice", place=f"line {line}", remedy="Remove one of them")
            keys.add(key)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


class _LibyamlLoader(_Loader):
    """The same loader with the parser of libyaml: a geometry of seven cells takes 2.4 ms in place of 19."""

    def __init__(self, stream: str) -> None:
        from yaml._yaml import CParser

        super().__init__("")
        parser = CParser(stream)
        for name in ("check_event", "peek_event", "get_event"):
            setattr(self, name, getattr(parser, name))


def _load(text: str) -> Any:
    """The content of a YAML text.

    What libyaml refuses is read again, so that messages are those of PyYAML's own parser.
    """
    if yaml.__with_libyaml__ and not any(map(text.__contains__, READ_DIFFERENTLY)):
        try:
            return yaml.load(text, _LibyamlLoader)
        except (yaml.YAMLError, RecursionError, UserError, *BAD_VALUE_ERRORS):
            pass
    return yaml.load(text, _Loader)


def read_yaml(path: Path, expected: str) -> Any:
    """The content of a YAML file as dicts, lists and scalars; `expected` names what should be in it, as `a geometry`.

    Raises UserError, without the file's name, where the file cannot be read, is too large, or is not YAML.
    """
    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise UserError(f"has {size} bytes, too many for {expected}", remedy=f"Give the YAML file of {expected}")
        return _load(path.read_text(encoding="utf-8"))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f"line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = _shorten(str(error.problem))
        raise UserError(f"is not YAML: {problem}", place=place, remedy="Correct the syntax there") from error
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, *BAD_VALUE_ERRORS) as error:
        fault = f"is not YAML: {_shorten(str(error))}"
        raise UserError(fault, remedy=f"Give the YAML file of {expected}") from error
    except OSError as error:
        raise UserError(f"cannot be read: {error.strerror}", remedy="Check its name and permissions") from error


def _shorten(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= 300 else f"{line[:297]}..."
