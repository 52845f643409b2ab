"""The one place that turns what went wrong into a message and an exit status."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Sequence
from typing import Any

import click

from balance_cli.io.errors import UserError

USER_FAULT = 2
OUR_FAULT = 1
INTERRUPTED = 130
"""Exit statuses; 130 is what shells report of a process that was interrupted from the keyboard."""


class _Reporting(click.Command):
    """A command whose errors are one message on stderr and an exit status: 2 the user's fault, 1 ours."""

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        **extra: Any,
    ) -> Any:
        """As click's; only in standalone mode are exceptions turned into messages."""
        if not standalone_mode:
            return super().main(args, prog_name, complete_var, standalone_mode=False, **extra)
        words = list(sys.argv[1:] if args is None else args)
        try:
            status = super().main(words, prog_name, complete_var, standalone_mode=False, **extra)
        except BaseException as error:
            sys.exit(report(error, verbose=bool({"-v", "--verbose"} & set(words))))
        sys.exit(status if isinstance(status, int) else 0)


class BalanceCommand(_Reporting):
    """One command of `balance`."""


def report(error: BaseException, verbose: bool) -> int:
    """Say on stderr what went wrong; returns the exit status. Re-raises SystemExit."""
    if isinstance(error, SystemExit):
        raise error
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        error.show()
        return USER_FAULT
    if isinstance(error, UserError | click.ClickException):
        _say(str(error) if isinstance(error, UserError) else _usage_message(error))
        return USER_FAULT
    if isinstance(error, click.Abort | KeyboardInterrupt):
        _say("interrupted, nothing written")
        return INTERRUPTED
    return _our_fault(error, verbose)


def _usage_message(error: click.ClickException) -> str:
    message = error.format_message().rstrip(".")
    context = error.ctx if isinstance(error, click.UsageError) else None
    return f"{message}. Try `{context.command_path} --help`" if context else message


def _our_fault(error: BaseException, verbose: bool) -> int:
    if verbose:
        click.echo("".join(traceback.format_exception(error)), err=True)
    text = " ".join(str(error).split())
    hint = "" if verbose else ", with what `--verbose` adds"
    _say(f"internal fault, {type(error).__name__}: {text}. Please report it with the call and its inputs{hint}")
    return OUR_FAULT


def _say(message: str) -> None:
    click.echo(f"balance: error: {message}", err=True)
