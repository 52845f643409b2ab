"""Which functions of the files are those of the map: one for each channel over each reference."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch

from balance_cli.campaign.recording.frf_map import FrfMap, MappedArray, MappedPair
from balance_cli.importers.frf.functions import CoherenceFunction, FrfFile, FrfFunction, Terminal
from balance_cli.importers.frf.mapped_functions import (
    NamedArray,
    NamedPair,
    frequency_axis,
    functions_of_array,
    functions_of_pair,
)
from balance_cli.importers.frf.variables import Variables
from balance_cli.io.errors import UserError


@dataclass(frozen=True)
class MatchedFunction:
    """A function with the names of its response and its reference in the map; `file` is that which holds it."""

    response: str
    reference: str
    function: FrfFunction
    coherence: CoherenceFunction | None
    file: str


def match_functions(
    mapping: FrfMap, sources: Sequence[FrfFile | Variables]
) -> tuple[tuple[MatchedFunction, ...], tuple[str, ...]]:
    """Return the functions of the map, and notes on what of the files is not in it.

    Raises UserError where a response or a reference of the map has no function, or a pair has several.
    """
    files = [source if isinstance(source, FrfFile) else _file_of_arrays(mapping, source) for source in sources]
    matched: dict[tuple[str, str], MatchedFunction] = {}
    unknown: dict[str, None] = {}
    for file in files:
        coherences = _coherences(mapping, file)
        for function in file.functions:
            response = _name_in_map(function.response, mapping.responses, "responses")
            reference = _name_in_map(function.reference, mapping.references, "references")
            if response is None or reference is None:
                unknown[f"{function.response.name} over {function.reference.name}"] = None
                continue
            key = (response, reference)
            if key in matched:
                fault = f"has a second function of `{response}` over `{reference}` ({function.place})"
                before = matched[key]
                remedy = f"Import one level or run at a time; the first is {before.function.place} of {before.file}"
                raise UserError(fault, str(file.path), remedy=remedy)
            matched[key] = MatchedFunction(response, reference, function, coherences.get(key), str(file.path))
    _require_all(mapping, matched, files)
    notes = [f"{file.path.name}: {note}" for file in files for note in file.notes]
    if unknown:
        shown = ", ".join(list(unknown)[:6]) + (f" and {len(unknown) - 6} more" if len(unknown) > 6 else "")
        notes.append(f"not in the map, and not used: {shown}")
    return tuple(matched.values()), tuple(notes)


def _coherences(mapping: FrfMap, file: FrfFile) -> Mapping[tuple[str, str], CoherenceFunction]:
    named = {}
    for item in file.coherences:
        response = _name_in_map(item.response, mapping.responses, "responses")
        reference = _name_in_map(item.reference, mapping.references, "references")
        if response is not None and reference is not None:
            named[response, reference] = item
    return named


def _name_in_map(terminal: Terminal, names: Mapping[str, object], key: str) -> str | None:
    """Return the key of the map that names a terminal, None where there is none; UserError where several do."""
    found = [name for name in names if name in terminal.names]
    if len(found) > 1:
        fault = f"`{found[0]}` and `{found[1]}` are both `{terminal.name}`"
        raise UserError(fault, place=key, remedy=f"Write it as one of {', '.join(terminal.names)}")
    return found[0] if found else None


def _require_all(mapping: FrfMap, matched: Mapping[tuple[str, str], MatchedFunction], files: Sequence[FrfFile]) -> None:
    """Raise UserError where no function has a name of the map, or none has it together with another one of the map."""
    functions = [function for file in files for function in file.functions]
    for key, names, terminals, place in (
        ("references", mapping.references, [function.reference for function in functions], 1),
        ("responses", mapping.responses, [function.response for function in functions], 0),
    ):
        for name in names:
            if any(pair[place] == name for pair in matched):
                continue
            known = ", ".join(list(dict.fromkeys(terminal.name for terminal in terminals))[:30])
            if any(name in terminal.names for terminal in terminals):
                other = "responses" if place else "references"
                fault, known = f"`{name}` has no function with one of the {other} of the map", f"Correct `{other}`"
            else:
                fault, known = f"no function has the {key.removesuffix('s')} `{name}`", f"The files have {known}"
            raise UserError(fault, place=key, remedy=known)


def _file_of_arrays(mapping: FrfMap, variables: Variables) -> FrfFile:
    """Return the functions of named arrays, by `pairs` and `arrays` of the map."""
    functions: list[FrfFunction] = []
    coherences: list[CoherenceFunction] = []
    try:
        for function, coherence in _named_functions(mapping, variables):
            functions.append(function)
            coherences += [] if coherence is None else [coherence]
        if not functions:
            remedy = "Add entries to `pairs` or `arrays` of the map whose `file` fits its name"
            raise UserError("has no entry in the map that says what its arrays are", remedy=remedy)
    except UserError as error:
        raise error.with_location(file=str(variables.path)) from error
    return FrfFile(variables.path, variables.format, tuple(functions), tuple(coherences))


def _named_functions(mapping: FrfMap, variables: Variables) -> Iterator[tuple[FrfFunction, CoherenceFunction | None]]:
    pairs = [item for item in mapping.pairs if fnmatch(variables.path.name, item.file)]
    arrays = [item for item in mapping.arrays if fnmatch(variables.path.name, item.file)]
    if not pairs and not arrays:
        return
    assert mapping.frequency is not None  # the map requires it beside pairs and arrays
    frequency = frequency_axis(variables, mapping.frequency, mapping.frequency_unit)
    for pair in pairs:
        yield functions_of_pair(variables, frequency, _named_pair(pair, mapping))
    for array in arrays:
        yield from functions_of_array(variables, frequency, _named_array(array))


def _named_pair(pair: MappedPair, mapping: FrfMap) -> NamedPair:
    if pair.value is not None:
        return NamedPair(pair.response, pair.reference, (pair.value,), "complex", pair.coherence)
    if pair.real is not None and pair.imaginary is not None:
        return NamedPair(pair.response, pair.reference, (pair.real, pair.imaginary), "parts", pair.coherence)
    assert pair.magnitude is not None and pair.phase is not None  # the map requires one of the three
    return NamedPair(
        pair.response,
        pair.reference,
        (pair.magnitude, pair.phase),
        "polar",
        pair.coherence,
        in_decibel=mapping.magnitude_unit == "dB",
        phase_factor=math.pi / 180.0 if mapping.phase_unit == "deg" else 1.0,
    )


def _named_array(array: MappedArray) -> NamedArray:
    parts = tuple(name for name in (array.value, array.real, array.imaginary) if name is not None)
    return NamedArray(parts, array.responses, array.references, array.axes, array.coherence)
