"""Landmarks of 3D Slicer: ``.mrk.json`` (markups schema 1.0.x) and the older ``.fcsv``, to named LPS points.

The file itself must say whether it is LPS or RAS: the default of ``.fcsv`` changed between versions of 3D Slicer, and a
wrong guess mirrors the patient.
"""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

from pipeline.errors import CaseRejected
from pipeline.records import Vector

MAX_BYTES = 1_000_000
#: File name endings that are read.
MARKUP_ENDINGS = (".mrk.json", ".fcsv")

#: Signs that turn the x, y of the file into LPS; the numbers are those of 3D Slicer's vtkMRMLMarkupsStorageNode.
_SIGN = {"LPS": 1.0, "1": 1.0, "RAS": -1.0, "0": -1.0}
_SCHEMA = re.compile(r".*markups-schema-v1\.0\.\d+\.json#?")
_FCSV_COLUMNS = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"
#: vtkMRMLMarkupsNode::PositionDefined, which newer .fcsv append after the named columns.
_FCSV_DEFINED = "2"

#: (label, three coordinates, whether the position is defined)
_Row = tuple[str, Any, bool]


def read_markups(data: bytes, file: str) -> dict[str, Vector]:
    """Named points of a landmark file.

    Parameters
    ----------
    data : bytes
        The whole file.
    file : str
        Its name relative to the case folder; the ending chooses the format.

    Returns
    -------
    dict of str to (x, y, z)
        Snake-cased label -> LPS millimetres.

    Raises
    ------
    CaseRejected
        E-LMK-01 not readable, E-LMK-02 no coordinate system, E-LMK-03 a point twice, without a name or undefined.
    """
    if len(data) > MAX_BYTES:
        raise _unreadable(file, f"it has {len(data)} bytes, expected at most {MAX_BYTES}")
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise _unreadable(file, "it is not UTF-8 text") from error
    if file.lower().endswith(".fcsv"):
        return _from_fcsv(text, file)
    return _from_json(text, file)


def snake_case(label: str) -> str:
    """``Medial epicondyle`` -> ``medial_epicondyle``: lower case, anything but letters and digits as one underscore."""
    return re.sub(r"[^a-z0-9]+", "_", label.lower()).strip("_")[:64]


def _from_json(text: str, file: str) -> dict[str, Vector]:
    document = _strict_json(text, file)
    if not _SCHEMA.fullmatch(str(document.get("@schema", ""))):
        raise _unreadable(file, "it does not follow the markups schema 1.0 of 3D Slicer")
    markups = document.get("markups")
    if not isinstance(markups, list) or not all(isinstance(one, dict) for one in markups):
        raise _unreadable(file, "it has no list of markups")
    out: dict[str, Vector] = {}
    for markup in markups:
        _collect(out, _json_rows(markup, file), _sign(markup.get("coordinateSystem"), file), file)
    return out


def _json_rows(markup: Mapping[str, Any], file: str) -> Iterable[_Row]:
    points = markup.get("controlPoints", [])
    if markup.get("type") != "Fiducial" or not isinstance(points, list):
        raise _unreadable(file, "it holds a markup that is not a list of points (Fiducial)")
    if markup.get("coordinateUnits", "mm") not in ("mm", ["mm", "mm", "mm"]):
        raise _unreadable(file, "its coordinateUnits are not mm")
    for point in points:
        if not isinstance(point, dict):
            raise _unreadable(file, "a control point is not an object")
        defined = point.get("positionStatus", "defined") == "defined"
        yield str(point.get("label", "")), point.get("position"), defined


def _from_fcsv(text: str, file: str) -> dict[str, Vector]:
    lines = text.splitlines()
    assignments = (line[1:].partition("=") for line in lines if line.startswith("#"))
    header = {key.strip(): value.strip() for key, _, value in assignments}
    columns = [name.strip() for name in header.get("columns", _FCSV_COLUMNS).split(",")]
    if any(columns.count(name) != 1 for name in ("x", "y", "z", "label")):
        raise _unreadable(file, "its columns do not name x, y, z and label once each")
    sign = _sign(header.get("CoordinateSystem"), file)
    rows = csv.reader((line for line in lines if line.strip() and not line.startswith("#")), strict=True)
    out: dict[str, Vector] = {}
    try:
        _collect(out, (_fcsv_row(cells, columns, file) for cells in rows), sign, file)
    except csv.Error as error:
        raise _unreadable(file, "a line has broken quotes") from error
    return out


def _fcsv_row(cells: list[str], columns: list[str], file: str) -> _Row:
    if len(cells) < len(columns):
        raise _unreadable(file, f"a line has {len(cells)} columns, expected {len(columns)}")
    try:
        position = [float(cells[columns.index(name)]) for name in "xyz"]
    except ValueError as error:
        raise _unreadable(file, "a coordinate is not a number") from error
    status = cells[len(columns)] if len(cells) > len(columns) else _FCSV_DEFINED
    return cells[columns.index("label")], position, status == _FCSV_DEFINED


def _collect(out: dict[str, Vector], rows: Iterable[_Row], sign: float, file: str) -> None:
    """Add the points to ``out`` in LPS, refusing every one that is not a single, finite, named position."""
    for label, position, defined in rows:
        name = snake_case(label)
        if not name:
            raise _bad_point(file, f"point {len(out) + 1} has no label")
        if name in out:
            raise _bad_point(file, f"point {name} is given twice")
        if not defined:
            raise _bad_point(file, f"point {name} was never placed")
        if not _is_position(position):
            raise _bad_point(file, f"the position of point {name} is not three finite numbers")
        x, y, z = map(float, position)
        out[name] = (sign * x + 0.0, sign * y + 0.0, z)


def _is_position(position: object) -> bool:
    return (
        isinstance(position, list)
        and len(position) == 3
        and all(isinstance(x, (int, float)) and not isinstance(x, bool) and math.isfinite(x) for x in position)
    )


def _sign(system: object, file: str) -> float:
    sign = _SIGN.get(str(system))
    if sign is None:
        raise CaseRejected(
            "E-LMK-02",
            f"{file} does not say in which coordinate system its points are (LPS or RAS).",
            "Save the landmarks again from 3D Slicer 5 as a Markups JSON file (.mrk.json).",
        )
    return sign


def _strict_json(text: str, file: str) -> dict[str, Any]:
    try:
        document = json.loads(text, object_pairs_hook=_unique, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise _unreadable(file, "it is not valid JSON") from error
    if not isinstance(document, dict):
        raise _unreadable(file, "it is not a JSON object")
    return document


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    out = dict(pairs)
    if len(out) != len(pairs):
        raise ValueError("a key is given twice")
    return out


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


def _unreadable(file: str, problem: str) -> CaseRejected:
    return CaseRejected(
        "E-LMK-01",
        f"The landmarks in {file} cannot be read: {problem}.",
        "Save the landmarks again from 3D Slicer as a Markups JSON file (.mrk.json), or remove the file.",
    )


def _bad_point(file: str, problem: str) -> CaseRejected:
    return CaseRejected(
        "E-LMK-03",
        f"The landmarks in {file} cannot be used: {problem}.",
        "Correct the point in 3D Slicer and save the file again.",
    )
