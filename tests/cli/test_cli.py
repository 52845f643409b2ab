"""What all commands share: messages and exit status, outputs written together or not at all, summaries, provenance."""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner, Result
from hypothesis import given
from hypothesis import strategies as st

from balance_cli import __version__
from balance_cli.cli import COMMANDS, balance
from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.options import (
    OutputFile,
    OutputFolder,
    geometry_option,
    output_option,
    runs_argument,
    skip_bad_option,
)
from balance_cli.cli.summary import SummaryOfEach, json_parts, to_json_value
from balance_cli.io.artefacts import load_artefact
from balance_cli.io.errors import UserError

ROOT = Path(__file__).parents[2]
RIG = str(ROOT / "configs" / "rts-6.yaml")
WIND, STATIC = (str(ROOT / "sample_data" / f"{name}.h5") for name in ("wind-1", "static-bare"))


@dataclass(frozen=True)
class Count:
    runs: tuple[str, ...]


@balance_command("count")
@geometry_option
@runs_argument
@skip_bad_option
@output_option("COUNT")
@click.option("--second", type=OutputFile())
@click.option("--folder", type=OutputFolder())
@click.option("--method", type=click.Choice(["fast", "slow"]), default="fast")
@click.option("--weight", type=float, multiple=True)
@click.option("--fault", default="")
def count(session: Session, geometry: Path, runs: tuple[Path, ...], skip_bad: bool, output: Path, **rest: Any) -> None:
    """Count runs."""
    opened = session.runs(session.progress(runs, "runs"), session.geometry(geometry), skip_bad)
    counted = Count(tuple(run.name for run in opened))
    session.save(output, "balance-loads/1", counted)
    if rest["second"]:
        session.stage(rest["second"]).write_text("second", encoding="utf-8")
    if rest["folder"]:
        for run in opened:
            session.stage_in(rest["folder"], f"{run.name}.txt").write_text(run.kind, encoding="utf-8")
    if rest["fault"] == "user":
        raise UserError("is too heavy", "rig", "cells[0]", "Use a crane")
    if rest["fault"] == "internal":
        raise ZeroDivisionError("division by zero\nin line 7")
    if rest["fault"] == "interrupt":
        raise KeyboardInterrupt
    if rest["fault"] == "status":
        session.status = 3
    if "static-bare" in counted.runs:
        session.report_left_out("static-bare", "static")
    session.finish({"count": np.int64(len(opened)), "mean": np.nan}, [f"{len(opened)} runs"])


def run(*words: object) -> Result:
    return CliRunner().invoke(count, [str(word) for word in words], prog_name="balance count")


def test_a_call_that_succeeds_says_so_and_writes_its_result(tmp_path: Path) -> None:
    result = run("-g", RIG, WIND, STATIC, "-o", tmp_path / "count.h5", "--json", tmp_path / "count.json")
    assert result.exit_code == 0, result.output
    assert result.stdout == f"2 runs\nwritten: {tmp_path / 'count.h5'}\n"
    assert result.stderr == "balance: warning: static-bare left out: static\n"
    assert json.loads((tmp_path / "count.json").read_text(encoding="utf-8")) == {
        "command": "balance count",
        "outputs": [str(tmp_path / "count.h5")],
        "warnings": [],
        "skipped": {},
        "left_out": {"static-bare": "static"},
        "gaps": {},
        "count": 2,
        "mean": None,
    }
    assert sorted(path.name for path in tmp_path.iterdir()) == ["count.h5", "count.json"]


def test_with_json_to_stdout_the_text_goes_to_stderr(tmp_path: Path) -> None:
    result = run("-g", RIG, WIND, "-o", tmp_path / "count.h5", "--json", "-")
    assert json.loads(result.stdout)["count"] == 1
    assert "1 runs" in result.stderr


def test_the_provenance_names_command_options_and_inputs(tmp_path: Path) -> None:
    words = ("-g", RIG, WIND, STATIC, "--weight", 0.5, "--weight", 2, "--method", "fast")
    assert run(*words, "-o", tmp_path / "a.h5", "-v").exit_code == 0
    assert (
        run(*words, "-o", tmp_path / "b.h5", "--json", tmp_path / "b.json", "--second", tmp_path / "c").exit_code == 0
    )
    first, second = (load_artefact(tmp_path / name, {"balance-loads/1": Count}) for name in ("a.h5", "b.h5"))
    made = first.provenance
    assert (made.command, dict(made.options)) == ("balance count", {"weight": [0.5, 2.0]})
    assert [(item.name, item.role) for item in made.inputs] == [
        ("rts-1", "geometry"),
        ("wind-1", "run"),
        ("static-bare", "run"),
    ]
    assert all(len(item.digest) == 64 for item in made.inputs)
    assert first.digest == second.digest
    assert run(*words, "--method", "slow", "-o", tmp_path / "a.h5").exit_code == 0
    assert load_artefact(tmp_path / "a.h5", {"balance-loads/1": Count}).digest != first.digest


@pytest.mark.parametrize(
    ("fault", "status", "words"),
    [
        ("user", 2, "balance: error: rig, cells[0]: is too heavy. Use a crane\n"),
        ("internal", 1, "balance: error: internal error, ZeroDivisionError: division by zero in line 7. Please report"),
        ("interrupt", 130, "balance: error: interrupted, nothing written\n"),
    ],
)
def test_a_call_that_fails_says_why_in_one_line_and_writes_nothing(
    tmp_path: Path, fault: str, status: int, words: str
) -> None:
    (tmp_path / "count.h5").write_text("old", encoding="utf-8")
    outputs = ("-o", tmp_path / "count.h5", "--second", tmp_path / "second", "--folder", tmp_path / "folder")
    result = run("-g", RIG, WIND, *outputs, "--json", tmp_path / "count.json", "--fault", fault)
    assert result.exit_code == status
    assert result.stdout == ""
    assert result.stderr.lstrip("\n").startswith(words)
    assert result.stderr.strip().count("\n") == 0
    assert [path.name for path in tmp_path.iterdir()] == ["count.h5"]
    assert (tmp_path / "count.h5").read_text(encoding="utf-8") == "old"


def test_the_traceback_of_an_internal_error_is_shown_with_verbose_only(tmp_path: Path) -> None:
    words = ("-g", RIG, WIND, "-o", tmp_path / "count.h5", "--fault", "internal")
    assert "Traceback" not in run(*words).stderr
    assert "Traceback" in run(*words, "--verbose").stderr


def test_a_command_can_set_its_exit_status_and_still_write(tmp_path: Path) -> None:
    result = run("-g", RIG, WIND, "-o", tmp_path / "count.h5", "--fault", "status")
    assert (result.exit_code, (tmp_path / "count.h5").exists()) == (3, True)


def test_files_of_a_folder_are_written_with_the_rest(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    assert run("-g", RIG, WIND, STATIC, "-o", tmp_path / "count.h5", "--folder", folder).exit_code == 0
    assert sorted(path.name for path in folder.iterdir()) == ["static-bare.txt", "wind-1.txt"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("-o", "{tmp}/no/count.h5"), "its folder does not exist"),
        (("-o", "{tmp}"), "is a folder"),
        (("-o", "{run}"), "is also an input of this command"),
        (("-o", "/dev/null"), "not an ordinary file"),
        (("-o", "{tmp}/a", "--second", "{tmp}/./a"), "two outputs have this name"),
        (("-o", "{tmp}/a", "--json", "{tmp}/a"), "two outputs have this name"),
        (("-o", "{tmp}/a", "--json", "{tmp}/no/a"), "its folder does not exist"),
        (("-o", "{tmp}/a", "--folder", "{run}"), "is a file, not a folder"),
        ((), "Missing option '-o'"),
        (("-o", "{tmp}/a", "--method", "slowly"), "'slowly'"),
        (("-o", "{tmp}/a", "--nonsense"), "No such option"),
    ],
)
def test_a_call_that_cannot_end_well_is_refused_before_anything_is_read(
    tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    own = tmp_path / "run.h5"
    own.write_bytes(b"not read")
    given_words = [word.format(tmp=tmp_path, run=own) for word in words]
    result = run("-g", tmp_path / "missing.yaml", own, *given_words)
    assert result.exit_code == 2
    assert message in result.stderr
    assert result.stderr.startswith("balance: error: ")
    assert result.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["run.h5"]


def test_bad_runs_stop_the_call_or_are_listed(tmp_path: Path) -> None:
    bad = tmp_path / "bad.h5"
    bad.write_bytes(b"nothing")
    words = ("-g", RIG, WIND, bad, "-o", tmp_path / "count.h5", "--json", tmp_path / "count.json")
    assert run(*words).exit_code == 2
    result = run(*words, "--skip-bad")
    assert result.exit_code == 0
    assert f"balance: warning: skipped: {bad}" in result.stderr
    assert list(json.loads((tmp_path / "count.json").read_text(encoding="utf-8"))["skipped"]) == [str(bad)]


def test_the_command_line_lists_its_commands_and_its_version() -> None:
    listed = CliRunner().invoke(balance, ["--help"])
    assert listed.exit_code == 0
    assert all(f"\n  {name} " in listed.stdout for name in balance.list_commands(click.Context(balance)))
    assert CliRunner().invoke(balance, ["--version"]).stdout == f"balance, version {__version__}\n"
    unknown = CliRunner().invoke(balance, ["calibrat"])
    assert (unknown.exit_code, unknown.stdout) == (2, "")
    assert unknown.stderr.startswith("balance: error: No such command 'calibrat'")
    mistyped = CliRunner().invoke(balance, ["import", "--verbos"])
    assert "'--verbose'? Try `balance import --help`" in mistyped.stderr
    bare = CliRunner().invoke(balance, [])
    assert (bare.exit_code, bare.stderr.startswith("Usage: ")) == (2, True)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself_and_takes_json(name: str) -> None:
    command = balance.get_command(click.Context(balance), name)
    if command is None:
        pytest.skip("not there yet")
    result = CliRunner().invoke(balance, [name, "--help"])
    assert result.exit_code == 0
    assert {"json_path", "verbose"} <= {parameter.name for parameter in command.params}
    assert command.help
    assert all(getattr(item, "help", "") for item in command.params if isinstance(item, click.Option))


def test_the_program_starts_without_loading_what_commands_need() -> None:
    """`python -m balance_cli --help` imports neither numpy nor anything that rests on it."""
    code = "import sys; from balance_cli.cli import balance; balance(['--help'], standalone_mode=False); "
    code += "sys.exit(bool({'numpy', 'h5py', 'scipy', 'pandas', 'pydantic', 'matplotlib'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0
    help_ = subprocess.run([sys.executable, "-m", "balance_cli", "--help"], capture_output=True, check=True, text=True)
    assert help_.stdout.startswith("Usage: balance ")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(st.text(), JSON))
def test_summaries_are_strict_json_with_null_for_what_is_not_finite(summary: dict[str, Any]) -> None:
    def refuse(word: str) -> None:
        raise AssertionError(word)

    def finite(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: finite(item) for key, item in value.items()}
        if isinstance(value, list):
            return [finite(item) for item in value]
        return None if isinstance(value, float) and not np.isfinite(value) else value

    assert json.loads("".join(json_parts(summary)), parse_constant=refuse) == finite(summary)


def test_summaries_take_what_steps_return() -> None:
    summary = {
        "array": np.array([[1.0, np.inf], [2.0, 3.0]]),
        "scalars": (np.float32(0.5), np.int16(2), np.bool_(True)),
        "complex": 1 + 2j,
        "runs": Count(("a",)),
        "path": Path("a"),
        "harmonic": {1: 0.5},
    }
    assert json.loads("".join(json_parts(summary))) == {
        "array": [[1.0, None], [2.0, 3.0]],
        "scalars": [0.5, 2, True],
        "complex": {"real": 1.0, "imag": 2.0},
        "runs": {"runs": ["a"]},
        "path": "a",
        "harmonic": {"1": 0.5},
    }
    with pytest.raises(TypeError, match="object has no JSON form"):
        "".join(json_parts({"a": object()}))


def test_summaries_of_many_runs_are_written_one_by_one_with_the_bytes_of_one_object() -> None:
    made: list[int] = []

    def summarize(value: int) -> dict[str, Any]:
        made.append(value)
        return {"redundancy": {0: float(value), 1: np.nan}, "notes": (), "text": "a\n\u00e4"}

    runs = SummaryOfEach({f"run {k}": k for k in range(100)}, summarize)
    summary = {"outputs": ["a", "b"], "skipped": {}, "runs": runs}
    parts = json_parts(summary)
    assert made == [] and next(parts).startswith("{")
    longest = max(map(len, parts))
    assert made == list(range(100)) and longest < 200
    whole = json.dumps(to_json_value(summary), indent=2, ensure_ascii=False)
    assert "".join(json_parts(summary)) == whole
