"""Array classes and data types in a MAT file of versions 5 to 7, examined before scipy reads them.

scipy looks both up in tables without testing that they have such an entry, so that a damaged one ends the process.
Source: MAT-File Format, The MathWorks, R2023b, tables 1-1 and 1-3.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from balance_cli.io.errors import UserError

HEADER_BYTES = 128
ALIGNMENT = 8
"""Bytes of whose multiple an element is; the last one of a file may lack those that fill it up."""
MATRIX, COMPRESSED = 14, 15
VALUE_TYPES = frozenset({1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18})
"""Integers of 8 to 64 bits, single, double, and text as UTF-8, 16 and 32."""
LARGEST_CLASS, SPARSE, OBJECT, NUMBERS = 18, 5, 17, range(4, 16)
"""Array classes: from 1, cell, to functions and objects; `NUMBERS` hold text, a sparse matrix or numbers."""
COMPLEX = 0x800
DEEPEST_ELEMENT = 32
"""Levels of matrices within matrices: a structure in a cell of a structure is three."""
BLOCK_BYTES = 1 << 16

Advance = Callable[[int], bytes]


def examine_elements(path: Path) -> None:
    """Raise ValueError where an array has a class or an element a data type that the format does not define.

    Also where the file ends within a variable, which scipy would not list.
    """
    length = path.stat().st_size
    with path.open("rb") as file:
        order = "<" if file.read(HEADER_BYTES)[126:128] == b"IM" else ">"
        while len(tag := file.read(8)) == 8:
            kind, size = struct.unpack(f"{order}II", tag)
            end = file.tell() + size
            if end >= length + ALIGNMENT:
                raise ValueError(f"it ends within a variable, {end - length} bytes early")
            if kind == COMPRESSED:
                _examine(*_inflated(file, size), 1 << 62, order, 0)
            elif kind == MATRIX:
                _examine(file.read, lambda count: file.seek(count, 1), size, order, 1)
            else:
                raise ValueError(f"byte {file.tell() - 8}: no variable, but data type {kind}")
            file.seek(end)


def _examine(read: Advance, skip: Callable[[int], object], size: int, order: str, depth: int) -> None:
    """Examine the elements within the next `size` bytes: those of a matrix, or a compressed one at depth 0."""
    if depth > DEEPEST_ELEMENT:
        raise ValueError(f"matrices within matrices, more than {DEEPEST_ELEMENT} levels deep")
    expected = 0
    if depth > 0 and size >= 16:
        expected = _expected_elements(read(16), order, depth)
        size -= 16
    values = 0
    while size >= 8 and len(tag := read(8)) == 8:
        kind, count = struct.unpack(f"{order}II", tag)
        size -= 8
        if kind >> 16:  # a small element: its tag holds type, size and up to four bytes
            kind, count = kind & 0xFFFF, 0
        if kind == MATRIX and not expected:
            _examine(read, skip, min(count, size), order, depth + 1)
        elif depth == 0 or kind not in VALUE_TYPES:
            raise ValueError(f"an element of data type {kind}, which does not belong there")
        else:
            values += 1
            count += -count % 8
            skip(min(count, size))
        size -= count
    if depth > 0 and size <= 0 and values < expected:
        raise ValueError(f"a matrix of {values} elements, where its class has {expected}")
    if depth > 0:
        skip(max(size, 0))


def _expected_elements(flags: bytes, order: str, depth: int) -> int:
    """Return how many elements a matrix of numbers has at least, by its array flags; 0 for others.

    Raises UserError for an object as a variable, of which scipy lists nothing, nor of the variables beside it.
    """
    if len(flags) < 16:
        return 0
    word = struct.unpack(f"{order}4I", flags)[2]
    number = word & 0xFF
    if not 1 <= number <= LARGEST_CLASS:
        raise ValueError(f"a matrix of class {number}, which does not exist")
    if number == OBJECT and depth == 1:
        remedy = "Save their values as arrays (x = ts.Data, t = ts.Time), in a file without the objects"
        raise UserError("holds objects of MATLAB, such as a timeseries or a table, which cannot be read", remedy=remedy)
    if number not in NUMBERS:
        return 0
    return (5 if number == SPARSE else 3) + bool(word & COMPLEX)


def _inflated(file: BinaryIO, size: int) -> tuple[Advance, Advance]:
    """Return `read` and `skip` of the next `size` bytes, uncompressed in blocks."""
    stream, left, held = zlib.decompressobj(), size, b""

    def more() -> bytes:
        nonlocal left
        source = stream.unconsumed_tail
        if not source:
            source = file.read(min(BLOCK_BYTES, left))
            left -= len(source)
        return stream.decompress(source, BLOCK_BYTES) if source else b""

    def read(count: int) -> bytes:
        nonlocal held
        while len(held) < count and (block := more()):
            held += block
        part, held = held[:count], held[count:]
        return part

    def skip(count: int) -> bytes:
        nonlocal held
        while len(held) < count and (block := more()):
            count, held = count - len(held), block
        held = held[count:]
        return b""

    return read, skip
