"""HDF5 objects that lie in another file: a file from elsewhere could show any file that the user may read."""

from __future__ import annotations

from contextlib import suppress
from itertools import accumulate
from typing import Any

import h5py

from balance_cli.io.errors import UserError

SAME_FILE = "."
"""Name of the source file of a virtual dataset that lies in the file itself."""


def refuse_other_files(file: h5py.File, name: str) -> None:
    """Raise UserError where a name leads to another file: by an external link, external storage or a virtual dataset.

    Links on the way are looked at before they are followed. A name that leads nowhere is no fault here.
    """
    with suppress(KeyError):
        linked_object(file, name)


def linked_object(file: h5py.File, name: str) -> Any:
    """Return the object of that name, None where no link has it; KeyError where its link leads nowhere.

    Raises UserError where it lies in another file.
    """
    for path in accumulate(name.split("/"), lambda path, part: f"{path}/{part}"):
        link = file.get(path, getlink=True)
        if link is None:
            return None
        if isinstance(link, h5py.ExternalLink):
            raise _other_file_error(name)
    item = file[name]
    if h5py.h5f.get_name(item.id) != h5py.h5f.get_name(file.id) or keeps_values_elsewhere(item):
        raise _other_file_error(name)
    return item


def keeps_values_elsewhere(item: Any) -> bool:
    """Whether an object is a dataset whose values are in other files."""
    if not isinstance(item, h5py.Dataset):
        return False
    if item.is_virtual:
        return any(source.file_name != SAME_FILE for source in item.virtual_sources())
    return bool(item.external)


def _other_file_error(name: str) -> UserError:
    return UserError("is in another file", place=name, remedy="Write it into this file")
