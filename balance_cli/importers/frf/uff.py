"""Frequency responses and coherences of universal files: datasets 58 and 58b of function types 4 and 6."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from balance_cli.importers.base import damage_error
from balance_cli.importers.frf.functions import Array, CoherenceFunction, ComplexArray, FrfFile, FrfFunction, Terminal
from balance_cli.importers.uff import (
    DIRECTIONS,
    FUNCTION_TYPES,
    NAME,
    TIME_RESPONSE,
    DataForm,
    Layout58,
    data_form,
    datasets,
    split_axis,
)
from balance_cli.io.errors import UserError

FREQUENCY_RESPONSE, COHERENCE = 4, 6
FREQUENCY_ABSCISSA = 18
QUANTITIES = {8: "a displacement", 9: "a force", 11: "a velocity", 12: "an acceleration", 13: "a force"}
"""Specific data types of an axis that say what was measured; the others leave it open."""
SINGLE_BITS, DOUBLE_BITS = 24, 53
SINGLE_DIGITS, DOUBLE_DIGITS = 5, 12
"""Decimals of a number in text: E13.5 and E20.12."""
TEXT_WIDTHS = {(False, True): (13,), (False, False): (13,), (True, True): (20,), (True, False): (13, 20, 20)}
"""Characters of the numbers of a line, repeated: by whether they are double and the abscissa is even."""


def open_uff(path: Path) -> FrfFile:
    """Read the frequency responses and coherences; other functions are named in the notes.

    Raises UserError where there is no frequency response, or the file is damaged.
    """
    functions: list[FrfFunction] = []
    coherences: list[CoherenceFunction] = []
    others: Counter[str] = Counter()
    with path.open("rb") as file:
        found = [item for item in datasets(file, path.stat().st_size) if item[1].startswith("58")]
    for number, _, header, where in found:
        form, place = data_form(header), f"dataset {number}"
        if form.function not in (FREQUENCY_RESPONSE, COHERENCE):
            known = 0 <= form.function < len(FUNCTION_TYPES)
            others[FUNCTION_TYPES[form.function] if known else f"a function of type {form.function}"] += 1
            continue
        frequency, value = _numbers(path, where, form, header)
        response, reference = _terminal(header, 31, 8), _terminal(header, 56, 9)
        if form.function == COHERENCE:
            coherences.append(CoherenceFunction(response, reference, frequency, value.real, place))
        elif not form.is_complex:
            fault = "holds a frequency response of real numbers, which has no phase"
            raise UserError(fault, place=place, remedy="Export it as complex (ordinate type 5 or 6)")
        else:
            functions.append(FrfFunction(response, reference, frequency, value, _resolution(form, where), place))
    if not functions:
        raise _no_response_error(others)
    notes = [f"not used: {', '.join(f'{text} ({count})' for text, count in others.items())}"] if others else []
    return FrfFile(path, NAME, tuple(functions), tuple(coherences), tuple(notes))


def _no_response_error(others: Counter[str]) -> UserError:
    shown = ", ".join(others) or "no dataset 58"
    if FUNCTION_TYPES[TIME_RESPONSE] in others:
        return UserError(f"has no frequency response, but {shown}", remedy="Use `balance import` for time records")
    return UserError(f"has no frequency response, but {shown}", remedy="Export functions of type 4 as dataset 58")


def _terminal(header: list[str], column: int, axis: int) -> Terminal:
    """The response (from column 31, axis in record 9) or the reference (56, record 10) of a function."""
    entity, node, code = (
        header[5][column + first : column + last].strip() for first, last in ((0, 10), (10, 20), (20, 24))
    )
    is_direction = code.lstrip("-").isdigit()
    direction = DIRECTIONS.get(int(code), "") if is_direction else ""
    label, unit = split_axis(header[axis])
    place = "" if node in ("", "0") else f"{node}{direction}"
    entity, label = ("" if text in ("NONE", "") else text for text in (entity, label))
    joined = f"{entity}:{place}" if entity and place else ""
    names = tuple(dict.fromkeys(name for name in (joined, place, entity, label) if name))
    kind = header[axis][:10].strip()
    quantity = QUANTITIES.get(int(kind), "") if kind.isdigit() else ""
    return Terminal(names or ("without a name",), unit, quantity, direction)


def _resolution(form: DataForm, where: Layout58) -> float:
    """Relative rounding of the numbers."""
    if where.order:
        return float(2.0 ** -(DOUBLE_BITS if form.is_double else SINGLE_BITS))
    return float(0.5 * 10.0 ** -(DOUBLE_DIGITS if form.is_double else SINGLE_DIGITS))


def _numbers(path: Path, where: Layout58, form: DataForm, header: list[str]) -> tuple[Array, ComplexArray]:
    """Return abscissas (k,) [Hz] and ordinates (k,)."""
    abscissa = header[7][:10].strip()
    if abscissa.isdigit() and int(abscissa) not in (0, FREQUENCY_ABSCISSA):
        fault = f"is a function whose abscissa is of type {abscissa}, not a frequency"
        raise UserError(fault, str(path), "dataset 58", "Export functions over frequency")
    parts = (2 if form.is_complex else 1) + (not form.is_even)
    values = _stored_numbers(path, where, form, form.count * parts).reshape(form.count, parts)
    if form.is_even:
        frequency = form.first + float(form.increment) * np.arange(form.count)
    else:
        frequency, values = values[:, 0], values[:, 1:]
    ordinate = values[:, 0] + 1j * values[:, 1] if form.is_complex else values[:, 0].astype(complex)
    return np.asarray(frequency), np.asarray(ordinate)


def _stored_numbers(path: Path, where: Layout58, form: DataForm, count: int) -> Array:
    """Return all numbers of a dataset, abscissas included."""
    with path.open("rb") as file:
        file.seek(where.offset)
        content = file.read(where.size)
    if where.order:
        values = np.frombuffer(content, f"{where.order}f{8 if form.is_double else 4}")
        if len(values) < count:
            raise damage_error("binary data end early")
        return values[:count].astype(np.float64)
    text = content.replace(b"D", b"E").replace(b"d", b"e")
    words = text.split()
    if len(words) != count:  # numbers may touch each other
        words = _cut_lines(text, TEXT_WIDTHS[form.is_double, form.is_even])
    if len(words) != count:
        raise damage_error(f"{len(words)} numbers where the header announces {count}")
    try:
        return np.array(words, dtype="S32").astype(np.float64)
    except ValueError as error:
        raise damage_error(error) from error


def _cut_lines(text: bytes, widths: tuple[int, ...]) -> list[bytes]:
    """Return the numbers in columns of fixed widths, which repeat."""
    words = []
    for line in text.splitlines():
        start, column = 0, 0
        rest = line.rstrip(b"\r ")
        while start < len(rest):
            width = widths[column % len(widths)]
            words.append(rest[start : start + width].strip())
            start, column = start + width, column + 1
    return words
