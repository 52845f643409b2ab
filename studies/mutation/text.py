"""Changes to text files: YAML by its nodes and its lines, tables by their cells, separators and encoding."""

from __future__ import annotations

import copy
import random
import re
from collections.abc import Callable
from typing import Any

import yaml

from studies.mutation.values import TEXTS, any_number, any_plain_value

YAML_TAGS = ("!!float", "!!int", "!!bool", "!!timestamp", "!!binary", "!!map", "!!seq", "!!python/name:os.system", "!x")


def mutate_yaml(data: bytes, rng: random.Random) -> bytes:
    """The file with nodes changed (two of three cases), or its lines or bytes."""
    if rng.random() < 0.33:
        return _change_lines(data, rng, YAML_LINES)
    content = copy.deepcopy(yaml.safe_load(data))
    for _ in range(rng.randint(1, 3)):
        try:
            _change_node(content, rng)
        except (TypeError, ValueError, KeyError, IndexError, AttributeError, OverflowError):
            continue
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True).encode()


def _nodes(content: Any) -> list[tuple[Any, Any]]:
    """Each container with one of its keys or indices."""
    pairs = []
    keys = list(content) if isinstance(content, dict) else range(len(content)) if isinstance(content, list) else ()
    for key in keys:
        pairs.append((content, key))
        pairs += _nodes(content[key])
    return pairs


def _change_node(content: Any, rng: random.Random) -> None:
    container, key = rng.choice(_nodes(content))
    value = container[key]
    kind = rng.choice(("value", "value", "remove", "rename", "scale", "scale", "list", "twice", "text", "other"))
    if kind == "value":
        container[key] = any_plain_value(rng)
    elif kind == "remove":
        del container[key]
    elif kind == "rename":
        container[rng.choice((f"{key}x", str(key)[:-1], 7))] = container.pop(key)
    elif kind == "scale":
        container[key] = value * rng.choice((-1, 0, 1e-3, 1e3, 1e6, 1e300, float("nan")))
    elif kind == "list":
        container[key] = [value] * rng.choice((1, 2, 50))
    elif kind == "twice":
        container.append(copy.deepcopy(value))
    elif kind == "text":
        container[key] = f"{value} kg"
    else:
        other, other_key = rng.choice(_nodes(content))
        container[key] = copy.deepcopy(other[other_key])


def mutate_table(data: bytes, rng: random.Random) -> bytes:
    """The table with cells changed (half of the cases), or its lines, separators, encoding or bytes."""
    if rng.random() < 0.5:
        return _change_lines(data, rng, TABLE_LINES)
    rows = [line.split(",") for line in data.decode("utf-8", "replace").splitlines()]
    for _ in range(rng.randint(1, 4)):
        row = rng.choice(rows)
        column = rng.randrange(len(row))
        kind = rng.choice(("number", "text", "remove", "add", "swap", "scale"))
        if kind == "number":
            row[column] = str(any_number(rng))
        elif kind == "text":
            row[column] = rng.choice(TEXTS)
        elif kind == "remove":
            del row[column]
        elif kind == "add":
            row.insert(column, rng.choice(("", "0", "x")))
        elif kind == "swap":
            row.reverse()
        else:
            row[column] += rng.choice(("e9", "e-9", "e300", "e-300", " V", "%"))
        if not row:
            row.append("")
    return "\n".join(",".join(row) for row in rows).encode() + b"\n"


# ---- lines and bytes -------------------------------------------------------------------------------------------------

Change = Callable[[bytes, random.Random], bytes]


def _change_lines(data: bytes, rng: random.Random, changes: tuple[Change, ...]) -> bytes:
    for _ in range(rng.randint(1, 2)):
        if data:
            data = rng.choice(changes)(data, rng)
    return data


def change_lines(data: bytes, rng: random.Random) -> bytes:
    """A text of any kind with its lines or bytes changed."""
    return _change_lines(data, rng, COMMON)


def _edit_lines(edit: Callable[[list[bytes], random.Random], None]) -> Change:
    def change(data: bytes, rng: random.Random) -> bytes:
        lines = data.split(b"\n")
        edit(lines, rng)
        return b"\n".join(lines)

    return change


def _flip_bytes(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        changed[rng.randrange(len(changed))] = rng.choice((rng.randrange(256), 0, 10, 34, 44))
    return bytes(changed)


def _insert_bytes(data: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(data))
    return (
        data[:start]
        + rng.choice((b'"', b"\x00", b"\t", b"&a *a", b"[[[[", b"{", b"\xff\xfe", b": ", b"- "))
        + data[start:]
    )


def _add_tag(data: bytes, rng: random.Random) -> bytes:
    places = [match.end() for match in re.finditer(rb": ", data)] or [0]
    place = rng.choice(places)
    return data[:place] + rng.choice(YAML_TAGS).encode() + b" " + data[place:]


def _edit_place(edit: Callable[[list[bytes], int], None]) -> Change:
    return _edit_lines(lambda lines, rng: edit(lines, rng.randrange(len(lines))))


COMMON: tuple[Change, ...] = (
    _flip_bytes,
    _insert_bytes,
    _edit_place(lambda lines, i: lines.pop(i) and None),
    _edit_place(lambda lines, i: lines.insert(i, lines[i])),
    _edit_place(lambda lines, i: lines.insert(0, lines.pop(i))),
    lambda data, rng: data[: rng.randrange(len(data))],
    lambda data, rng: data.decode("utf-8", "replace").encode("utf-16"),
    lambda data, rng: b"\xef\xbb\xbf" + data,
    lambda data, rng: data.replace(b"\n", rng.choice((b"\r\n", b"\r", b"\n\n"))),
)
YAML_LINES: tuple[Change, ...] = (
    *COMMON,
    _add_tag,
    _add_tag,
    lambda data, rng: data + data,
    lambda data, rng: data + b"extra: " + b"[" * rng.choice((3, 3000)) + b"\n",
    lambda data, rng: data.replace(b"  ", b"\t", 1),
)
TABLE_LINES: tuple[Change, ...] = (
    *COMMON,
    lambda data, rng: data.replace(b",", rng.choice((b";", b"\t", b" ", b"|", b",,"))),
    lambda data, rng: data.replace(b".", b","),
    lambda data, rng: data.replace(b",", b";").replace(b".", b","),
    lambda data, rng: data * rng.choice((2, 50)),
    lambda data, rng: data.replace(b",", b',"', 1),
    lambda data, rng: data + b"x" * 200_000 + b"\n",
    lambda data, rng: data.decode("utf-8", "replace").replace("m", "µ", 1).encode("latin-1", "replace"),
)
