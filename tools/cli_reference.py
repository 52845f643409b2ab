"""The command reference docs/commands.md, written from the commands themselves (`make docs`)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click

from balance_cli.cli import balance

TARGET = Path(__file__).parents[1] / "docs" / "commands.md"
HEAD = """# Commands

<!-- Written by `make docs` from the commands themselves; changes made here are lost. -->

Every command is called as `balance COMMAND`, or as `python -m balance_cli COMMAND`. `RUN...` takes any mixture of
kinds: a command uses those that it needs and says which it left out. What the files hold is in [files](files.md), every
key of a `--json` summary in [JSON summaries](json.md).
"""
EFFECTS_HEAD = """## Effects of simulate

`--effect NAME[@PLACE[,PLACE]]` with `--parameter [EFFECT:]NAME=VALUE`, or `effects` in the geometry. A parameter that
is not given does nothing.
"""


def reference() -> str:
    """The whole page."""
    root = click.Context(balance, info_name="balance")
    names = balance.list_commands(root)
    links = " ".join(f"[{name}](#balance-{name})" for name in names)
    sections = [_command(root, name) for name in names]
    effects = [_effects()] if "simulate" in names else []
    return "\n".join([HEAD, links + "\n", *sections, *effects])


def _command(root: click.Context, name: str) -> str:
    command = balance.get_command(root, name)
    assert command is not None
    arguments = [item for item in command.params if isinstance(item, click.Argument)]
    options = [item for item in command.params if isinstance(item, click.Option) and not item.hidden]
    required = [f"{item.opts[0]} {_value(item)}".strip() for item in options if item.required]
    usage = " ".join(["balance", name, "[OPTIONS]", *required, *(_place(item) for item in arguments)])
    rows = [f"| {_names(item)} | {_meaning(item)} |" for item in sorted(options, key=_is_common_option)]
    table = ["| option | meaning |", "|---|---|", *rows, "| `-h`, `--help` | Show the help and exit. |"]
    return "\n".join([f"## balance {name}", "", "```", usage, "```", "", *_paragraphs(command.help), *table, ""])


def _is_common_option(option: click.Option) -> bool:
    """The options that every command has go last."""
    return option.name in ("json_path", "verbose")


def _paragraphs(text: str | None) -> Iterator[str]:
    for paragraph in (text or "").split("\n\n"):
        yield " ".join(paragraph.split())
        yield ""


def _place(argument: click.Argument) -> str:
    shown = argument.metavar or (argument.name or "").upper()
    return shown if argument.required else f"[{shown}]"


def _names(option: click.Option) -> str:
    value = _value(option)
    *short, longest = option.opts
    names = [*short, f"{longest} {value}".strip()]
    return ", ".join(f"`{name}`" for name in names).replace("|", r"\|")


def _value(option: click.Option) -> str:
    """What stands for the value of an option."""
    if option.is_flag:
        return ""
    if option.metavar:
        return option.metavar
    if isinstance(option.type, click.Choice):
        return "|".join(str(choice) for choice in option.type.choices)
    return option.type.name.split()[0].upper()


def _meaning(option: click.Option) -> str:
    text = " ".join((option.help or "").split())
    notes = [*_range(option.type), *_default(option), *(["required"] if option.required else [])]
    return (f"{text} ({'; '.join(notes)})" if notes else text).replace("|", r"\|")


def _range(kind: click.ParamType) -> Iterator[str]:
    if isinstance(kind, click.IntRange | click.FloatRange):
        if kind.min is not None:
            yield f"from {kind.min:g}" if kind.max is None else f"{kind.min:g} to {kind.max:g}"
        elif kind.max is not None:
            yield f"up to {kind.max:g}"


def _default(option: click.Option) -> Iterator[str]:
    if option.show_default and not option.is_flag:
        yield f"default `{option.default}`"


def _effects() -> str:
    from balance_cli.simulation.extensions.library import EXTENSIONS, parameter_names

    blocks = [EFFECTS_HEAD]
    for name, kind in EXTENSIONS.items():
        parameters = ", ".join(f"`{parameter}`" for parameter in parameter_names(kind))
        blocks += [f"### {name}\n", *_paragraphs(_strip_indentation(kind.__doc__)), f"Parameters: {parameters}.\n"]
    return "\n".join(blocks)


def _strip_indentation(doc: str | None) -> str:
    return "\n".join(line.strip() for line in (doc or "").strip().splitlines())


def main() -> None:
    """Write the page."""
    TARGET.write_text(reference(), encoding="utf-8")


if __name__ == "__main__":
    main()
