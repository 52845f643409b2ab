"""Named arrays of a file, complex ones among them: variables of MAT, datasets of HDF5, columns of tables."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from balance_cli.importers import hdf5, mat, open_foreign
from balance_cli.importers.base import SNIFFED_BYTES, TextLayout, damage_error, errors_as_damage
from balance_cli.importers.mat_elements import examine_elements
from balance_cli.importers.mat_members import members
from balance_cli.importers.matlab_members import CLASS, stored_members
from balance_cli.io.errors import UserError
from balance_cli.io.hdf5_links import keeps_values_elsewhere
from balance_cli.io.reader_process import read_in_child
from balance_cli.io.sniff import attribute_text
from balance_cli.io.text_numbers import is_complex

NUMBERS = "iufc"
"""Kinds of numpy types that hold numbers."""
MOST_DATASETS = 10_000
TEXT_RESOLUTION = 0.5e-5
"""Relative rounding of numbers in text, as with six digits; how many a table has is not known."""
REAL_PARTS, IMAGINARY_PARTS = ("real", "r", "re"), ("imag", "i", "im")
"""Names of the two parts of a compound of HDF5: those of MATLAB and h5py."""


@dataclass(frozen=True)
class Variables:
    """Arrays of a file by name, without axes of length one; `units` are those that the file states."""

    path: Path
    format: str
    arrays: dict[str, NDArray[Any]]
    units: dict[str, str]

    def resolution(self, name: str) -> float:
        """Return the relative rounding of the numbers of an array."""
        if self.format not in (mat.NAME, hdf5.NAME):
            return TEXT_RESOLUTION
        kind = self.arrays[name].dtype
        return float(np.finfo(kind).eps) / 2.0 if kind.kind in "fc" else 0.0


def open_variables(path: Path, layout: TextLayout) -> Variables:
    """Read all arrays of numbers of a file. Raises UserError where there are none, or the file is damaged."""
    with path.open("rb") as file:
        head = file.read(SNIFFED_BYTES)
    if mat.sniff(path, head):
        variables = _mat_variables(path)
    elif hdf5.sniff(path, head):
        variables = _hdf5_variables(path)
    else:
        variables = _table_variables(path, layout)
    if not variables.arrays:
        raise UserError("has no arrays of numbers", remedy="Save frequency and responses as arrays")
    return variables


def _mat_variables(path: Path) -> Variables:
    from scipy.io import loadmat
    from scipy.io.matlab import matfile_version

    with errors_as_damage(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if matfile_version(str(path))[0] == 1:
            examine_elements(path)
        content = loadmat(str(path), struct_as_record=True)
    arrays: dict[str, NDArray[Any]] = {}
    units: dict[str, str] = {}
    for name, value in content.items():
        if name.startswith("__") or not isinstance(value, np.ndarray):
            continue
        for member in members(name, value):
            array = np.asarray(member.values)
            if array.dtype.kind in NUMBERS and array.size > 1:
                arrays[member.name] = np.squeeze(array)
                units[member.name] = member.unit
    return Variables(path, mat.NAME, arrays, {name: unit for name, unit in units.items() if unit})


@read_in_child
def _hdf5_variables(path: Path) -> Variables:
    import h5py

    arrays: dict[str, NDArray[Any]] = {}
    units: dict[str, str] = {}
    found: dict[str, Any] = {}
    classes: list[str] = []

    def visit(name: str, item: Any) -> None:
        if keeps_values_elsewhere(item):
            raise UserError("has its values in another file", place=name, remedy="Write them into this file")
        classes.extend([name] if CLASS in item.attrs else [])
        if isinstance(item, h5py.Dataset) and not name.startswith(hdf5.MATLAB_HIDDEN) and len(found) < MOST_DATASETS:
            found[name] = item

    try:
        with h5py.File(path, "r") as file:
            file.visititems(visit)
            if classes:
                variables = ((name, file[name]) for name in file if name not in hdf5.MATLAB_HIDDEN)
                listed = [(part.name, part.item, part.unit) for item in variables for part in stored_members(*item)]
            else:
                listed = [(name, item, "") for name, item in found.items()]
            for name, item, unit in listed:
                array = _complex_array(item[()])
                if array.dtype.kind in NUMBERS and array.size > 1:
                    arrays[name] = np.squeeze(array.T if classes else array)  # MATLAB stores its arrays transposed
                    stated = _stated_unit(item)
                    units |= {name: unit or stated} if unit or stated else {}
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise damage_error(error) from error
    return Variables(path, hdf5.NAME, arrays, units)


def _stated_unit(item: Any) -> str:
    """Return the unit among the attributes of a dataset, empty where there is none."""
    texts = (attribute_text(item.attrs.get(key)) for key in hdf5.UNIT_ATTRIBUTES)
    return next((text for text in texts if text), "")


def _complex_array(values: Any) -> NDArray[Any]:
    """Return values as an array; a compound of two parts that are named so is complex."""
    array = np.asarray(values)
    fields = array.dtype.names or ()
    real, imaginary = (
        next((field for field in fields if field in names), None) for names in (REAL_PARTS, IMAGINARY_PARTS)
    )
    if real is None or imaginary is None or len(fields) != 2:
        return array
    return np.asarray(array[real] + 1j * array[imaginary])


def _table_variables(path: Path, layout: TextLayout) -> Variables:
    opened = open_foreign(path, layout)
    arrays: dict[str, NDArray[Any]] = {}
    units: dict[str, str] = {}
    for group in opened.groups:
        if group.unusable:
            continue
        values = group.read(range(len(group.channels)), 0, group.samples)
        for column, channel in enumerate(group.channels):
            arrays[channel.name] = values[:, column]
            units |= {channel.name: channel.unit} if channel.unit else {}
    arrays |= {name: array for name, read in opened.labels.items() if (array := _complex_numbers(read())) is not None}
    return Variables(path, opened.format, arrays, units)


def _complex_numbers(cells: Sequence[str]) -> NDArray[np.complex128] | None:
    """Return the complex numbers of a column of text; None where a cell is none."""
    if not all(map(is_complex, cells)):
        return None
    return np.array([complex(re.sub(r"[\s()]", "", cell).replace("i", "j")) for cell in cells])
