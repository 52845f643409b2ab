"""Results as xarray datasets, and as netCDF files; xarray is optional."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from balance_cli.exporters.cubes import Cube, Variable, cubes_of
from balance_cli.io.errors import UserError


def to_xarray(content: object) -> dict[str, Any]:
    """Return loads, spectra or frequency responses as {run: xarray.Dataset}.

    Axes are coordinates, units are the attribute `units`. Raises UserError where xarray is not installed, or for
    another result.
    """
    cubes = cubes_of(content)
    if not cubes:
        raise UserError("only loads, spectra and frequency responses are datasets", remedy="Use `to_frame`")
    return {cube.name: _dataset(cube) for cube in cubes}


def netcdf_bytes(cubes: Sequence[Cube]) -> bytes:
    """Return a cube as netCDF (version 3, which any reader of netCDF knows), complex values as two variables.

    Raises UserError for several runs: a netCDF file holds one set of axes.
    """
    if len(cubes) != 1:
        fault = f"holds {len(cubes)} runs, where a netCDF file holds one"
        raise UserError(fault, remedy="Reduce one run, or export to .h5")
    return bytes(_dataset(cubes[0], split=True).to_netcdf(None, engine="scipy"))


def _dataset(cube: Cube, split: bool = False) -> Any:
    try:
        import xarray
    except ImportError as error:
        raise UserError("needs the package xarray", remedy="Install it: pip install xarray") from error
    variables = dict(cube.variables)
    if split:
        variables = {part: values for name, variable in variables.items() for part, values in _parts(name, variable)}
    coordinates = {name: _array(variable) for name, variable in cube.coordinates.items()}
    return xarray.Dataset({name: _array(item) for name, item in variables.items()}, coordinates, dict(cube.about))


def _array(variable: Variable) -> tuple[tuple[str, ...], Any, dict[str, str]]:
    values = variable.values.astype(str) if variable.values.dtype == object else variable.values
    return variable.axes, values, {"units": variable.unit} if variable.unit else {}


def _parts(name: str, variable: Variable) -> list[tuple[str, Variable]]:
    """Return a variable, or the two parts of a complex one."""
    if not np.iscomplexobj(variable.values):
        return [(name, variable)]
    real = Variable(variable.axes, variable.values.real, variable.unit)
    return [(f"{name}_real", real), (f"{name}_imag", Variable(variable.axes, variable.values.imag, variable.unit))]
