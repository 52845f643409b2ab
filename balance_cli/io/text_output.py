"""Text that contains names from elsewhere, in the forms that files and terminals take.

A file name is bytes, which need not be UTF-8: Python then has a lone surrogate in its place, which no encoder takes. It
may contain line breaks and control sequences, too, by which a name could move the cursor or forge a second message.
"""

from __future__ import annotations

import re
from pathlib import Path

_UNSTORABLE = re.compile("[\ud800-\udfff]")
_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters but for tab and line feed, line separators, marks of writing direction, bytes that are no text."""
_BYTES = range(0xDC80, 0xDD00)
"""Surrogates in which Python keeps the bytes of a file name that are not UTF-8."""


def storable_text(text: str) -> str:
    r"""The text with bytes that are not UTF-8 written as escapes, `\xff`."""
    return _UNSTORABLE.sub(_escape, text)


def printable_text(text: str) -> str:
    """As `storable_text`, and with control characters other than tab and line feed as escapes."""
    return _CONTROLS.sub(_escape, text)


def printable_line(text: str) -> str:
    """As `printable_text`, with line feeds as escapes, too: the text stays one line."""
    return printable_text(text).replace("\n", "\\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8 with line feeds, on all systems alike."""
    path.write_text(storable_text(text), encoding="utf-8", newline="\n")


def _escape(found: re.Match[str]) -> str:
    code = ord(found[0])
    byte = code - 0xDC00 if code in _BYTES else code
    return f"\\x{byte:02x}" if byte < 0x100 else f"\\u{byte:04x}"
