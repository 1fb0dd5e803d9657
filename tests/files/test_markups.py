"""Landmark files: LPS whatever they were saved in, and no guess where they do not say."""

from __future__ import annotations

import json
from typing import Any

import pytest

from pipeline.errors import CaseRejected
from pipeline.files.markups import MAX_BYTES, read_markups, snake_case

SCHEMA = "https://raw.githubusercontent.com/Slicer/Slicer/main/Modules/Loadable/Markups/Resources/Schema/"
LPS = {"medial_epicondyle": (10.5, -20.0, 700.25), "lateral_epicondyle": (-60.0, -22.0, 701.0)}
#: The same points in the other system.
RAS = {name: (-x, -y, z) for name, (x, y, z) in LPS.items()}
TITLES = {"medial_epicondyle": "Medial epicondyle", "lateral_epicondyle": "lateral-epicondyle "}


def document(points: dict[str, tuple[float, float, float]], **changes: Any) -> dict[str, Any]:
    control = [
        {"id": str(n), "label": TITLES[name], "position": list(position), "positionStatus": "defined"}
        for n, (name, position) in enumerate(points.items())
    ]
    markup = {
        "type": "Fiducial",
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "controlPoints": control,
    } | changes
    return {"@schema": SCHEMA + "markups-schema-v1.0.3.json#", "markups": [markup]}


def mrk(value: object) -> bytes:
    return json.dumps(value).encode()


def fcsv(
    points: dict[str, tuple[float, float, float]], system: str | None, version: str = "4.11", tail: str = ""
) -> bytes:
    lines = [f"# Markups fiducial file version = {version}"]
    lines += [f"# CoordinateSystem = {system}"] if system is not None else []
    lines += ["# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"]
    for n, (name, (x, y, z)) in enumerate(points.items()):
        lines.append(f'{n},{x},{y},{z},0,0,0,1,1,1,0,{TITLES[name]},"a, quoted text",node{tail}')
    return ("\n".join(lines) + "\n").encode()


def refused(code: str, problem: str) -> pytest.RaisesExc[CaseRejected]:
    return pytest.raises(CaseRejected, match=f"^{code} .*{problem}")


@pytest.mark.parametrize(
    ("data", "file"),
    [
        (mrk(document(LPS)), "landmarks.mrk.json"),
        (mrk(document(RAS, coordinateSystem="RAS")), "landmarks.mrk.json"),
        (mrk(document(LPS, coordinateUnits=["mm", "mm", "mm"])), "landmarks.mrk.json"),
        (fcsv(LPS, "LPS"), "landmarks.fcsv"),
        (fcsv(LPS, "1", "4.10"), "landmarks.fcsv"),
        (fcsv(RAS, "RAS"), "landmarks.fcsv"),
        (fcsv(RAS, "0", "4.10"), "landmarks.fcsv"),
        (fcsv(LPS, "LPS", "5.6", ",2,0"), "landmarks.fcsv"),
        (fcsv(LPS, "LPS").replace(b"\n", b"\r\n"), "LANDMARKS.FCSV"),
    ],
)
def test_every_file_gives_the_same_points(data: bytes, file: str) -> None:
    assert read_markups(data, file) == LPS


def test_several_lists_are_one_set() -> None:
    first, second = (document(dict([item])) for item in LPS.items())
    first["markups"] += second["markups"]
    assert read_markups(mrk(first), "l.mrk.json") == LPS


@pytest.mark.parametrize("system", [None, "", "lps", "IJK", 1])
def test_json_without_a_coordinate_system(system: object) -> None:
    changed = document(LPS, coordinateSystem=system)
    if system == 1:  # 3D Slicer writes names in JSON; a number there is some other program's
        changed["markups"][0].pop("coordinateSystem")
    with refused("E-LMK-02", r"l\.mrk\.json does not say"):
        read_markups(mrk(changed), "l.mrk.json")


@pytest.mark.parametrize("system", [None, "2", "IJK"])
def test_fcsv_without_a_coordinate_system(system: str | None) -> None:
    with refused("E-LMK-02", r"l\.fcsv does not say"):
        read_markups(fcsv(LPS, system), "l.fcsv")


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"{", "not valid JSON"),
        (b'{"a": 1, "a": 2}', "not valid JSON"),
        (b'{"a": NaN}', "not valid JSON"),
        (b"[" * 100_000, "not valid JSON"),
        (b"[1]", "not a JSON object"),
        (b"{}", "markups schema 1.0"),
        ("{}".encode("utf-16"), "not UTF-8"),
        (b" " * (MAX_BYTES + 1), "at most 1000000"),
        (mrk(document(LPS) | {"@schema": SCHEMA + "markups-schema-v2.0.0.json#"}), "markups schema 1.0"),
        (mrk(document(LPS) | {"markups": 3}), "no list of markups"),
        (mrk(document(LPS, type="Plane")), "not a list of points"),
        (mrk(document(LPS, controlPoints=7)), "not a list of points"),
        (mrk(document(LPS, controlPoints=[7])), "not an object"),
        (mrk(document(LPS, coordinateUnits="m")), "not mm"),
    ],
)
def test_json_that_is_not_read(data: bytes, problem: str) -> None:
    with refused("E-LMK-01", problem):
        read_markups(data, "l.mrk.json")


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        (b"10.5", b"ten", "not a number"),
        (b",node", b"", "13 columns, expected 14"),
        (b"columns = id,x", b"columns = id,xx", "do not name x, y, z"),
        (b"columns = id,x", b"columns = x,x", "do not name x, y, z"),
        (b'"a, quoted text"', b'"a, "quoted', "broken quotes"),
    ],
)
def test_fcsv_that_is_not_read(old: bytes, new: bytes, problem: str) -> None:
    data = fcsv(LPS, "LPS")
    assert old in data
    with refused("E-LMK-01", problem):
        read_markups(data.replace(old, new), "l.fcsv")


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"positionStatus": "undefined"}, "point medial_epicondyle was never placed"),
        ({"positionStatus": "preview"}, "never placed"),
        ({"label": "LATERAL  Epicondyle"}, "point lateral_epicondyle is given twice"),
        ({"label": " - "}, "point 1 has no label"),
        ({"position": [1.0, 2.0]}, "medial_epicondyle is not three"),
        ({"position": [1.0, 2.0, "3"]}, "not three finite"),
        ({"position": [1.0, True, 3.0]}, "not three finite"),
        ({"position": None}, "not three finite"),
    ],
)
def test_points_that_are_none(change: dict[str, Any], problem: str) -> None:
    changed = document(LPS)
    changed["markups"][0]["controlPoints"][0] |= change
    with refused("E-LMK-03", problem):
        read_markups(mrk(changed), "l.mrk.json")


def test_numbers_beyond_all_bounds() -> None:
    with refused("E-LMK-03", "not three finite"):
        read_markups(mrk(document(LPS)).replace(b"10.5", b"1e400"), "l.mrk.json")
    with refused("E-LMK-03", "not three finite"):
        read_markups(fcsv(LPS, "LPS").replace(b"10.5", b"nan"), "l.fcsv")


def test_fcsv_point_never_placed() -> None:
    with refused("E-LMK-03", "never placed"):
        read_markups(fcsv(LPS, "LPS", "5.6", ",0,0"), "l.fcsv")


@pytest.mark.parametrize(
    ("label", "name"),
    [
        ("Medial epicondyle", "medial_epicondyle"),
        ("F-1", "f_1"),
        ("  A  B ", "a_b"),
        ("<b>", "b"),
        ("é", ""),
        ("a" * 90, "a" * 64),
    ],
)
def test_snake_case(label: str, name: str) -> None:
    assert snake_case(label) == name
