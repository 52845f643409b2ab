"""Exceptions become one message on stderr and an exit status."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Sequence
from typing import Any

import click

from balance_cli.io.errors import UserError

EXIT_USER_ERROR = 2
EXIT_INTERNAL_ERROR = 1
EXIT_INTERRUPTED = 130
"""Exit statuses; shells report 130 for a process that was interrupted from the keyboard."""


class _ErrorReportingCommand(click.Command):
    """A command that reports errors as one message on stderr: exit status 2 for user errors, 1 for internal errors."""

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        **extra: Any,
    ) -> Any:
        """Run the command as click does; in standalone mode exceptions become messages."""
        if not standalone_mode:
            return super().main(args, prog_name, complete_var, standalone_mode=False, **extra)
        words = list(sys.argv[1:] if args is None else args)
        try:
            status = super().main(words, prog_name, complete_var, standalone_mode=False, **extra)
        except BaseException as error:
            sys.exit(report_error(error, verbose=bool({"-v", "--verbose"} & set(words))))
        sys.exit(status if isinstance(status, int) else 0)


class BalanceCommand(_ErrorReportingCommand):
    """One command of `balance`."""


def report_error(error: BaseException, verbose: bool) -> int:
    """Print the error on stderr and return the exit status. SystemExit is raised again."""
    if isinstance(error, SystemExit):
        raise error
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        error.show()
        return EXIT_USER_ERROR
    if isinstance(error, UserError | click.ClickException):
        _echo_error(str(error) if isinstance(error, UserError) else _usage_message(error))
        return EXIT_USER_ERROR
    if isinstance(error, click.Abort | KeyboardInterrupt):
        _echo_error("interrupted, nothing written")
        return EXIT_INTERRUPTED
    return _report_internal_error(error, verbose)


def _usage_message(error: click.ClickException) -> str:
    message = error.format_message().rstrip(".")
    context = error.ctx if isinstance(error, click.UsageError) else None
    return f"{message}. Try `{context.command_path} --help`" if context else message


def _report_internal_error(error: BaseException, verbose: bool) -> int:
    if verbose:
        click.echo("".join(traceback.format_exception(error)), err=True)
    text = " ".join(str(error).split())
    hint = "" if verbose else " (`--verbose` shows the traceback)"
    _echo_error(f"internal error, {type(error).__name__}: {text}. Please report it with the call and its inputs{hint}")
    return EXIT_INTERNAL_ERROR


def _echo_error(message: str) -> None:
    click.echo(f"balance: error: {message}", err=True)
