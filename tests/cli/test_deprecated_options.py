"""Former names of options: understood for one release, with a warning on stderr."""

from __future__ import annotations

from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from balance_cli.cli import balance
from balance_cli.cli.options import deprecated_option, non_default_options

RENAMED = {("reduce", "--loads-as"): "--load-model", ("simulate", "--double"): "--float64"}


@click.command()
@click.option("--kind", "sort", type=click.Choice(["a", "b"]), default="a")
@deprecated_option("--sort", "--kind", "sort", type=click.Choice(["a", "b"]))
@click.option("--wide", "broad", is_flag=True)
@deprecated_option("--broad", "--wide", "broad", is_flag=True)
def call(sort, broad):
    click.echo(f"{sort} {broad} {non_default_options(click.get_current_context())}")


@pytest.mark.parametrize(
    ("words", "output"),
    [
        ((), "a False {}"),
        (("--sort", "b"), "b False {'sort': 'b'}"),
        (("--kind", "b", "--broad"), "b True {'sort': 'b', 'broad': True}"),
        (("--kind", "b", "--sort", "a"), "b False {'sort': 'b'}"),
    ],
)
def test_the_former_name_sets_the_same_parameter(words, output):
    result = CliRunner().invoke(call, words)
    assert result.exit_code == 0 and result.stdout.strip() == output
    former = [word for word in words if word in ("--sort", "--broad")]
    assert result.stderr.count("is deprecated") == len(former)
    assert all(f"balance: warning: {word} is deprecated; use" in result.stderr for word in former)


def test_the_former_name_refuses_what_the_current_one_refuses():
    result = CliRunner().invoke(call, ["--sort", "c"])
    assert result.exit_code == 2 and "'c' is not one of 'a', 'b'" in result.stderr


def test_an_error_names_the_option_that_was_typed():
    """Who types `--loads-as` looks for it in the message."""
    folder = Path(__file__).parents[1] / "io"
    known = ("--calibration", f"{folder}/old_artefacts/calibration-0.2.h5")
    model = ("--model", f"{folder}/old_artefacts/model-0.2.h5")
    words = ["reduce", *known, *model, f"{folder}/old_files/check.h5", "-o", "loads.csv"]
    for option in ("--loads-as", "--load-model"):
        said = CliRunner().invoke(balance, [*words, option, "free"]).stderr
        assert f"balance: error: {option}: a load model applies to filters and smoothers only" in said


@pytest.mark.parametrize(("command", "former"), RENAMED)
def test_former_names_are_hidden(command, former):
    options = {name: item for item in balance.get_command(None, command).params for name in item.opts}
    assert options[former].hidden and not options[RENAMED[command, former]].hidden
    assert former not in CliRunner().invoke(balance, [command, "--help"]).output
