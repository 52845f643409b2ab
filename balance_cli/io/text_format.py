"""What all readers of text tables share: encodings, separators, remarks, and workbooks that are no text."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

from balance_cli.io.errors import UserError

SEPARATORS = ("\t", ";", "|", ",", " ")
"""In the order in which they are tried: the comma may be the decimal sign, the space stands for any run of spaces."""
REMARKS = ("#", "%", "//")
"""Signs with which remarks begin."""
WORKBOOK_SIGNATURE = b"PK\x03\x04"
ARRAY_SIGNATURE = b"\x93NUMPY"
ARRAY_MEMBER = b".npy"
"""How a numpy array begins, and how the names of those in an archive end."""
MARKUP_SIGNATURES = (b"<?xml", b"\xef\xbb\xbf<?xml", b"<!DOCTYPE", b"<html")
FEWEST_EAST_ASIAN = 4
"""Characters by which a text is Japanese or Chinese; two signs beyond ASCII in a row occur in German words."""
_KANA = re.compile("[\u3041-\u30ff]")
_BEYOND_ASCII = re.compile(rb"[\x80-\xff]+")
SENSOR_MARK = b"<FTSensor"
"""The element of ATI's calibration files."""


def require_plain_text(head: bytes, path: Path) -> None:
    """Raise UserError where a file begins as workbooks of spreadsheets, XML or web pages do."""
    if head.startswith(WORKBOOK_SIGNATURE) and ARRAY_MEMBER in head:
        remedy = "Export its arrays as CSV, MAT, HDF5 or Parquet"
        raise UserError("is an archive of numpy arrays (.npz), and no table", str(path), remedy=remedy)
    if head.startswith(ARRAY_SIGNATURE):
        remedy = "Export it as CSV, MAT, HDF5 or Parquet"
        raise UserError("is a numpy array (.npy), which has no names of channels", str(path), remedy=remedy)
    if head.startswith(WORKBOOK_SIGNATURE):
        raise UserError("is a workbook (or another zip file)", str(path), remedy="Save the sheet as CSV")
    if SENSOR_MARK in head:
        remedy = "Give it to `balance calibrate --from-matrix`"
        raise UserError("is the calibration matrix of an ATI sensor, and no table", str(path), remedy=remedy)
    if head.lstrip().startswith(MARKUP_SIGNATURES):
        raise UserError("is XML or a web page, and no table", str(path), remedy="Export the table as CSV")


def is_remark(line: str) -> bool:
    """Whether a line is a remark, or empty."""
    return not line.strip() or line.lstrip().startswith(REMARKS)


def find_encoding(head: bytes, is_cut: bool = False) -> str:
    """Encoding by byte order mark, by zero bytes of UTF-16, else UTF-8 where valid, else Windows-1252.

    Shift-JIS and GB 18030 are told from Windows-1252 by their characters. With `is_cut` the last character may be
    incomplete.
    """
    if head.startswith(b"\xef\xbb\xbf"):
        return "utf-8-sig"
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    if len(head) > 3 and head[1:64:2].count(0) > 0.8 * len(head[1:64:2]):
        return "utf-16-le"
    if len(head) > 3 and head[0:64:2].count(0) > 0.8 * len(head[0:64:2]):
        return "utf-16-be"
    try:
        head.decode("utf-8")
        return "utf-8"
    except UnicodeDecodeError as error:
        return "utf-8" if is_cut and error.start > len(head) - 4 else _find_code_page(head)


def _find_code_page(head: bytes) -> str:
    """Code page of text with signs beyond ASCII that is not UTF-8.

    Japanese text has full-width kana, which signs of Western languages do not make up. Chinese text has pairs of signs
    beyond ASCII, where Western text has mostly single ones.
    """
    head = head[: head.rfind(b"\n") + 1] or head
    with suppress(UnicodeDecodeError):
        if len(_KANA.findall(head.decode("cp932"))) >= FEWEST_EAST_ASIAN:
            return "cp932"
    runs = [len(run) for run in _BEYOND_ASCII.findall(head)]
    if sum(runs) >= 2 * FEWEST_EAST_ASIAN and all(length % 2 == 0 for length in runs):
        with suppress(UnicodeDecodeError):
            head.decode("gb2312")
            return "gb18030"
    return "cp1252"
