"""The text of a file, whichever of the usual encodings it has."""

from __future__ import annotations

import codecs

from loopwright.service.offline.csv_record.errors import Unusable

_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32-le"),  # begins with the mark of UTF-16: before it
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_OTHERS = (
    (b"PK\x03\x04", "a workbook or another archive"),
    (b"\xd0\xcf\x11\xe0", "an old workbook"),
    (b"%PDF", "a PDF"),
    (b"\x1f\x8b", "compressed"),
    (b"SQLite format 3", "a database"),
    (b"PAR1", "a Parquet file"),
    (b"MATLAB 5", "a file of MATLAB"),
    (b"\x89HDF", "an HDF5 file"),
    (b"TDSm", "a TDMS file"),
)
"""How files begin that are no text."""
_START = 4096
"""Bytes at the start that tell UTF-16 without a mark: every second one of them is then 0."""


def decoded(content: bytes) -> str:
    """Returns the text of a file: UTF-8, UTF-16, UTF-32, or Windows' western code page, in which old loggers write
    their degree signs. Raises Unusable for what is no text."""
    for mark, named in _OTHERS:
        if content.startswith(mark):
            raise Unusable(f"is not a table of measurements as text: it is {named}. Save the sheet or the trend as CSV")
    for mark, encoding in _MARKS:
        if content.startswith(mark):
            return _text(content[len(mark) :], encoding)
    start = content[:_START]
    for offset, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):
        halves = start[offset::2]
        if halves and halves.count(0) > 0.9 * len(halves):
            return _text(content, encoding)
    if 0 in start:
        raise Unusable(f"is not text: byte {start.index(0)} is 0. Export it as CSV")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        return _text(content, "cp1252")


def _text(content: bytes, encoding: str) -> str:
    try:
        return content.decode(encoding)
    except UnicodeDecodeError as error:
        raise Unusable(f"is not text in {encoding.upper()}: byte {error.start}. Export it as CSV in UTF-8") from None
