"""Results as MATLAB files, version 5: a struct for each run, or the columns of the table."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from balance_cli.exporters.cubes import Cube

if TYPE_CHECKING:
    import pandas as pd

LONGEST_NAME = 63
"""Characters of a name in MATLAB (`namelengthmax`)."""


def mat_bytes(cubes: Sequence[Cube], table: pd.DataFrame) -> bytes:
    """Return the cubes as structs with the names of the runs, else the table as one struct `table`.

    A variable has the axes that the field `axes` of its struct names; text is a cell array.
    """
    from scipy.io import savemat

    content = {matlab_name(cube.name): _struct(cube) for cube in cubes}
    if not content:
        content = {"table": {matlab_name(str(name)): _cells(table[name].to_numpy()) for name in table.columns}}
    buffer = io.BytesIO()
    savemat(buffer, content, long_field_names=True, oned_as="column")  # type: ignore[arg-type]  # the stubs know names only
    return buffer.getvalue()


def matlab_name(name: str) -> str:
    """Return a valid MATLAB name: letters, digits and underscores, a letter first."""
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return (plain if plain[:1].isalpha() else f"x{plain}")[:LONGEST_NAME]


def _struct(cube: Cube) -> dict[str, Any]:
    """Return a cube as a struct."""
    everything = {**cube.coordinates, **cube.variables}
    fields = {matlab_name(name): _cells(variable.values) for name, variable in everything.items()}
    axes = {matlab_name(name): ", ".join(variable.axes) for name, variable in everything.items()}
    units = {matlab_name(name): variable.unit for name, variable in everything.items() if variable.unit}
    return {"name": cube.name, **fields, "axes": axes, "units": units, "about": dict(cube.about)}


def _cells(values: Any) -> Any:
    """Return text as an object array, which becomes a cell array."""
    array = np.asarray(values)
    if array.dtype.kind in "OUS":
        cells = np.empty(array.shape, object)
        cells[...] = [str(value) for value in array] if array.ndim == 1 else array.astype(str)
        return cells
    return array
