"""Options and arguments that commands share, and the parameter types of inputs and outputs."""

from __future__ import annotations

import errno
import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import click

from balance_cli.cli.errors import FORMER_NAMES
from balance_cli.cli.labels import echo_message
from balance_cli.io.atomic import check_output, check_output_folder
from balance_cli.io.errors import UserError

F = TypeVar("F", bound=Callable[..., Any])


class _UsablePath(click.Path):
    """A path that the file system can look up."""

    refused: tuple[int, ...] = (errno.ELOOP, errno.ENAMETOOLONG)

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> Any:
        """Convert the word to a path. Raises UserError where its name is too long or its links go in a circle."""
        path = super().convert(value, parameter, context)
        try:
            Path(os.fsdecode(path)).stat()
        except OSError as error:
            if error.errno in self.refused:
                raise UserError(f"cannot be used: {error.strerror}", str(path), remedy="Give another path") from error
        return path


class InputFile(_UsablePath):
    """A file that a command reads; its reader checks that it exists and has the right format."""

    name = "file"

    def __init__(self, readable: bool = True) -> None:
        super().__init__(path_type=Path, readable=readable)


class ListedFile(InputFile):
    """A file of a list in which a command reports the faults of each."""

    refused = (errno.ENAMETOOLONG,)


class WordOrFile(click.types.StringParamType):
    """A word, or the name of a file that a command reads: the command tells them apart, and the value stays text."""

    name = "text"


class InputFolder(_UsablePath):
    """A folder that a command reads; it checks that the folder exists and what it holds."""

    name = "folder"

    def __init__(self) -> None:
        super().__init__(path_type=Path)


class OutputFile(_UsablePath):
    """A file that a command writes, checked before anything is computed; with `allow_dash`, `-` is stdout."""

    name = "file"

    def __init__(self, allow_dash: bool = False) -> None:
        super().__init__(path_type=Path, allow_dash=allow_dash)

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> Any:
        """As for each path. Raises UserError for `-` where the output cannot be standard output."""
        if not self.allow_dash:
            _refuse_dash(value, "file")
        return super().convert(value, parameter, context)


class OutputFolder(_UsablePath):
    """A folder that a command writes files to, created if necessary and checked before anything is computed."""

    name = "folder"

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> Any:
        """As for each path. Raises UserError for `-`."""
        _refuse_dash(value, "folder")
        return super().convert(value, parameter, context)


def _refuse_dash(value: Any, kind: str) -> None:
    if os.fspath(value) == "-":
        raise UserError("this output cannot go to standard output", "-", remedy=f"Give the name of a {kind}")


class NumberRange(click.FloatRange):
    """A range of numbers that `nan`, which compares with no limit, is not in."""

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> Any:
        """Convert the word to a number. Fails where it is `nan` or out of the range."""
        number = super().convert(value, parameter, context)
        if math.isnan(number):
            self.fail(f"{number} is not a number", parameter, context)
        return number


geometry_option: Callable[[F], F] = click.option(
    "-g", "--geometry", "geometry", type=InputFile(), required=True, metavar="GEOMETRY", help="Geometry of the rig."
)
runs_argument: Callable[[F], F] = click.argument(
    "runs", type=InputFile(readable=False), nargs=-1, required=True, metavar="RUN..."
)
skip_bad_option: Callable[[F], F] = click.option(
    "--skip-bad", is_flag=True, help="Skip the runs that cannot be used, and list them."
)


def hold_out_option(text: str) -> Callable[[F], F]:
    """The repeatable option `--hold-out`, passed to the command as `hold_out`."""
    return click.option("--hold-out", "hold_out", type=InputFile(), multiple=True, metavar="RUN", help=text)


def output_option(metavar: str, text: str = "File to write the result to.") -> Callable[[F], F]:
    """The required option `-o/--output`, passed to the command as `output`."""
    return click.option("-o", "--output", "output", type=OutputFile(), required=True, metavar=metavar, help=text)


def json_option(function: F) -> F:
    """The option `--json` of every command."""
    text = "Write the summary as JSON; `-` is stdout (the text then goes to stderr)."
    return click.option("--json", "json_path", type=OutputFile(allow_dash=True), metavar="FILE", help=text)(function)


def verbose_option(function: F) -> F:
    """The options `-v/--verbose` and `-q/--quiet` of every command."""
    text = "Report steps and their times on stderr; print the traceback of an internal error."
    function = click.option("-v", "--verbose", is_flag=True, help=text)(function)
    text = "No text on stdout and no progress; warnings and errors are still printed."
    return click.option("-q", "--quiet", is_flag=True, help=text)(function)


def deprecated_option(former: str, current: str, parameter: str, **attributes: Any) -> Callable[[F], F]:
    """The former name of an option, hidden; it sets `parameter` as `current` does, with a warning on stderr.

    `attributes` are those of the current option that say how its value is read (`type`, `is_flag`). Where both names
    are given the current one counts. A former name is understood for one release.
    """

    def use_former(context: click.Context, option: click.Parameter, value: Any) -> None:
        if context.get_parameter_source(option.name or "") is not click.core.ParameterSource.COMMANDLINE:
            return
        echo_message("warning", f"{former} is deprecated; use {current}")
        context.meta.setdefault(FORMER_NAMES, {})[current] = former
        context.params[parameter] = value
        context.set_parameter_source(parameter, click.core.ParameterSource.COMMANDLINE)

    # Eager: before the current option, whose default does not replace a value from the command line.
    return click.option(
        former,
        f"former_{parameter}",
        hidden=True,
        is_eager=True,
        expose_value=False,
        callback=use_former,
        help=f"Former name of {current}.",
        **attributes,
    )


def paths_of_type(context: click.Context, *types: type[click.Path]) -> Iterator[Path]:
    """All paths given in the call whose parameter has one of these types; `-` is not a path."""
    for parameter in context.command.params:
        value = context.params.get(parameter.name or "")
        if value is None or not isinstance(parameter.type, types):
            continue
        values = value if isinstance(value, tuple) else (value,)
        yield from (path for path in values if isinstance(path, Path) and str(path) != "-")


def input_files(context: click.Context) -> Iterator[Path]:
    """All files given in the call that it reads."""
    yield from paths_of_type(context, InputFile)
    for parameter in context.command.params:
        value = context.params.get(parameter.name or "")
        if isinstance(parameter.type, WordOrFile) and isinstance(value, str) and value and Path(value).is_file():
            yield Path(value)


def band_option(text: str) -> Callable[[F], F]:
    """The option `--band FROM TO`: the band [Hz] of the spectral lines that a fit uses; None without it."""

    def checked(context: click.Context, option: click.Parameter, value: Any) -> Any:
        if value is not None:
            check_band("--band", *value)
        return value

    return click.option("--band", type=(float, float), default=None, metavar="FROM TO", callback=checked, help=text)


def check_band(option: str, lowest: float, highest: float) -> None:
    """Raise UserError, with the option named, unless a band [Hz] begins at a finite frequency and does not fall."""
    if not (math.isfinite(lowest) and lowest <= highest):
        fault = f"no line lies between {lowest:g} and {highest:g} Hz"
        raise UserError(fault, option, remedy="Give the lowest frequency first, then the highest")


EXECUTION_OPTIONS = ("json_path", "verbose", "quiet", "strict", "jobs", "executor", "shard", "survey")
"""Options of how a command is carried out and reported; results do not depend on them."""
STORED_OPTION_NAMES = {"load_model": "loads-as"}
"""Names under which artefacts store options that were renamed later, so that digests stay."""


def non_default_options(context: click.Context) -> dict[str, Any]:
    """The options of the call that differ from their defaults, without paths and EXECUTION_OPTIONS."""
    settings = {}
    for parameter in context.command.params:
        name = parameter.name or ""
        if name in EXECUTION_OPTIONS or isinstance(parameter.type, click.Path):
            continue
        value = context.params.get(name)
        if value != parameter.get_default(context) and value not in ((), None):
            settings[STORED_OPTION_NAMES.get(name, name.replace("_", "-"))] = value
    return settings


def check_outputs(context: click.Context) -> None:
    """Check all outputs before anything is computed.

    Raises UserError where an output cannot be written, or would overwrite an input or another output.
    """
    inputs = {Path(os.path.realpath(path)) for path in input_files(context)}
    outputs: set[Path] = set()
    for path in paths_of_type(context, OutputFile):
        check_output(path)
        if path.resolve() in inputs:
            raise UserError("is also an input of this command", str(path), remedy="Give the output another name")
        if path.resolve() in outputs:
            raise UserError("two outputs have this name", str(path), remedy="Give each output its own name")
        outputs.add(path.resolve())
    for folder in paths_of_type(context, OutputFolder):
        check_output_folder(folder)
