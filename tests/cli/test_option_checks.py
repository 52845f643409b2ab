"""Options out of range, and outputs that are also inputs, are refused with the option or the file."""

import json
import math
import os
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.cli.common import balance_command
from balance_cli.cli.options import OutputFolder, check_band, runs_argument
from balance_cli.cli.reduce_runs import _check_lag, check_name
from balance_cli.cli.summary import json_parts
from balance_cli.io.errors import UserError
from balance_cli.io.sniff import is_hdf5
from balance_cli.simulation.files import read_plan


def a_run(name="r"):
    source = MemorySource(np.zeros((800, 1)), None)
    return Run(name, "rig", "wind", ("a",), 800, source, sample_rate=800.0, path=Path("r.h5"))


@pytest.mark.parametrize("band", [(math.inf, math.inf), (math.nan, 3.0), (3.0, math.nan), (9.0, 3.0)])
def test_a_band_without_lines_is_refused(band):
    with pytest.raises(UserError, match="--band"):
        check_band("--band", *band)


def test_a_band_may_be_open():
    check_band("--band", 0.0, math.inf)


def test_a_lag_is_at_most_the_record():
    _check_lag(a_run(), 1.0)
    _check_lag(a_run(), None)
    with pytest.raises(UserError, match="--lag: lag 1e\\+09 s is longer than the record `r` of 1 s"):
        _check_lag(a_run(), 1e9)


@pytest.mark.parametrize("name", ["../x", "/tmp/x", "n" * 300])
def test_a_history_has_the_name_of_a_file(name, tmp_path):
    check_name(name, Path("r.h5"), None)
    with pytest.raises(UserError, match="cannot be a file name"):
        check_name(name, Path("r.h5"), tmp_path)


@balance_command("copy")
@runs_argument
@click.option("--history", type=OutputFolder())
def copy(session, runs, history):
    """Write a file of the name of each run."""
    for run in runs:
        session.stage_in(history, run.name).write_text("new")


def test_a_file_of_an_output_folder_does_not_replace_an_input(tmp_path):
    (tmp_path / "a.h5").write_text("old")
    result = CliRunner().invoke(copy, [str(tmp_path / "a.h5"), "--history", str(tmp_path)])
    assert result.exit_code == 2
    assert "a.h5: is also an input" in result.output
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a.h5", "old")]


def test_paths_that_cannot_be_looked_up_are_refused(tmp_path):
    loop = tmp_path / "loop.h5"
    loop.symlink_to(loop)
    for path in (loop, tmp_path / ("n" * 300)):
        result = CliRunner().invoke(copy, [str(path), "--history", str(tmp_path)])
        assert result.exit_code == 2
        assert f"{path}: cannot be used" in result.output


def test_paths_that_are_not_utf8_are_escaped_in_json():
    name = os.fsdecode(b"a\xff.h5")
    assert json.loads("".join(json_parts({"outputs": [name]})).encode()) == {"outputs": [name]}


def test_what_is_not_an_ordinary_file_is_not_opened(tmp_path):
    os.mkfifo(tmp_path / "fifo.h5")
    assert not is_hdf5(tmp_path / "fifo.h5")
    with pytest.raises(UserError, match="not an ordinary file"):
        read_plan(tmp_path / "fifo.h5")
