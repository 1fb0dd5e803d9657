"""The tables of a PLY file (http://paulbourke.net/dataformats/ply/), strictly: each byte or word has its place."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.files.foreign_image import bad_header, damaged, unsupported

_MAX_HEADER_BYTES = 100_000
_END_OF_HEADER = re.compile(rb"\nend_header[ \t]*\r?\n")
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    name: code
    for code, names in {
        "i1": "char int8",
        "u1": "uchar uint8",
        "i2": "short int16",
        "u2": "ushort uint16",
        "i4": "int int32",
        "u4": "uint uint32",
        "f4": "float float32",
        "f8": "double float64",
    }.items()
    for name in names.split()
}
#: A list is read as this many items; only triangles are accepted.
_LIST_LENGTH = 3
_COUNT_SUFFIX = "#count"


@dataclass(frozen=True)
class _Element:
    """Name, number of rows and columns (numpy field descriptions) of one table."""

    name: str
    rows: int
    columns: tuple[tuple[Any, ...], ...]

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(list(self.columns))


def read_ply_tables(data: bytes, file: str) -> tuple[Mapping[str, NDArray[Any]], str]:
    """Every element of a PLY file as a structured array by its name, and the comments of its header.

    A list property is an (rows, 3) field.

    Raises
    ------
    CaseRejected
        E-IO-11 when the bytes are fewer or more than declared, E-IO-12 for lists of another length than three,
        E-IO-13 for a header that is not understood.
    """
    end = _END_OF_HEADER.search(data, 0, _MAX_HEADER_BYTES)
    if not data.startswith(b"ply") or end is None:
        raise damaged(file, "it is not a PLY file with a complete header")
    lines = data[: end.start()].decode("latin-1").splitlines()[1:]
    try:
        order, elements = _parse_header(lines)
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise bad_header(file, "a line is not PLY, or names an element or property twice") from error
    body = data[end.end() :]
    tables = _binary(body, elements, file) if order else _ascii(body, elements, file)
    return tables, "\n".join(line for line in lines if line.startswith(("comment", "obj_info")))


def _parse_header(lines: list[str]) -> tuple[str, list[_Element]]:
    """Byte order (empty for ASCII) and the elements; raises ValueError, KeyError, IndexError or TypeError."""
    keyword, name, version = lines[0].split()
    if keyword != "format" or version != "1.0":
        raise ValueError("no format line")
    order = _FORMATS[name]
    elements: list[_Element] = []
    for line in lines[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "element" and len(words) == 3 and words[2].isdecimal():
            elements.append(_Element(words[1], int(words[2]), ()))
        elif words[0] == "property":
            last = elements.pop()
            elements.append(_Element(last.name, last.rows, last.columns + _columns(words[1:], order)))
        else:
            raise ValueError("unknown line")
    if len({element.name for element in elements}) != len(elements) or not all(e.columns for e in elements):
        raise ValueError("an element twice, or without properties")
    _ = [element.dtype for element in elements]  # ValueError for a property that occurs twice
    return order, elements


def _columns(words: list[str], order: str) -> tuple[tuple[Any, ...], ...]:
    order = order or "<"
    if words[0] == "list":
        _, count, item, name = words
        return ((name + _COUNT_SUFFIX, order + _TYPES[count]), (name, order + _TYPES[item], (_LIST_LENGTH,)))
    kind, name = words
    return ((name, order + _TYPES[kind]),)


def _binary(body: bytes, elements: list[_Element], file: str) -> dict[str, NDArray[Any]]:
    tables: dict[str, NDArray[Any]] = {}
    begin = 0
    for element in elements:
        size = element.rows * element.dtype.itemsize
        rows = len(body[begin : begin + size]) // max(element.dtype.itemsize, 1)
        table = np.frombuffer(body, element.dtype, rows, begin) if size else np.zeros(element.rows, element.dtype)
        _check_lists(table, file)
        if begin + size > len(body):
            raise damaged(file, f"it declares {element.rows} of {element.name}, and has {rows}")
        tables[element.name] = table
        begin += size
    if begin != len(body):
        raise damaged(file, f"it has {len(body) - begin} bytes more than its header declares")
    return tables


def _ascii(body: bytes, elements: list[_Element], file: str) -> dict[str, NDArray[Any]]:
    try:
        numbers = np.array(body.decode("ascii").split(), dtype=np.float64)
    except ValueError as error:
        raise damaged(file, "it holds a word that is not a number") from error
    widths = [sum(int(np.prod(column[2:] or (1,))) for column in element.columns) for element in elements]
    if (expected := sum(e.rows * width for e, width in zip(elements, widths, strict=True))) != len(numbers):
        raise damaged(file, f"expected {expected} numbers (triangles only), got {len(numbers)}")
    tables: dict[str, NDArray[Any]] = {}
    begin = 0
    for element, width in zip(elements, widths, strict=True):
        block = numbers[begin : begin + element.rows * width].reshape(element.rows, width)
        tables[element.name] = _table(block, element, file)
        begin += block.size
    return tables


def _table(block: NDArray[np.float64], element: _Element, file: str) -> NDArray[Any]:
    """The structured table of a block of numbers; refuses what does not fit the declared types."""
    table = np.zeros(element.rows, element.dtype)
    place = 0
    for name, kind, *shape in element.columns:
        width = int(np.prod(shape or (1,)))
        column = block[:, place : place + width].reshape(table[name].shape)
        if np.dtype(kind).kind in "iu" and not _fits(column, np.dtype(kind)):
            raise damaged(file, f"{name} of {element.name} is not whole numbers of its type")
        table[name] = column
        place += width
    _check_lists(table, file)
    return table


def _fits(column: NDArray[np.float64], kind: np.dtype[Any]) -> bool:
    limits = np.iinfo(kind)
    return bool(((column == np.round(column)) & (column >= limits.min) & (column <= limits.max)).all())


def _check_lists(table: NDArray[Any], file: str) -> None:
    for name in table.dtype.names or ():
        if name.endswith(_COUNT_SUFFIX) and (table[name] != _LIST_LENGTH).any():
            raise unsupported(file, "it has faces that are not triangles")
