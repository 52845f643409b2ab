"""One name for one thing, in standard terms: old words do not come back, renamed options and keys still work."""

from __future__ import annotations

from pathlib import Path

import click
import pytest

from balance_cli.cli import balance
from tests.support.vocabulary import (
    DEFINITIONS,
    FIXED_NAMES,
    code_files,
    identifier_offence,
    identifier_parts,
    offences_of_code,
    offences_of_prose,
    phrase_offences,
    prose_files,
)

RENAMED_OPTIONS = {
    ("reduce", "--loads-as"): ("--load-model", "random"),
    ("calibrate", "--direct"): ("--non-iterative", None),
    ("simulate", "--double"): ("--float64", None),
    ("simulate", "--draw"): ("--sample-tolerances", None),
}
"""(command, former name): (name, a value where the option takes one)."""
REQUIRED = {
    "reduce": ["--calibration", "c.h5", "-o", "l.h5", "run.h5"],
    "calibrate": ["-g", "g.yaml", "-o", "c.h5", "run.h5"],
    "simulate": ["-g", "g.yaml", "-o", "folder"],
}
"""What a call of the command needs besides."""


@pytest.mark.parametrize("path", sorted(set(code_files()) - DEFINITIONS), ids=str)
def test_no_old_word_in_the_code(path):
    assert list(offences_of_code(path)) == []


@pytest.mark.parametrize("path", list(prose_files()), ids=str)
def test_no_old_word_in_the_manual(path):
    assert list(offences_of_prose(path)) == []


def test_every_fixed_name_has_its_reason():
    assert all(len(reason.split()) > 3 for reason in FIXED_NAMES.values())


def test_identifiers_are_taken_apart():
    assert identifier_parts("GageModel_of2Jets") == ["gage", "model", "of", "jets"]
    assert identifier_offence("_GageModel") and identifier_offence("dual_jet") and identifier_offence("suspects")
    assert not identifier_offence("engaged") and not identifier_offence("MainsPickup")
    assert identifier_offence("seeds", Path("balance_cli/a.py")) and not identifier_offence(
        "seeds", Path("studies/a.py")
    )
    assert identifier_offence("test_the_surplus_equations_agree")


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("a fault\n    of ours", ["a fault of ours"]),
        ("# in its loading\n# sequence", ["loading # sequence"]),
        ("a strain gage of the effect mains-pickup", []),
        ("Surplus equations", ["Surplus"]),
        ("the closed model", ["closed model"]),
    ],
)
def test_phrases_are_found_across_lines(text, found):
    assert [words for _, words, _ in phrase_offences(text)] == found


def command_of(name: str) -> click.Command:
    return balance.get_command(click.Context(balance), name)


def parameters_of(command: str, words: list[str]) -> dict[str, object]:
    """What the function of a command would be called with."""
    return command_of(command).make_context(command, [*words, *REQUIRED[command]]).params


@pytest.mark.parametrize(("command", "former"), RENAMED_OPTIONS)
def test_a_renamed_option_still_works_with_a_warning(command, former, capsys):
    current, value = RENAMED_OPTIONS[command, former]
    values = [] if value is None else [value]
    expected = parameters_of(command, [current, *values])
    assert capsys.readouterr().err == ""
    assert parameters_of(command, [former, *values]) == expected != parameters_of(command, [])
    assert capsys.readouterr().err == f"balance: warning: {former} is deprecated; use {current}\n"


@pytest.mark.parametrize(("command", "former"), RENAMED_OPTIONS)
def test_a_former_name_is_hidden(command, former):
    options = {name: item for item in command_of(command).params for name in item.opts}
    assert options[former].hidden and not options[RENAMED_OPTIONS[command, former][0]].hidden


def test_every_hidden_option_is_a_former_name_that_is_listed():
    hidden = {
        (name, item.opts[0])
        for name in balance.list_commands(click.Context(balance))
        for item in command_of(name).params
        if getattr(item, "hidden", False)
    }
    assert hidden == set(RENAMED_OPTIONS)
