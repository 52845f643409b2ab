"""What all commands share: one session per call, which reads inputs, writes outputs and reports.

A command reads its inputs, runs one step, writes the result and prints a summary:

    @balance_command("calibrate")
    @geometry_option
    @runs_argument
    @skip_bad_option
    @output_option("CAL")
    def command(session, geometry, runs, skip_bad, output):      # the group looks for this name
        '''One line for the list of commands.'''
        from balance_cli.steps.calibrate import calibrate

        rig = session.geometry(geometry)
        records = session.runs(runs, rig, skip_bad)
        calibration = calibrate(rig, session.progress(records, "runs"))
        session.save(output, "balance-calibration/1", calibration)
        session.finish(summary={"trims": ...}, text=["2 trims", ...])

The decorator adds `--json`, `-v` and `-q`. The session records all inputs for the provenance. Outputs (`save`, `stage`,
`stage_in`) and the JSON are written beside their final paths and moved there together when the command returns without
an exception. `session.warn` and `session.report_left_out` write to stderr and to the JSON; messages on runs within
`session.collect_messages()` become one line for many runs. `session.status = 3` sets the exit status of a call that
otherwise succeeded. Declare the options of a command with the types InputFile, OutputFile and OutputFolder of
`balance_cli.cli.options`: their paths are then checked before the command starts.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from balance_cli.cli.errors import BalanceCommand
from balance_cli.cli.lean_scipy import import_lean_scipy
from balance_cli.cli.log_messages import log_to_stderr
from balance_cli.cli.messages import Messages
from balance_cli.cli.options import check_outputs, input_files, json_option, non_default_options, verbose_option
from balance_cli.cli.work_reports import WorkReports
from balance_cli.io.atomic import StagedOutputs, os_errors_as_user_error
from balance_cli.io.errors import UserError
from balance_cli.io.reader_process import reader_process
from balance_cli.io.text_output import printable_text, write_text

if TYPE_CHECKING:
    from balance_cli.campaign.recording.run import Run
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.diagnosis.consistency.findings import ConsistencyFinding
    from balance_cli.io.artefacts import Artefact, Provenance

T = TypeVar("T")

COMMON_OPTIONS = ("json_path", "verbose", "quiet")
"""Options of every command; the help lists them last."""


class Session(Messages, WorkReports):
    """One call of one command: its inputs, outputs, warnings and summary."""

    def __init__(self, context: click.Context, json_path: Path | None) -> None:
        super().__init__()
        self.status = 0
        self._context = context
        self._json_path = json_path
        self._staged = StagedOutputs()
        self._inputs: list[tuple[str, str, str]] = []
        self._outputs: list[Path] = []
        self._summary: Mapping[str, Any] = {}
        self._text: tuple[str, ...] = ()
        self._after_close: list[Callable[[], None]] = []
        self.extra_summary: dict[str, Any] = {}
        self.findings: Sequence[ConsistencyFinding] = ()
        self.response_findings: Sequence[ConsistencyFinding] = ()

    def geometry(self, path: Path, mechanics: bool = True) -> Geometry:
        """Read a geometry and record it as an input; without `mechanics` it need not have masses and stiffness."""
        from balance_cli.campaign.rig.geometry_checks import require_mechanics
        from balance_cli.campaign.rig.geometry_file import geometry_digest, load_geometry

        geometry = load_geometry(path)
        if mechanics:
            require_mechanics(geometry, str(path))
        self._inputs.append((geometry.name, "geometry", geometry_digest(geometry)))
        return geometry

    def runs(
        self,
        paths: Iterable[Path],
        geometry: Geometry,
        skip_bad: bool = False,
        role: str = "run",
        disjoint_from: Iterable[Run] = (),
    ) -> tuple[Run, ...]:
        """Open run files of this rig and record them as inputs with this role.

        Raises UserError for a run that is also in `disjoint_from` and, unless `skip_bad`, for an unusable file.
        """
        from balance_cli.campaign.recording.gaps import report_gaps
        from balance_cli.campaign.recording.run_file import open_runs, require_disjoint

        paths = tuple(paths)
        with self.log_duration(f"{len(paths)} runs opened"):
            runs, skipped = open_runs(self.progress(paths, "opening", len(paths)), geometry, skip_bad)
        with self.collect_messages():
            for path, reason in skipped.items():
                self.report_skipped(str(path), reason)
            require_disjoint(runs, disjoint_from)
            self._inputs += [(run.name, role, run.digest) for run in runs]
            self._gaps |= report_gaps(runs, self.warn_of_run)
            self.record_hammer(runs)
        return runs

    def record_input(self, name: str, role: str, digest: str) -> None:
        """Record an input that was read elsewhere."""
        self._inputs.append((name, role, digest))

    def artefact(self, path: Path, types: Mapping[str, type[Any]], role: str = "artefact") -> Artefact:
        """Read an artefact of one of the formats in `types` and record it as an input."""
        from balance_cli.io.artefacts import load_artefact

        with self.log_duration(f"{path} read"):
            artefact = load_artefact(path, types)
        self._inputs.append((path.name, role, artefact.digest))
        return artefact

    def provenance(self) -> Provenance:
        """Command, non-default options, inputs read so far, package versions and time."""
        from balance_cli.io.artefacts import Input, make_provenance

        inputs = tuple(Input(*entry) for entry in self._inputs)
        return make_provenance(self._context.info_name or "", non_default_options(self._context), inputs)

    def save(self, path: Path, format: str, content: Any, provenance: Provenance | None = None) -> None:
        """Stage an artefact of this format for `path`, by default with the provenance of all inputs read so far."""
        from balance_cli.io.artefacts import save_artefact

        with self.working(f"writing {path}"):
            save_artefact(self.stage(path), format, content, provenance or self.provenance())

    def write_text(self, path: Path, text: str) -> None:
        """Stage a text file for `path`."""
        part = self.stage(path)
        with os_errors_as_user_error(path):
            write_text(part, text)

    def stage(self, path: Path) -> Path:
        """The temporary path to write to; the file is moved to `path` when the command has succeeded.

        Raises UserError where `path` is also an input.
        """
        if path.resolve() in {Path(os.path.realpath(item)) for item in input_files(self._context)}:
            raise UserError("is also an input of this command", str(path), remedy="Give the output another place")
        part = self._staged.stage_file(path)
        self._outputs.append(path)
        return part

    def stage_in(self, folder: Path, name: str) -> Path:
        """As `stage`, for the file `name` in an output folder, which is created if necessary."""
        return self.stage(self._staged.stage_folder(folder) / name)

    def unstage(self, part: Path) -> None:
        """Withdraw an output by its temporary path."""
        path = self._staged.target_of(part)
        if path is not None:
            self._staged.unstage(path)
            self._outputs = [output for output in self._outputs if output.resolve() != path]

    def after_close(self, action: Callable[[], None]) -> None:
        """Call `action` when the outputs are in place, or removed."""
        self._after_close.append(action)

    def echo(self, line: str) -> None:
        """Print a line now: on stdout, or on stderr where the JSON goes to stdout."""
        if not self._context.params.get("quiet"):
            click.echo(printable_text(line), err=self.json_to_stdout)

    @contextmanager
    def skip_if_unusable(self, run: Run, skip_bad: bool) -> Iterator[None]:
        """With `skip_bad`, turn a UserError into a skipped run: list it and discard its outputs."""
        before = len(self._outputs)
        try:
            yield
        except UserError as error:
            named = error.with_file_of(run.name, run.file)
            if not skip_bad:
                raise named from error
            for path in self._outputs[before:]:
                self._staged.unstage(path)
            del self._outputs[before:]
            self.report_skipped(run.file, str(named))

    def finish(self, summary: Mapping[str, Any], text: Iterable[str] = ()) -> None:
        """Set the summary (one JSON object) and the text for the user, printed once all outputs are in place."""
        self._summary, self._text = summary, tuple(text)

    def close(self, failed: bool) -> None:
        """Move all outputs into place and print the result; after a failure, remove the staged files."""
        try:
            if not failed:
                self._stage_json()
                self._staged.commit()
                self._echo_result()
        finally:
            self._staged.discard()
            for action in self._after_close:
                action()

    def _full_summary(self) -> dict[str, Any]:
        return {
            "command": self._context.info_name,
            "outputs": [str(path) for path in self._outputs],
            "warnings": self.warnings,
            "skipped": self._skipped,
            "left_out": self._left_out,
            "gaps": self._gaps,
            **({"hammer": self._hammer} if self._hammer else {}),
            **self.extra_summary,
            **self._summary,
        }

    def _stage_json(self) -> None:
        from balance_cli.cli.summary import json_parts

        if self._json_path is not None and not self.json_to_stdout:
            part = self._staged.stage_file(self._json_path)
            with os_errors_as_user_error(self._json_path), part.open("w", encoding="utf-8") as file:
                file.writelines(json_parts(self._full_summary()))
                file.write("\n")

    def _echo_result(self) -> None:
        from balance_cli.cli.summary import json_parts

        for line in (*self._text, *(f"written: {path}" for path in self._outputs)):
            self.echo(line)
        if self.json_to_stdout:
            for part in json_parts(self._full_summary()):
                click.echo(part, nl=False)
            click.echo()

    @property
    def writes_json(self) -> bool:
        """Whether the call asks for the summary."""
        return self._json_path is not None

    @property
    def json_to_stdout(self) -> bool:
        """Whether the summary goes to stdout, and the text therefore to stderr."""
        return self._json_path is not None and str(self._json_path) == "-"


def balance_command(name: str, **attributes: Any) -> Callable[[Callable[..., None]], click.Command]:
    """As click.command, with `--json`, `-v` and `-q` added.

    The function receives the Session first, then its own parameters.
    """

    def decorate(function: Callable[..., None]) -> click.Command:
        def call(json_path: Path | None, verbose: bool, quiet: bool, **parameters: Any) -> None:
            context = click.get_current_context()
            check_outputs(context)
            import_lean_scipy()
            session, failed = Session(context, json_path), True
            with log_to_stderr(verbose and not quiet), reader_process():
                try:
                    function(session, **parameters)
                    failed = False
                finally:
                    session.close(failed)
            context.exit(session.status)

        functools.update_wrapper(call, function)
        command = click.command(name, cls=BalanceCommand, **attributes)(verbose_option(json_option(call)))
        command.params.sort(key=lambda parameter: parameter.name in COMMON_OPTIONS)
        return command

    return decorate
