"""Messages on stderr, with a colored label where stderr is a terminal."""

from __future__ import annotations

import os
import sys
from contextlib import suppress

import click

from balance_cli.io.text_output import printable_line

COLORS = {"error": "red", "warning": "yellow", "info": "blue", "debug": "blue"}


def echo_message(kind: str, text: str) -> None:
    """Print `balance: KIND: text` on stderr; what is wrong is bold and colored where colors are shown."""
    shown = shows_colors()
    label = click.style(kind, fg=COLORS.get(kind), bold=kind == "error") if shown else kind
    with suppress(OSError):  # nobody can be told that stderr is full
        click.echo(f"balance: {label}: {printable_line(text)}", err=True, color=shown)


def shows_colors() -> bool:
    """Whether stderr shows colors: a terminal does, unless NO_COLOR is set, and FORCE_COLOR asks for them elsewhere.

    NO_COLOR (no-color.org) counts first; either counts where it is not empty.
    """
    if os.environ.get("NO_COLOR"):
        return False
    return bool(os.environ.get("FORCE_COLOR")) or (sys.stderr.isatty() and os.environ.get("TERM") != "dumb")
