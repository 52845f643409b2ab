"""Results that lie in a temporary file: the mapping behaves as a dict, and an artefact of it is the same."""

import errno
import tempfile

import h5py
import numpy as np
import pytest

from balance_cli.io.errors import UserError
from balance_cli.io.hdf5_tree import read_tree, to_tree, tree_digest, write_tree
from balance_cli.io.stored_mapping import MOST_IN_MEMORY, StoredMapping


def test_values_come_back_whether_they_lie_in_memory_or_on_the_disk() -> None:
    large = np.arange(MOST_IN_MEMORY // 8 + 1.0)
    stored: StoredMapping[object] = StoredMapping()
    for name, value in (("a", 1), ("b", large), ("c", {"x": (1, 2)})):
        stored[name] = value
    stored["a"] = "another"
    assert list(stored) == ["a", "b", "c"] and len(stored) == 3 and "d" not in stored
    assert stored["a"] == "another" and stored["c"] == {"x": (1, 2)}
    np.testing.assert_array_equal(stored["b"], large)
    assert stored.pop("c") == {"x": (1, 2)} and list(stored) == ["a", "b"]


def test_its_tree_is_that_of_a_dict() -> None:
    values = {"run/1": {"x": np.arange(3.0)}, "b": {"x": np.ones((2, 2), complex), "text": ("u", "v")}}
    stored: StoredMapping[object] = StoredMapping()
    stored.update(values)
    tree = to_tree({"runs": stored})
    assert tree_digest(tree) == tree_digest(to_tree({"runs": values}))
    with h5py.File.in_memory() as file:
        write_tree(file.create_group("content", track_order=True), tree)
        assert tree_digest(read_tree(file["content"])) == tree_digest(tree)
        assert list(file["content/runs"]) == ["run%2F1", "b"]


def test_a_full_disk_is_an_error_that_names_the_folder(monkeypatch) -> None:
    def fail(_data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    stored: StoredMapping[object] = StoredMapping()
    monkeypatch.setattr(stored._file, "write", fail)
    with pytest.raises(UserError, match="No space left on device") as caught:
        stored["a"] = 1
    assert str(caught.value).startswith(tempfile.gettempdir()) and list(stored) == []
