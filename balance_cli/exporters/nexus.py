"""Results as HDF5 with NeXus attributes, so that silx, h5web and other viewers plot them when they are opened."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from balance_cli.exporters.cubes import Cube, Variable


def nexus_bytes(cubes: Sequence[Cube], title: str) -> bytes:
    """Return an HDF5 file with an NXentry for each cube, and in it an NXdata for each curve of its signal.

    An NXdata has `signal` and `axes`, with `_errors` where there is a sigma. Beside them the group `all` holds every
    variable over all its axes; the root and the entries name what is shown first (`default`).
    """
    import h5py

    buffer = io.BytesIO()
    with h5py.File(buffer, "w", track_order=False) as file:
        names = [_member(cube.name) for cube in cubes]
        file.attrs.update({"NX_class": "NXroot", "default": names[0], "creator": "balance-cli"})
        for name, cube in zip(names, cubes, strict=True):
            _write_entry(file.create_group(name), cube, title)
    return buffer.getvalue()


def _member(name: str) -> str:
    """Return the name of a group: what NeXus and paths within a file do not allow becomes an underscore."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", name) or "_"


def _write_entry(entry: Any, cube: Cube, title: str) -> None:
    entry.attrs["NX_class"] = "NXentry"
    entry["title"] = f"{title}, {cube.name}"
    for name, value in cube.about.items():
        entry[name] = value
    groups = [_write_curve(entry, cube, index, str(value)) for index, value in _curves(cube)]
    entry.attrs["default"] = groups[0]
    everything = entry.create_group("all")
    everything.attrs["NX_class"] = "NXcollection"
    for name, variable in {**cube.coordinates, **cube.variables}.items():
        _write_variable(everything, name, variable)


def _curves(cube: Cube) -> list[tuple[dict[str, int], str]]:
    """Return for each curve of the signal its index on the other axes, and its name."""
    others = [axis for axis in cube.variables[cube.signal].axes if axis != cube.abscissa]
    shape = [len(cube.coordinates[axis].values) for axis in others]
    curves = []
    for index in np.ndindex(*shape):
        at = dict(zip(others, index, strict=True))
        curves.append((at, "_".join(str(cube.coordinates[axis].values[i]) for axis, i in at.items())))
    return curves


def _write_curve(entry: Any, cube: Cube, index: dict[str, int], name: str) -> str:
    group = entry.create_group(_member(name))
    group.attrs.update({"NX_class": "NXdata", "signal": cube.signal, "axes": [cube.abscissa]})
    signal, abscissa = cube.variables[cube.signal], cube.coordinates[cube.abscissa]
    group["title"] = f"{cube.name}: {name}"
    _write_variable(group, cube.abscissa, abscissa)
    _write_variable(group, cube.signal, _at(signal, index), _unit_at(cube, index, signal.unit))
    if signal.sigma:
        _write_variable(group, f"{cube.signal}_errors", _at(cube.variables[signal.sigma], index))
    if cube.abscissa != "frequency" and "frequency" in cube.coordinates:
        _write_variable(group, "frequency", cube.coordinates["frequency"])
    return str(group.name).rpartition("/")[2]


def _unit_at(cube: Cube, index: dict[str, int], unit: str) -> str:
    """Return the unit of a curve, where the cube has one for each component."""
    if "unit" in cube.coordinates and "component" in index:
        return str(cube.coordinates["unit"].values[index["component"]])
    return unit


def _at(variable: Variable, index: dict[str, int]) -> Variable:
    """Return a variable at an index of some of its axes."""
    values = variable.values[tuple(index.get(axis, slice(None)) for axis in variable.axes)]
    return Variable(tuple(axis for axis in variable.axes if axis not in index), values, variable.unit, variable.sigma)


def _write_variable(group: Any, name: str, variable: Variable, unit: str = "") -> None:
    import h5py

    is_text = variable.values.dtype == object
    kind = h5py.string_dtype() if is_text else variable.values.dtype
    dataset = group.create_dataset(name, data=variable.values, dtype=kind)
    if unit or variable.unit:
        dataset.attrs["units"] = unit or variable.unit
