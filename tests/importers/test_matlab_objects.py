"""Objects of MATLAB (timeseries, table, datetime): their files hold references, and no values to be read."""

import struct

import h5py
import numpy as np
import pytest
import scipy.io

from balance_cli.importers import open_foreign
from balance_cli.io.errors import UserError
from balance_cli.steps.import_sketch import sketch_map

X = np.random.default_rng(3).standard_normal((300, 1))
REFERENCE = np.array([[0xDD000000, 2, 1, 1, 1, 1]], np.uint32)
"""As MATLAB marks an object: a number of its own, dimensions, and where the object is."""


def element(kind, data):
    return struct.pack("<II", kind, len(data)) + data + b"\0" * (-len(data) % 8)


def opaque(name, kind):
    """An object as MATLAB saves it by default (version 7)."""
    numbers = element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 6, 1)) + element(1, b"")
    numbers = element(14, numbers + element(6, REFERENCE.tobytes()))
    words = b"".join(element(1, word) for word in (name, b"MCOS", kind))
    return element(14, element(6, struct.pack("<II", 17, 0)) + words + numbers)


@pytest.mark.parametrize("kind", [b"timeseries", b"table"])
def test_an_object_beside_arrays_is_named_and_not_called_damage(tmp_path, kind):
    path = tmp_path / "zero.mat"
    scipy.io.savemat(path, {"F": X})
    path.write_bytes(path.read_bytes() + opaque(b"ts", kind))
    with pytest.raises(UserError, match="holds objects of MATLAB") as caught:
        open_foreign(path)
    assert "damaged" not in caught.value.fault


@pytest.mark.parametrize("kind", ["timeseries", "table", "datetime"])
def test_an_object_of_matlab_73_is_no_channel(tmp_path, kind):
    """Its six numbers were a channel, or the time."""
    path = tmp_path / "zero.mat"
    with h5py.File(path, "w") as file:
        for name, values in (("F", X.T), ("ts", REFERENCE)):
            file[name] = values
            file[name].attrs["MATLAB_class"] = np.bytes_("double" if name == "F" else kind)
        file["ts"].attrs["MATLAB_object_decode"] = np.int32(3)
    groups = {group.names[0]: group for group in open_foreign(path).groups}
    assert not groups["F"].unusable and f"an object of MATLAB (`{kind}`)" in groups["ts"].unusable
    sketch = sketch_map([open_foreign(path)], None)
    assert "sample_rate: TODO" in sketch and "not usable: ts: an object of MATLAB" in sketch
