"""Frequency responses from named arrays: which array, or which place along its axes, is which response."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from balance_cli.importers.frf.functions import Array, CoherenceFunction, ComplexArray, FrfFunction, Terminal
from balance_cli.importers.frf.variables import Variables
from balance_cli.io.errors import UserError
from balance_cli.io.units import FREQUENCY, parse_unit

AXES = ("line", "response", "reference")


@dataclass(frozen=True)
class NamedPair:
    """One response over one reference: a complex array, or two real ones.

    `parts` are the names of the arrays: the complex one, real and imaginary part, or magnitude and phase. `form` says
    which (`complex`, `parts`, `polar`); `in_decibel` that the magnitude is in dB, `phase_factor` the radians for one
    unit of the phase.
    """

    response: str
    reference: str
    parts: tuple[str, ...]
    form: str
    coherence: str | None = None
    in_decibel: bool = False
    phase_factor: float = 1.0


@dataclass(frozen=True)
class NamedArray:
    """Many responses over many references in one array (or real and imaginary part), in the order of the names.

    `axes` is the order of AXES; None where the lengths tell it.
    """

    parts: tuple[str, ...]
    responses: tuple[str, ...]
    references: tuple[str, ...]
    axes: tuple[str, ...] | None = None
    coherence: str | None = None


def frequency_axis(variables: Variables, name: str, unit: str | None) -> Array:
    """Return the frequencies [Hz] in the array of this name; `unit` is by default that of the file, or Hz."""
    stated = unit or variables.units.get(name) or FREQUENCY
    try:
        factor = parse_unit(stated, FREQUENCY).factor
    except UserError as error:
        raise error.with_location(place=f"variable {name}") from error
    values = _array(variables, name)
    if values.ndim != 1 or np.iscomplexobj(values):
        raise UserError("is no vector of frequencies", place=f"variable {name}", remedy="Correct `frequency`")
    return np.asarray(values.astype(np.float64) * factor)


def functions_of_pair(
    variables: Variables, frequency: Array, pair: NamedPair
) -> tuple[FrfFunction, CoherenceFunction | None]:
    """Return the response of a pair, and its coherence where there is one."""
    arrays = [_vector(variables, name, len(frequency)) for name in pair.parts]
    response_unit, reference_unit = _quotient(variables.units.get(pair.parts[0], "") if not pair.in_decibel else "")
    response = Terminal((pair.response,), response_unit)
    reference = Terminal((pair.reference,), reference_unit)
    resolution = max(variables.resolution(name) for name in pair.parts)
    place = f"variable {pair.parts[0]}"
    value = _complex_value(arrays, pair)
    function = FrfFunction(response, reference, frequency, value, resolution, place)
    if pair.coherence is None:
        return function, None
    coherence = _vector(variables, pair.coherence, len(frequency)).real.astype(np.float64)
    return function, CoherenceFunction(response, reference, frequency, coherence, f"variable {pair.coherence}")


def functions_of_array(
    variables: Variables, frequency: Array, named: NamedArray
) -> Iterator[tuple[FrfFunction, CoherenceFunction | None]]:
    """Yield the responses of an array in the order of its references and responses, each with its coherence."""
    value = _ordered(variables, named.parts[0], len(frequency), named).astype(complex)
    if len(named.parts) == 2:
        value = value + 1j * _ordered(variables, named.parts[1], len(frequency), named)
    elif not np.iscomplexobj(variables.arrays[named.parts[0]]):
        raise _no_phase_error(named.parts[0])
    coherence = None if named.coherence is None else _ordered(variables, named.coherence, len(frequency), named).real
    response_unit, reference_unit = _quotient(variables.units.get(named.parts[0], ""))
    resolution = max(variables.resolution(name) for name in named.parts)
    for j, reference_name in enumerate(named.references):
        for i, response_name in enumerate(named.responses):
            response, reference = Terminal((response_name,), response_unit), Terminal((reference_name,), reference_unit)
            place = f"variable {named.parts[0]}"
            function = FrfFunction(response, reference, frequency, value[:, i, j], resolution, place)
            beside = None
            if coherence is not None:
                beside = CoherenceFunction(response, reference, frequency, coherence[:, i, j], place)
            yield function, beside


def _complex_value(arrays: Sequence[NDArray[Any]], pair: NamedPair) -> ComplexArray:
    if pair.form == "complex":
        if not np.iscomplexobj(arrays[0]):
            raise _no_phase_error(pair.parts[0])
        return np.asarray(arrays[0], complex)
    first, second = (np.asarray(array, np.float64) for array in arrays)
    if pair.form == "parts":
        return np.asarray(first + 1j * second)
    if pair.in_decibel:
        first = 10.0 ** (first / 20.0)
    elif np.any(first < 0.0):
        remedy = "Export it linear, or state `magnitude_unit: dB`"
        raise UserError("is a magnitude with negative values", place=f"variable {pair.parts[0]}", remedy=remedy)
    return np.asarray(first * np.exp(1j * pair.phase_factor * second))


def _no_phase_error(name: str) -> UserError:
    remedy = "Export complex values, or name `real` and `imaginary`, or `magnitude` and `phase`"
    return UserError("is real, and has no phase", place=f"variable {name}", remedy=remedy)


def _array(variables: Variables, name: str) -> NDArray[Any]:
    if name not in variables.arrays:
        known = ", ".join(list(variables.arrays)[:30])
        raise UserError(f"has no variable `{name}`", str(variables.path), remedy=f"It has {known}")
    return variables.arrays[name]


def _vector(variables: Variables, name: str, lines: int) -> NDArray[Any]:
    values = _array(variables, name)
    if values.shape != (lines,):
        fault = f"has the shape {values.shape}, where {lines} frequencies were read"
        raise UserError(fault, place=f"variable {name}", remedy="Name a vector with one value a frequency")
    return values


def _ordered(variables: Variables, name: str, lines: int, named: NamedArray) -> NDArray[Any]:
    """Return an array as (lines, responses, references), axes of length one included."""
    values = _array(variables, name)
    wanted = {"line": lines, "response": len(named.responses), "reference": len(named.references)}
    axes = named.axes or _axes_by_length(values.shape, wanted, name)
    # An axis of length one may have been dropped by the file.
    kept = tuple(axis for axis in axes if wanted[axis] > 1)
    if values.shape != tuple(wanted[axis] for axis in kept):
        counted = ", ".join(f"{wanted[axis]} {axis}s" for axis in axes)
        fault = f"has the shape {values.shape}, where the map has {counted}"
        raise UserError(fault, place=f"variable {name}", remedy="Correct `axes`, `responses` or `references`")
    order = [kept.index(axis) for axis in AXES if axis in kept]
    return np.transpose(values, order).reshape(tuple(wanted[axis] for axis in AXES))


def _axes_by_length(shape: tuple[int, ...], wanted: dict[str, int], name: str) -> tuple[str, ...]:
    """Return the order of the axes that the lengths allow. Raises UserError where they allow several or none."""
    lengths = [wanted[axis] for axis in AXES if wanted[axis] > 1]
    if sorted(lengths) != sorted(shape):
        counted = ", ".join(f"{length} {axis}s" for axis, length in wanted.items())
        fault = f"has the shape {shape}, where there are {counted}"
        raise UserError(fault, place=f"variable {name}", remedy="Correct `responses` or `references`")
    if len(set(lengths)) < len(lengths):
        fault = f"has axes of equal length ({', '.join(map(str, shape))})"
        remedy = "State `axes`, such as [line, response, reference]"
        raise UserError(fault, place=f"variable {name}", remedy=remedy)
    axis_of = {wanted[axis]: axis for axis in AXES if wanted[axis] > 1}
    single = [axis for axis in AXES if wanted[axis] <= 1]
    return (*(axis_of[length] for length in shape), *single)


def _quotient(text: str) -> tuple[str, str]:
    """Return the units above and below the last stroke of a unit: `V/N`, `mV/V/N`, `(m/s2)/N`."""
    above, stroke, below = text.strip().rpartition("/")
    if not stroke:
        return "", ""
    return above.strip().removeprefix("(").removesuffix(")"), below.strip().removeprefix("(").removesuffix(")")
