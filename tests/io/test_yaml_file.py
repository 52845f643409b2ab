"""YAML files: what does not fit its tag, is too large, or refers to itself, is refused with its line."""

from pathlib import Path

import pytest
import yaml

from balance_cli.io import yaml_file
from balance_cli.io.errors import UserError
from balance_cli.io.yaml_file import MOST_BYTES, read_yaml

BOMB = "a0: &a0 [1, 1]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 9))


def content_of(tmp_path: Path, text: str) -> object:
    path = tmp_path / "file.yaml"
    path.write_text(text, encoding="utf-8")
    return read_yaml(path, "a plan")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('a: !!float ""', "not a value of the type `float`"),
        ('a: !!int ""', "not a value of the type `int`"),
        ("a: !!bool maybe", "not a value of the type `bool`"),
        ("a: !!timestamp soon", "not a value of the type `timestamp`"),
        ("a: 2001-99-99", "not a value of the type `timestamp`"),
        ("a: !!map [1, 2]", "keys with values were expected"),
        ("a: !!set {1, 2}", "not allowed"),
        ("a: !!python/object/apply:os.getcwd []", "not allowed"),
        ("a: &a [*a]", "within its own anchor"),
        (BOMB, "more than 50000 entries"),
        ("a:\n" + "- 1\n" * 50_001, "more than 50000 entries"),
    ],
)
def test_the_line_of_a_fault_is_named(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(UserError, match=words) as caught:
        content_of(tmp_path, text)
    assert caught.value.place.startswith("line ")
    assert caught.value.remedy


@pytest.mark.parametrize("text", ["a: " + "[" * 20_000, "a: b\0", "# " + "x" * MOST_BYTES])
def test_what_has_no_line_is_refused_all_the_same(tmp_path: Path, text: str) -> None:
    with pytest.raises(UserError) as caught:
        content_of(tmp_path, text)
    assert caught.value.remedy


def test_aliases_and_merged_keys_are_read(tmp_path: Path) -> None:
    assert content_of(tmp_path, "a: &a {x: 1e-3}\nb: [*a, *a]\nc: {<<: *a, y: 2}\n") == {
        "a": {"x": 1e-3},
        "b": [{"x": 1e-3}] * 2,
        "c": {"x": 1e-3, "y": 2},
    }


def outcome(tmp_path: Path, text: str) -> str:
    try:
        return repr(content_of(tmp_path, text))
    except UserError as error:
        return str(error)


@pytest.mark.skipif(not yaml.__with_libyaml__, reason="PyYAML without libyaml")
@pytest.mark.parametrize(
    "text",
    [
        "a: 1e-3\nb: .5\nc: [1, 2, {x: y}] # c\nd: &d 'e'\nf: *d\n",
        "a: >\n  u\n  v\n\n  w\nb: |\n  x\n   y\n",
        "a: 1\nb: 2\na: 3\n",
        "a: b: c\n",
        "a:\tb\n",
        "{ab?: 1}\n",
        "[1, 2\n",
        "a: %x\n",
        "a: \x07\n",
        "",
    ],
)
def test_libyaml_reads_what_the_parser_in_python_reads(tmp_path: Path, text: str, monkeypatch: pytest.MonkeyPatch):
    found = outcome(tmp_path, text)
    monkeypatch.setattr(yaml, "__with_libyaml__", False)
    assert outcome(tmp_path, text) == found


@pytest.mark.skipif(not yaml.__with_libyaml__, reason="PyYAML without libyaml")
def test_a_sound_file_is_parsed_by_libyaml_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(yaml_file._Loader, "fetch_more_tokens", None)
    assert content_of(tmp_path, "a: [1, 2]\n") == {"a": [1, 2]}
