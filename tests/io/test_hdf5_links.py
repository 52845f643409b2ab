"""HDF5 objects that lie in other files are refused, in run files, artefacts, histories and imports."""

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.cli import balance
from balance_cli.io.errors import UserError
from balance_cli.io.hdf5_links import refuse_other_files

ROOT = Path(__file__).parents[2]
RUN, RIG = ROOT / "sample_data" / "wind-1.h5", ROOT / "configs" / "rts-6.yaml"


@pytest.fixture
def other(tmp_path):
    path = tmp_path / "other.h5"
    with h5py.File(path, "w") as file:
        file["x"] = np.arange(4.0)
        file["group/x"] = np.arange(4.0)
    return path


def external_storage(file, other):
    file.create_dataset("x", shape=(4,), dtype="f8", external=[(str(other), 0, 32)])


def virtual(file, other):
    layout = h5py.VirtualLayout(shape=(4,), dtype="f8")
    layout[:] = h5py.VirtualSource(other, "x", shape=(4,))
    file.create_virtual_dataset("x", layout)


def linked(file, other):
    file["x"] = h5py.ExternalLink(other, "x")


def linked_behind_a_soft_link(file, other):
    file["hidden"] = h5py.ExternalLink(other, "group")
    file["x"] = h5py.SoftLink("/hidden/x")


@pytest.mark.parametrize("make", [external_storage, virtual, linked, linked_behind_a_soft_link])
def test_values_of_another_file_are_refused(tmp_path, other, make):
    with h5py.File(tmp_path / "file.h5", "w") as file:
        make(file, other)
        with pytest.raises(UserError, match="is in another file"):
            refuse_other_files(file, "x")


def test_a_group_of_another_file_is_refused(tmp_path, other):
    with h5py.File(tmp_path / "file.h5", "w") as file:
        file["group"] = h5py.ExternalLink(other, "group")
        with pytest.raises(UserError, match="is in another file"):
            refuse_other_files(file, "group/x")


def test_values_of_the_file_itself_are_not(tmp_path):
    with h5py.File(tmp_path / "file.h5", "w") as file:
        file["group/x"] = np.arange(4.0)
        file["soft"] = h5py.SoftLink("/group/x")
        layout = h5py.VirtualLayout(shape=(4,), dtype="f8")
        layout[:] = h5py.VirtualSource(".", "group/x", shape=(4,))
        file.create_virtual_dataset("virtual", layout)
        for name in ("group", "group/x", "soft", "virtual", "absent", "group/absent"):
            refuse_other_files(file, name)


def test_commands_refuse_them(tmp_path):
    run, model, signal = tmp_path / "run.h5", tmp_path / "model.h5", tmp_path / "signal.h5"
    shutil.copy(RUN, run)
    with h5py.File(run, "r+") as file:
        del file["rotor"]
        file["rotor"] = h5py.ExternalLink(RUN, "rotor")
    assert (
        CliRunner().invoke(balance, ["identify", "-g", str(RIG), "--method", "computed", "-o", str(model)]).exit_code
        == 0
    )
    shutil.copy(model, tmp_path / "whole.h5")
    with h5py.File(model, "r+") as file:
        del file["content"]
        file["content"] = h5py.ExternalLink(tmp_path / "whole.h5", "content")
    with h5py.File(signal, "w") as file:
        file["t"] = np.arange(100) / 100.0
        file.create_dataset("x", shape=(100,), dtype="f4", external=[(str(RUN), 0, 400)])
    for words in (["check", run], ["report", model, "-o", tmp_path / "r.html"], ["import", "--sketch", signal]):
        done = CliRunner().invoke(balance, [str(word) for word in words])
        assert done.exit_code == 2 and "in another file" in done.output, done.output
        assert str(next(word for word in words if isinstance(word, Path))) in done.output
