"""HDF5 files on a disk that is full: one error when the file is closed or checked, whatever HDF5 does."""

import errno
import os

import h5py
import numpy as np
import pytest

from balance_cli.io import hdf5_output
from balance_cli.io.errors import UserError
from balance_cli.io.hdf5_output import Hdf5Output

resource = pytest.importorskip("resource", reason="limits of POSIX")


@pytest.fixture
def file_limit():
    """Set the largest size of files [bytes]; the former limit is restored."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def fill(output, blocks=40):
    rng = np.random.default_rng(1)
    output.file.attrs["format"] = "x"
    table = output.file.create_dataset("t", (0, 6), "f8", maxshape=(None, 6), chunks=(512, 6), compression="gzip")
    for block in range(blocks):
        table.resize((block + 1) * 512, axis=0)
        table[-512:] = rng.normal(size=(512, 6))
        output.check()


def test_the_file_is_as_hdf5_writes_it(tmp_path):
    with Hdf5Output(tmp_path / "a.h5") as output:
        fill(output)
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["t"].shape == (40 * 512, 6)
        assert file["t"][()].std() == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("size", [0, 1, 100, 2000, 2048, 10_000, 100_000, 300_000])
def test_a_full_disk_is_one_error_that_names_the_file(tmp_path, file_limit, size):
    file_limit(size)
    with (
        pytest.raises(UserError, match=r"a\.h5: cannot be written: File too large"),
        Hdf5Output(tmp_path / "a.h5") as o,
    ):
        fill(o)


def test_another_error_is_not_replaced(tmp_path, file_limit):
    file_limit(2000)
    with pytest.raises(ZeroDivisionError), Hdf5Output(tmp_path / "a.h5") as output:
        output.file.create_dataset("t", data=np.random.default_rng(1).normal(size=10_000))
        raise ZeroDivisionError


def test_an_error_at_closing_counts(tmp_path, monkeypatch):
    """Systems with quotas, and file servers, report what they did not write only when the file is closed."""

    class LateFile(hdf5_output._Disk):
        def close(self):
            if not self.closed:
                self.error = OSError(errno.EDQUOT, os.strerror(errno.EDQUOT))
            super().close()

    monkeypatch.setattr(hdf5_output, "_Disk", LateFile)
    with pytest.raises(UserError, match="quota exceeded"), Hdf5Output(tmp_path / "a.h5") as output:
        output.file["x"] = 1
