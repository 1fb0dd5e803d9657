"""``lut.json``: follows its schema, says what the table says, and its check poses check."""

from __future__ import annotations

import json
from copy import deepcopy
from typing import Any

import numpy as np
import pytest

from pipeline.files.lut_json import encode_lut_json, encode_lut_schema, unit_quaternions
from pipeline.kinematics.interpolation import moved_from_scan_table
from pipeline.kinematics.joint_coordinates import rotation_x, rotation_z
from pipeline.kinematics.table import Grid
from pipeline.playback import Lut
from tests.exports.readers import matrix, violations
from tests.files.lut_sample import content

SIDES = pytest.mark.parametrize("side", ["right", "left"])
BAD = ((3, 1), (4, 1))
SCHEMA = json.loads(encode_lut_schema())


def document(side: str = "right") -> dict[str, Any]:
    found = json.loads(encode_lut_json(content(side, bad=BAD)))
    assert isinstance(found, dict)
    return found


@SIDES
def test_it_follows_its_schema(side: str) -> None:
    assert violations(document(side), SCHEMA) == []


def test_a_table_of_one_attitude_follows_the_schema() -> None:
    one = content(grid=Grid(np.array([10.0]), np.array([0.0])))
    assert violations(json.loads(encode_lut_json(one)), SCHEMA) == []


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("side",), "both"),
        (("version",), "2.0"),
        (("status", 0, 0), 6),
        (("usable", 0, 0), 1),
        (("moved_from_scan", "quaternion_xyzw", 0, 0), [0.0, 0.0, 1.0]),
        (("moved_from_scan", "translation_m", 0, 0, 0), "0.1"),
        (("coordinates", "lateral_mm"), None),
        (("frames", "scan_from_moving", 3), [0.0, 0.0, 1.0]),
        (("checks",), []),
        (("axes", "roll_deg"), [0.0]),
    ],
)
def test_the_schema_sees_what_is_wrong(path: tuple[str | int, ...], value: object) -> None:
    broken: Any = deepcopy(document())
    place = broken
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    assert violations(broken, SCHEMA)


@SIDES
def test_motions_are_those_of_the_table(side: str) -> None:
    found, table = document(side), moved_from_scan_table(content(side, bad=BAD).table)
    for i, j in np.ndindex(table.shape[:2]):
        quaternion = found["moved_from_scan"]["quaternion_xyzw"][i][j]
        if (i, j) in BAD:
            assert quaternion is found["moved_from_scan"]["translation_m"][i][j] is None
            assert found["coordinates"]["lateral_mm"][i][j] is None
            assert not found["usable"][i][j]
            continue
        np.testing.assert_allclose(matrix(np.array(quaternion)), table[i, j, :3, :3], rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            found["moved_from_scan"]["translation_m"][i][j], table[i, j, :3, 3] / 1000, rtol=0, atol=1e-10
        )


@SIDES
def test_check_poses_hold(side: str) -> None:
    lut = Lut(content(side, bad=BAD))
    checks = document(side)["checks"]
    for check in checks:
        motion = lut.pose(check["flexion_deg"], check["varus_deg"])
        moved = motion[:3, :3] @ check["point_in_m"] + motion[:3, 3] / 1000
        np.testing.assert_allclose(moved, check["point_out_m"], rtol=0, atol=1e-9)
    assert len({(check["flexion_deg"], check["varus_deg"]) for check in checks}) == 5
    axes = document(side)["axes"]
    at_entries = [one["flexion_deg"] in axes["flexion_deg"] and one["varus_deg"] in axes["varus_deg"] for one in checks]
    assert at_entries[:3] == [True] * 3


def test_a_mirrored_importer_fails_the_checks() -> None:
    lut = Lut(content())
    mirror = np.diag([-1.0, 1.0, 1.0])
    for check in document()["checks"][1:]:
        motion = lut.pose(check["flexion_deg"], check["varus_deg"])
        moved = mirror @ motion[:3, :3] @ mirror @ check["point_in_m"] + mirror @ motion[:3, 3] / 1000
        assert np.linalg.norm(moved - check["point_out_m"]) > 0.005


def test_polynomials_are_those_of_the_table() -> None:
    curves = document()["polynomials"]["curves"]
    assert [(one["name"], one["unit"]) for one in curves] == [("lateral_mm", "mm"), ("internal_rotation_deg", "deg")]
    np.testing.assert_array_equal(curves[0]["coefficients"], np.arange(6.0).reshape(3, 2))


def test_quaternions_have_a_positive_last_part() -> None:
    turns = np.array([rotation_z(angle) @ rotation_x(1.0) for angle in np.linspace(-3.0, 3.0, 13)])
    found = unit_quaternions(turns)
    assert (found[:, 3] >= 0.0).all()
    np.testing.assert_allclose([matrix(one) for one in found], turns, rtol=0, atol=1e-12)


def test_a_default_grid_stays_small() -> None:
    grid = Grid(np.arange(0.0, 121.0, 1.0), np.arange(-5.0, 6.0, 1.0))
    assert len(encode_lut_json(content(grid=grid))) < 400_000


def test_the_same_table_gives_the_same_bytes() -> None:
    assert encode_lut_json(content(bad=BAD)) == encode_lut_json(content(bad=BAD))
