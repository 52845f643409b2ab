"""The commands of `balance`, one file each, loaded when they are needed."""

from __future__ import annotations

import importlib
import importlib.util

import click

from balance_cli.cli.errors import BalanceCommand
from balance_cli.io.version import __version__

COMMANDS = (
    "import",
    "import-frf",
    "calibrate",
    "apply",
    "sweep-tf",
    "identify",
    "diagnose",
    "reduce",
    "merge",
    "trend",
    "modes",
    "plan",
    "simulate",
    "check",
    "report",
    "run",
    "watch",
    "export",
)
MODULES = {"import": "import_runs"}
"""Modules of commands whose name is a word of Python."""


def _module_name(name: str) -> str:
    return f"{__name__}.{MODULES.get(name, name.replace('-', '_'))}"


class LazyGroup(BalanceCommand, click.Group):
    """A group that imports a command's module only when that command is asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The names of the commands, in the order in which a campaign uses them."""
        return [name for name in COMMANDS if importlib.util.find_spec(_module_name(name))]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command of this name, imported now."""
        if cmd_name not in self.list_commands(ctx):
            return None
        command = importlib.import_module(_module_name(cmd_name)).command
        assert isinstance(command, click.Command)
        return command


@click.group("balance", cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, "-V", "--version", prog_name="balance")
def balance() -> None:
    """From raw volts of a rotor balance to rotor-harmonic hub loads.

    Exit status: 0 done; 1 internal error; 2 the input or the call is wrong, and nothing was written; 3 `diagnose
    --fail-on-discrepancy` found one; 4 done, but some runs were skipped, which are listed.
    """
