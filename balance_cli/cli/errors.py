"""Exceptions become one message on stderr and an exit status."""

from __future__ import annotations

import errno
import os
import select
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import click

from balance_cli.cli.labels import echo_message
from balance_cli.io.errors import UserError

EXIT_USER_ERROR = 2
EXIT_INTERNAL_ERROR = 1
EXIT_RUNS_SKIPPED = 4
EXIT_INTERRUPTED = 130
EXIT_CLOSED_PIPE = 141
"""Exit statuses; shells report 130 for a process that was interrupted from the keyboard, and 141 for one whose output
nobody reads any more (`| head`)."""

FORMER_NAMES = "balance_cli.former_names"
"""Key of a click context: {name of an option: former name by which it was given}."""
SYSTEM_ERRORS = {errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.ENAMETOOLONG}
SYSTEM_ERRORS |= {errno.EIO, errno.ENODEV, errno.ESTALE, errno.EMFILE, errno.ENFILE}
"""Errors of the operating system that no program can avoid: disk full, read-only, limits, a device that fails."""
MEMORY_ERRORS = {errno.ENOMEM, errno.EAGAIN}
MEMORY_WORDS = ("cannot allocate memory", "memory allocation failed", "failed to map segment", "can't start new thread")
"""Parts of the messages by which the loader of extension modules, HDF5 and threads report a lack of memory."""


class _OutputError(Exception):
    """A broken pipe, of an output or of something else. Of the exception itself click makes exit status 1."""


@contextmanager
def _broken_pipes_kept() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError as error:
        raise _OutputError(*error.args) from error


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
            status = report_error(error, verbose=bool({"-v", "--verbose"} & set(words)))
            _drop_unwritable_output()
            sys.exit(status)
        sys.exit(status if isinstance(status, int) else 0)

    def make_context(self, *arguments: Any, **extra: Any) -> click.Context:
        """Parse the words, as click does; help is printed here."""
        with _broken_pipes_kept():
            return super().make_context(*arguments, **extra)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the function of the command, as click does; an error names an option as it was typed."""
        with _broken_pipes_kept():
            try:
                return super().invoke(ctx)
            except UserError as error:
                error.file = ctx.meta.get(FORMER_NAMES, {}).get(error.file, error.file)
                raise


class BalanceCommand(_ErrorReportingCommand):
    """One command of `balance`."""

    def collect_usage_pieces(self, ctx: click.Context) -> list[str]:
        """The words of a call, with the options that it must have."""
        first, *others = super().collect_usage_pieces(ctx)
        options = [item for item in self.params if isinstance(item, click.Option) and item.required]
        return [first, *(f"{item.opts[0]} {item.make_metavar(ctx)}" for item in options), *others]


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
    if isinstance(error, _OutputError):
        if _has_closed_stream():
            return EXIT_CLOSED_PIPE
        return _report_internal_error(error.__cause__ or error, verbose)
    fault = _system_fault(error)
    if fault is not None:
        _echo_error(fault)
        return EXIT_USER_ERROR
    return _report_internal_error(error, verbose)


def _system_fault(error: BaseException) -> str | None:
    """The message for an error that the computer causes, not the program: no memory, disk full, read-only folder."""
    text = str(error).lower()
    number = error.errno if isinstance(error, OSError) else None
    if (
        isinstance(error, MemoryError)
        or number in MEMORY_ERRORS
        or (isinstance(error, ImportError | OSError | RuntimeError) and any(words in text for words in MEMORY_WORDS))
    ):
        return "not enough memory. Raise the memory limit (`ulimit -v`), or give fewer or shorter runs"
    if not isinstance(error, OSError | RuntimeError):
        return None
    if isinstance(error, FileNotFoundError) and not _has_current_folder():
        return "the current folder does not exist any more. Change to a folder that does"
    from balance_cli.io.atomic import system_error_number, unwritable_file

    if system_error_number(error) not in SYSTEM_ERRORS:
        return None
    name = getattr(error, "filename", None)
    if name is None and system_error_number(error) == errno.EIO:
        return "a file cannot be read or written: Input/output error. Check the disk, or copy the files to another one"
    return str(unwritable_file(error, Path(os.fsdecode(name)) if isinstance(name, str | bytes) else None))


def _has_current_folder() -> bool:
    try:
        Path.cwd()
    except OSError:
        return False
    return True


def _has_closed_stream() -> bool:
    """Whether nobody reads one of the standard streams. A broken pipe of a worker or a server is another thing."""
    if not hasattr(select, "poll"):  # Windows
        return True
    poll = select.poll()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):  # a stream of a test has no number
            poll.register(stream.fileno(), 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


def _drop_unwritable_output() -> None:
    """Discard what the standard streams do not take (disk full), so that the interpreter does not try at its end."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _usage_message(error: click.ClickException) -> str:
    message = error.format_message().rstrip(".")
    context = error.ctx if isinstance(error, click.UsageError) else None
    end = "" if message.endswith("?") else "."
    return f"{message}{end} Try `{context.command_path} --help`" if context else message


def _report_internal_error(error: BaseException, verbose: bool) -> int:
    if verbose:
        click.echo("".join(traceback.format_exception(error)), err=True)
    hint = "" if verbose else " (`--verbose` shows the traceback)"
    _echo_error(f"{internal_error_text(error)}{hint}")
    return EXIT_INTERNAL_ERROR


def internal_error_text(error: BaseException) -> str:
    """Return the message for an error that is not one of the input, in one line."""
    text = " ".join(str(error).split())
    return f"internal error, {type(error).__name__}: {text}. Please report it with the call and its inputs"


def _echo_error(message: str) -> None:
    echo_message("error", message)
