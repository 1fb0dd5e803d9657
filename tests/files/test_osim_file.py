"""``joint.osim``: its CustomJoint, evaluated as OpenSim's documents say, is the joint of the table."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from pipeline.files.lut_content import LutFileContent
from pipeline.files.meshes import read_mesh
from pipeline.files.osim_file import (
    GEOMETRY_FOLDER,
    OsimBody,
    body_from_scan,
    encode_body_stl,
    encode_osim,
    joint_functions,
)
from pipeline.geometry.mesh import volume_mm3
from pipeline.kinematics.interpolation import usable_entries
from pipeline.kinematics.joint_coordinates import attitude_rotation
from pipeline.kinematics.smoothing import evaluate, scaled
from pipeline.kinematics.table import CurveFit, Grid
from pipeline.playback import Lut
from tests.exports.readers import numbers, parent_from_child
from tests.files.lut_sample import GRID, content

Float = NDArray[np.float64]

SIDES = pytest.mark.parametrize("side", ["right", "left"])
BAD = ((3, 1), (4, 1))
BODIES = (OsimBody("femur_r", (("femur", (233, 225, 204)),)), OsimBody("tibia_r", (("tibia", (186, 205, 224)),)))
RANDOM = np.random.default_rng(7).uniform([0.0, -4.0], [60.0, 2.5], (50, 2))
#: Of the joint's rotation, and of the place of the tibia in the femur's axes: all within what a joint file can hold.
TURN = np.array([[4.0, 1.0, 0.3, 0.1], [3.0, -0.5, 0.2, 0.0], [-1.0, 0.25, 0.0, 0.0]])
SHIFT = np.zeros((3, 7, 4))
SHIFT[:, :2, :2] = [[[2.0, 0.3], [1.0, 0.0]], [[-4.0, 0.2], [9.0, 0.1]], [[-30.0, 0.5], [5.0, -0.4]]]
SHIFT[:, (6, 5, 3), (0, 1, 3)] = 0.02


def at(terms: Float, flexion_deg: float, varus_deg: float) -> float:
    """A Chebyshev sum at an attitude of the sample's grid."""
    u, v = scaled(np.array([flexion_deg]), np.array([0.0, 60.0])), scaled(np.array([varus_deg]), np.array([-4.0, 2.5]))
    return float(chebyshev.chebval2d(u, v, terms)[0])


def polynomial_joint(side: str) -> LutFileContent:
    """A table whose joint is one of polynomials, so that the file can say it without loss."""
    table = content(side, bad=BAD)
    poses = table.smooth.poses
    place = np.empty((*GRID.shape, 3))
    for i, j in np.ndindex(GRID.shape):
        flexion, varus = float(GRID.flexion_deg[i]), float(GRID.varus_deg[j])
        shift = [at(terms, flexion, varus) for terms in SHIFT]
        place[i, j] = attitude_rotation(np.radians(flexion), np.radians(varus)).T @ shift
    place[poses.status > 1] = np.nan
    fit = CurveFit("internal_rotation_deg", "deg", TURN, 0.0, 0.0)
    turn = np.where(poses.status > 1, np.nan, evaluate(fit, GRID))
    poses = replace(
        poses,
        lateral_mm=place[..., 0],
        anterior_mm=place[..., 1],
        proximal_mm=place[..., 2],
        internal_rotation_deg=turn,
    )
    return replace(table, smooth=replace(table.smooth, poses=poses, fits=(fit,)))


def pose_of_file(data: bytes, table: LutFileContent, flexion_deg: float, varus_deg: float) -> Float:
    """(4, 4) moved_from_scan in mm as the joint file has it."""
    side = table.side[0]
    values = {f"knee_flexion_{side}": np.radians(flexion_deg), f"knee_varus_{side}": np.radians(varus_deg)}
    scan_from_parent = np.linalg.inv(body_from_scan(table, "reference"))
    return np.asarray(scan_from_parent @ parent_from_child(data, values) @ body_from_scan(table, "moving"))


def furthest_mm(one: Float, other: Float, table: LutFileContent) -> float:
    """Largest distance between the moving body's vertices under two motions."""
    points = np.c_[table.moving_body.points, np.ones(len(table.moving_body.points))]
    return float(np.linalg.norm(points @ (one - other).T, axis=1).max())


@SIDES
def test_polynomials_are_reproduced_at_any_attitude(side: str) -> None:
    table = polynomial_joint(side)
    data = encode_osim(table, *BODIES)
    for flexion, varus in RANDOM:
        shift = np.array([at(terms, flexion, varus) for terms in SHIFT])
        turn = np.radians(at(TURN, flexion, varus))
        c, s = np.cos(turn), np.sin(turn)
        joint = np.eye(4)
        joint[:3, :3] = attitude_rotation(np.radians(flexion), np.radians(varus)) @ [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        joint[:3, 3] = shift
        expected = table.scan_from_reference @ joint @ np.linalg.inv(table.scan_from_moving)
        np.testing.assert_allclose(pose_of_file(data, table, flexion, varus), expected, rtol=0, atol=1e-9)


@SIDES
def test_the_player_and_the_file_agree_at_the_entries(side: str) -> None:
    table = polynomial_joint(side)
    data, lut = encode_osim(table, *BODIES), Lut(table)
    for i, j in np.argwhere(usable_entries(table.smooth.poses)):
        attitude = float(GRID.flexion_deg[i]), float(GRID.varus_deg[j])
        np.testing.assert_allclose(pose_of_file(data, table, *attitude), lut.pose(*attitude), rtol=0, atol=1e-9)


@SIDES
def test_the_player_and_the_file_agree_between_the_entries(side: str) -> None:
    """The player is linear in varus between columns up to 3 degrees apart; this joint bends there by 0.22 mm."""
    table = polynomial_joint(side)
    data, lut = encode_osim(table, *BODIES), Lut(table)
    covered = [(f, v) for f, v in RANDOM.tolist() if np.isfinite(lut.pose(f, v, "nan")).all()]
    assert len(covered) > 30
    assert max(furthest_mm(pose_of_file(data, table, f, v), lut.pose(f, v), table) for f, v in covered) < 0.25


@SIDES
def test_deviations_are_stated_as_they_are(side: str) -> None:
    """Curves that are no polynomials: what the file says of itself is what an outside reader measures."""
    sample = content(side, bad=BAD)
    table = replace(sample, smooth=replace(sample.smooth, fits=()))
    data = encode_osim(table, *BODIES)
    off = []
    for i, j in np.argwhere(usable_entries(table.smooth.poses)):
        flexion, varus = np.radians(GRID.flexion_deg[i]), np.radians(GRID.varus_deg[j])
        found = parent_from_child(data, {f"knee_flexion_{side[0]}": flexion, f"knee_varus_{side[0]}": varus})
        d = [getattr(table.smooth.poses, name)[i, j] for name in ("lateral_mm", "anterior_mm", "proximal_mm")]
        lateral, anterior, proximal = attitude_rotation(flexion, varus) @ d / 1000
        hand = 1.0 if side == "right" else -1.0
        off.append(1000 * (found[:3, 3] - [anterior, proximal, hand * lateral]))
    measured = dict(zip(("anterior", "proximal", "lateral"), np.abs(off).max(axis=0), strict=True))
    stated = {one.name: one for one in joint_functions(table)}
    for name, largest in measured.items():
        assert stated[name].deviation_max == pytest.approx(largest, abs=1e-9)
        assert 0.0 < stated[name].deviation_rms <= stated[name].deviation_max < 0.2
        assert f"  {name}: {largest:.2g} and" in data.decode()
    assert 0.0 < stated["internal_rotation"].deviation_max < 0.2


def test_left_and_right_differ_by_signs_of_axes_alone() -> None:
    texts = [
        re.sub(r"_[rl]\b", "", encode_osim(polynomial_joint(side), *BODIES).decode()) for side in ("right", "left")
    ]
    axes = [re.findall(r"<axis>(.*)</axis>", text) for text in texts]
    assert axes[0] == ["0.0 0.0 -1.0", "1.0 0.0 0.0", "0.0 1.0 0.0", "1.0 0.0 0.0", "0.0 1.0 0.0", "0.0 0.0 1.0"]
    assert axes[1] == ["0.0 0.0 -1.0", "-1.0 0.0 0.0", "0.0 -1.0 0.0", "1.0 0.0 0.0", "0.0 1.0 0.0", "0.0 0.0 -1.0"]
    functions = [re.findall(r"<coefficients>(.*)</coefficients>", text) for text in texts]
    assert functions[0] == functions[1]


def test_two_free_coordinates_clamped_to_the_table() -> None:
    coordinates = ET.fromstring(encode_osim(content(), *BODIES)).findall(".//Coordinate")
    assert [one.get("name") for one in coordinates] == ["knee_flexion_r", "knee_varus_r"]
    for one, ends in zip(coordinates, ((0.0, 60.0), (-4.0, 2.5)), strict=True):
        np.testing.assert_allclose(numbers(one, "range"), np.radians(ends))
        assert one.findtext("clamped") == "true"
    np.testing.assert_allclose([numbers(one, "default_value")[0] for one in coordinates], np.radians([8.0, 1.0]))


def test_it_says_what_a_reader_must_know() -> None:
    text = encode_osim(content(bad=BAD), *BODIES).decode()
    for words in ("not for diagnosis", "placeholders", "50 of 52 attitudes", "negate the coordinate"):
        assert words in text


@SIDES
@pytest.mark.parametrize("body", ["reference", "moving"])
def test_geometry_is_in_metres_in_the_frame_of_its_body(side: str, body: str) -> None:
    table = content(side)
    mesh = getattr(table, f"{body}_body")
    data = encode_body_stl(mesh, table, body)
    assert data.startswith(b"binary STL, metres")
    read = read_mesh(b" " * 80 + data[80:84] + _in_mm(data[84:]), "femur.stl").mesh
    assert volume_mm3(read) == pytest.approx(volume_mm3(mesh), rel=1e-5)
    frame = getattr(table, f"scan_from_{body}")
    lateral, anterior, proximal = ((mesh.points - frame[:3, 3]) @ frame[:3, :3]).T
    right = lateral if side == "right" else -lateral
    expected = np.stack([anterior, proximal, right], axis=1)
    order = [np.lexsort(np.round(points, 3).T) for points in (read.points, expected)]
    np.testing.assert_allclose(read.points[order[0]], expected[order[1]], rtol=0, atol=1e-3)


def _in_mm(facets: bytes) -> bytes:
    """Facets of an STL a thousand times as large."""
    kind = np.dtype([("normal", "<f4", 3), ("points", "<f4", (3, 3)), ("attribute", "<u2")])
    read = np.frombuffer(facets, kind).copy()
    read["points"] *= 1000
    return read.tobytes()


def test_meshes_are_named_without_a_path() -> None:
    root = ET.fromstring(encode_osim(content(), *BODIES))
    assert [one.text for one in root.iter("mesh_file")] == ["femur.stl", "tibia.stl"]
    assert GEOMETRY_FOLDER == "Geometry"


def test_a_single_attitude_makes_a_joint() -> None:
    table = content(grid=Grid(np.array([10.0]), np.array([1.0])))
    table = replace(table, smooth=replace(table.smooth, fits=()))
    found = pose_of_file(encode_osim(table, *BODIES), table, 10.0, 1.0)
    np.testing.assert_allclose(found, Lut(table).pose(10.0, 1.0), rtol=0, atol=1e-9)


def test_a_table_without_a_pose_is_refused() -> None:
    with pytest.raises(ValueError, match="without a usable entry"):
        encode_osim(content(bad=tuple(np.ndindex(GRID.shape))), *BODIES)


def test_the_same_table_gives_the_same_bytes() -> None:
    assert encode_osim(content(), *BODIES) == encode_osim(content(), *BODIES)
