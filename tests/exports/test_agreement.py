"""One table in every format: the poses are the same, and the files are complete, small and repeatable."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import SimpleITK
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from pipeline.errors import CaseRejected
from pipeline.exports import FORMATS, KEYFRAME_ERROR_MM, TRIANGLES, ExportSource, Files, export_files, source_of
from pipeline.files.csv_table import encode_csv
from pipeline.files.lut_file import decode_lut, encode_lut
from pipeline.files.lut_json import unit_quaternions
from pipeline.files.markups import read_markups
from pipeline.files.meshes import encode_ply
from pipeline.kinematics.joint_coordinates import JointCoordinates, moved_from_scan
from pipeline.kinematics.table import Grid
from pipeline.playback import Lut
from tests.exports.readers import Glb, matrix, parent_from_child
from tests.files.lut_sample import GRID, box, content
from tests.geometry.knees import sphere

Float = NDArray[np.float64]

SIDES = pytest.mark.parametrize("side", ["right", "left"])
PAGE = Path(__file__).resolve().parents[2] / "docs/exports.md"
BAD = ((3, 1), (4, 1))
FOUND = ("lateral_mm", "anterior_mm", "proximal_mm", "internal_rotation_deg")
LANDMARKS = {"lateral_epicondyle": (150.0, -80.0, 650.0)}
#: Attitudes away from the column with a gap.
RANDOM = np.random.default_rng(3).uniform([0.0, 0.0], [60.0, 2.5], (50, 2)).tolist()
ATTITUDES = [
    (float(GRID.flexion_deg[i]), float(GRID.varus_deg[j])) for i, j in np.ndindex(GRID.shape) if (i, j) not in BAD
]


def source(side: str = "right") -> ExportSource:
    table = content(side, bad=BAD)
    return ExportSource(
        table,
        {
            "femur": table.reference_body,
            "tibia": table.moving_body,
            "meniscus": box((9, 9, 2), (118, -79, 630)),
            "patella": box((9, 4, 9), (120, -120, 640)),
        },
        {"femur": "reference", "tibia": "moving", "meniscus": "moving"},
        LANDMARKS,
    )


@pytest.fixture(scope="module")
def both() -> dict[str, Files]:
    return {side: export_files(source(side)) for side in ("right", "left")}


def player(side: str) -> Lut:
    """Of the table as it is read back from HDF5."""
    return Lut(decode_lut(encode_lut(content(side, bad=BAD))))


def glb_pose(glb: Glb, clip: str, flexion_deg: float) -> Float:
    """(4, 4) moved_from_scan in mm as the animation has it, by what the file says of itself alone."""
    facts = glb.document["scenes"][0]["extras"]
    time = (flexion_deg - facts["flexion_deg_at_0_s"]) / facts["flexion_deg_per_s"]
    gltf_from_lps = np.array(facts["gltf_m_from_lps_mm"])
    return np.asarray(np.linalg.inv(gltf_from_lps) @ glb.pose(clip, time) @ gltf_from_lps)


def furthest_mm(one: Float, other: Float, side: str) -> float:
    points = content(side).moving_body.points
    return float(np.linalg.norm(np.c_[points, np.ones(len(points))] @ (one - other).T, axis=1).max())


@SIDES
def test_the_files(side: str, both: dict[str, Files]) -> None:
    assert sorted(both[side]) == [
        "knee.glb",
        "lut.json",
        "lut.schema.json",
        "opensim/Geometry/femur.stl",
        "opensim/Geometry/meniscus.stl",
        "opensim/Geometry/tibia.stl",
        "opensim/joint.osim",
        "slicer/landmarks.mrk.json",
        "slicer/tibia_flexion_0_varus_0.tfm",
        "slicer/tibia_flexion_30_varus_0.tfm",
        "slicer/tibia_flexion_60_varus_0.tfm",
    ]


@SIDES
def test_json_agrees_at_random_attitudes(side: str, both: dict[str, Files]) -> None:
    """An importer of its own: splines by scipy, linear between columns, the formula of the page."""
    found, lut = json.loads(both[side]["lut.json"]), player(side)
    axes, frames = found["axes"], found["frames"]
    for flexion, varus in RANDOM:
        j = int(np.searchsorted(axes["varus_deg"], varus)) - 1
        share = (varus - axes["varus_deg"][j]) / (axes["varus_deg"][j + 1] - axes["varus_deg"][j])
        six = [np.radians(flexion), np.radians(varus)]
        for name in (FOUND[3], *FOUND[:3]):
            columns = np.array(found["coordinates"][name], dtype=float)[:, j : j + 2]
            near, far = CubicSpline(axes["flexion_deg"], columns)(flexion)
            six.append((1 - share) * near + share * far)
        six[2] = np.radians(six[2])
        reference, moving = (np.array(frames[name]) for name in ("scan_from_reference", "scan_from_moving"))
        found_pose = moved_from_scan(reference, moving, JointCoordinates(*six))
        np.testing.assert_allclose(found_pose, lut.pose(flexion, varus), rtol=0, atol=1e-6)


@SIDES
def test_json_agrees_at_the_entries(side: str, both: dict[str, Files]) -> None:
    moved, lut = json.loads(both[side]["lut.json"])["moved_from_scan"], player(side)
    for flexion, varus in ATTITUDES:
        i, j = np.searchsorted(GRID.flexion_deg, flexion), np.searchsorted(GRID.varus_deg, varus)
        expected = lut.pose(flexion, varus)
        turn = matrix(np.array(moved["quaternion_xyzw"][i][j]))
        np.testing.assert_allclose(turn, expected[:3, :3], rtol=0, atol=1e-9)
        np.testing.assert_allclose(1000 * np.array(moved["translation_m"][i][j]), expected[:3, 3], rtol=0, atol=1e-6)


@SIDES
def test_the_importer_of_the_page_works(
    side: str, both: dict[str, Files], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lut.json").write_bytes(both[side]["lut.json"])
    names: dict[str, Any] = {}
    exec(PAGE.read_text().split("```python\n")[1].split("```")[0], names)
    assert names["error_m"] < 1e-9


@SIDES
def test_unity_and_gltf_take_points_and_quaternions_as_the_page_says(side: str) -> None:
    motion = player(side).pose(45.0, 0.0)
    (x, y, z, w), point = unit_quaternions(motion[None])[0], np.array([10.0, 20.0, 30.0])
    turned = motion[:3, :3] @ point
    for of_point, quaternion in (((-1, 1, -1), (x, -z, y, w)), ((1, 1, -1), (x, z, -y, w))):
        there, back = (of_point * one[[0, 2, 1]] for one in (point, turned))
        np.testing.assert_allclose(matrix(np.array(quaternion)) @ there, back, rtol=0, atol=1e-12)


@SIDES
def test_csv_agrees(side: str) -> None:
    table = content(side, bad=BAD)
    text = encode_csv(table.smooth.grid, table.smooth.poses, side).decode()
    lut = player(side)
    for row in csv.DictReader(line for line in io.StringIO(text) if not line.startswith("#")):
        if row["status"] in ("ok", "smoothed"):
            flexion, varus, turn = (np.radians(float(row[name])) for name in ("flexion_deg", "varus_deg", FOUND[3]))
            six = JointCoordinates(flexion, varus, turn, *(float(row[name]) for name in FOUND[:3]))
            motion = moved_from_scan(table.scan_from_reference, table.scan_from_moving, six)
            expected = lut.pose(float(row["flexion_deg"]), float(row["varus_deg"]))
            np.testing.assert_allclose(motion, expected, rtol=0, atol=1e-6)


@SIDES
def test_glb_agrees_at_its_keyframes(side: str, both: dict[str, Files]) -> None:
    glb, lut = Glb(both[side]["knee.glb"]), player(side)
    for clip in glb.document["animations"]:
        facts = clip["extras"]
        shown = [flexion for flexion in GRID.flexion_deg.tolist() if facts["first_flexion_deg"] <= flexion]
        for flexion in (one for one in shown if one <= facts["last_flexion_deg"]):
            expected = lut.pose(flexion, facts["varus_deg"])
            # a thousandth of a millimetre: single precision, seen at the far end of the body
            assert furthest_mm(glb_pose(glb, clip["name"], flexion), expected, side) < 1e-3


@SIDES
def test_glb_keeps_to_its_word_between_keyframes(side: str, both: dict[str, Files]) -> None:
    glb, lut = Glb(both[side]["knee.glb"]), player(side)
    stated = glb.document["scenes"][0]["extras"]["keyframe_error_mm"]
    assert 0.0 < stated <= KEYFRAME_ERROR_MM
    worst = max(
        furthest_mm(glb_pose(glb, f"flexion_varus_{name}deg", flexion), lut.pose(flexion, varus), side)
        for flexion in np.linspace(0.0, 60.0, 301).tolist()
        for name, varus in (("-4", -4.0), ("0", 0.0), ("+2.5", 2.5))
    )
    assert worst <= stated + 1e-3


def test_clips_are_named_by_varus_and_run_over_the_longest_stretch(both: dict[str, Files]) -> None:
    names = ("first_flexion_deg", "last_flexion_deg", "covers_the_table")
    clips = Glb(both["right"]["knee.glb"]).document["animations"]
    facts = {clip["name"]: tuple(clip["extras"][name] for name in names) for clip in clips}
    assert facts == {
        "flexion_varus_-4deg": (0.0, 60.0, True),
        "flexion_varus_-1deg": (25.0, 60.0, False),
        "flexion_varus_0deg": (0.0, 60.0, True),
        "flexion_varus_+2.5deg": (0.0, 60.0, True),
    }


@SIDES
def test_quaternions_stay_on_one_side_and_only_the_moving_bone_moves(side: str, both: dict[str, Files]) -> None:
    glb = Glb(both[side]["knee.glb"])
    for clip in glb.document["animations"]:
        assert {glb.document["nodes"][one["target"]["node"]]["name"] for one in clip["channels"]} == {"tibia"}
        turns = glb.array(clip["samplers"][1]["output"])
        assert (np.einsum("ij,ij->i", turns[1:], turns[:-1]) > 0.9).all()
        times = glb.array(clip["samplers"][0]["input"])[:, 0]
        assert (np.diff(times) > 0).all()
        assert times[-1] == pytest.approx(60.0 / 30.0)


def test_quaternions_stay_on_one_side_beyond_half_a_turn() -> None:
    far = content(grid=Grid(np.arange(0.0, 231.0, 5.0), np.array([0.0])))
    glb = Glb(export_files(replace(source(), content=far), ["glb"])["knee.glb"])
    turns = glb.array(glb.clip("flexion_varus_0deg")["samplers"][1]["output"])
    assert (np.einsum("ij,ij->i", turns[1:], turns[:-1]) > 0.9).all()
    assert (turns[:, 3] < 0).any()


@SIDES
def test_glb_nodes(side: str, both: dict[str, Files]) -> None:
    document = Glb(both[side]["knee.glb"]).document
    nodes = document["nodes"]
    tree = {node["name"]: [nodes[child]["name"] for child in node.get("children", [])] for node in nodes}
    root = "knee_R" if side == "right" else "knee_L"
    leaves: dict[str, list[str]] = {"femur": [], "meniscus": [], "patella": []}
    assert tree == {root: ["femur", "tibia", "patella"], "tibia": ["meniscus"], **leaves}
    facts = document["scenes"][0]["extras"]
    assert (facts["side"], facts["moving_node"]) == (side, "tibia")
    assert facts["notice"] == "Research use - not for diagnosis"


@SIDES
def test_glb_stands_upright_in_metres(side: str, both: dict[str, Files]) -> None:
    """The patient's left is +x, superior +y, anterior +z; the reference frame's origin is 0."""
    table = content(side)
    points, _, _ = Glb(both[side]["knee.glb"]).mesh("femur")
    left, posterior, superior = (table.reference_body.points - table.scan_from_reference[:3, 3]).T / 1000
    np.testing.assert_allclose(points, np.stack([left, superior, -posterior], axis=1), rtol=0, atol=1e-7)


@SIDES
def test_osim_agrees_up_to_its_stated_deviation(side: str, both: dict[str, Files]) -> None:
    sample = source(side)
    table = replace(sample.content, smooth=replace(sample.content.smooth, fits=()))
    data = export_files(replace(sample, content=table), ["osim"])["opensim/joint.osim"]
    lut = player(side)
    hand = 1.0 if side == "right" else -1.0
    to_body = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [hand, 0.0, 0.0]])
    scan = [np.linalg.inv(frame) for frame in (table.scan_from_reference, table.scan_from_moving)]
    for flexion, varus in RANDOM:
        values = {f"knee_flexion_{side[0]}": np.radians(flexion), f"knee_varus_{side[0]}": np.radians(varus)}
        found = parent_from_child(data, values)
        expected = scan[0] @ lut.pose(flexion, varus) @ np.linalg.inv(scan[1])
        np.testing.assert_allclose(to_body @ expected[:3, :3] @ to_body.T, found[:3, :3], rtol=0, atol=0.003)
        np.testing.assert_allclose(to_body @ expected[:3, 3], 1000 * found[:3, 3], rtol=0, atol=0.1)


@SIDES
def test_transforms_agree(side: str, both: dict[str, Files], tmp_path: Path) -> None:
    lut = player(side)
    for flexion in (0, 30, 60):
        file = tmp_path / f"{flexion}.tfm"
        file.write_bytes(both[side][f"slicer/tibia_flexion_{flexion}_varus_0.tfm"])
        expected, read = lut.pose(float(flexion), 0.0), SimpleITK.ReadTransform(str(file)).GetInverse()
        for point in content(side).moving_body.points:
            moved = expected[:3, :3] @ point + expected[:3, 3]
            np.testing.assert_allclose(read.TransformPoint(point.tolist()), moved, rtol=0, atol=1e-6)


def test_an_attitude_without_a_pose_has_no_transform() -> None:
    sample = source()
    table = content(bad=((6, 2),))
    assert "slicer/tibia_flexion_30_varus_0.tfm" not in export_files(replace(sample, content=table), ["slicer"])


def test_landmarks_come_back(both: dict[str, Files]) -> None:
    assert read_markups(both["right"]["slicer/landmarks.mrk.json"], "landmarks.mrk.json") == LANDMARKS


def test_meshes_are_made_lighter_near_their_surface() -> None:
    ball = sphere(30.0, (120.0, -80.0, 640.0), fine=6)
    table = content()
    heavy = ExportSource(table, {"femur": ball, "tibia": ball}, {"femur": "reference", "tibia": "moving"}, {})
    files = export_files(heavy, ["glb", "osim"])
    points, triangles, _ = Glb(files["knee.glb"]).mesh("femur")
    assert 0.45 * TRIANGLES < len(triangles) < 0.55 * TRIANGLES
    left, posterior, superior = (np.array([120.0, -80.0, 640.0]) - table.scan_from_reference[:3, 3]) / 1000
    assert np.abs(np.linalg.norm(points - [left, superior, -posterior], axis=1) - 0.03).max() < 5e-5
    assert len(files["knee.glb"]) < 1_500_000
    assert len(files["opensim/Geometry/femur.stl"]) == 84 + 50 * len(triangles)


def test_a_package_makes_its_exports_again(both: dict[str, Files]) -> None:
    sample = source()
    surfaces = [{"structure": name, "body": body, "origin": "labelled"} for name, body in sample.bodies.items()]
    surfaces.append({"structure": "lateral_meniscus", "body": "moving", "origin": "absent"})
    package = {f"meshes/{name}.ply": encode_ply(mesh) for name, mesh in sample.structures.items()}
    package |= {"lut.h5": encode_lut(sample.content), "manifest.json": json.dumps({"surfaces": surfaces}).encode()}
    again = export_files(source_of({**package, **both["right"]}))
    assert again == both["right"]


@pytest.mark.parametrize("missing", ["lut.h5", "manifest.json"])
def test_a_package_that_is_not_complete_is_refused(missing: str) -> None:
    package: dict[str, Any] = {"lut.h5": encode_lut(content()), "manifest.json": b'{"surfaces": []}'}
    del package[missing]
    with pytest.raises(ValueError, match=f"the package is not complete: '{missing}'"):
        source_of(package)


def test_a_damaged_mesh_of_a_package_is_refused() -> None:
    package = {"lut.h5": encode_lut(content()), "manifest.json": b'{"surfaces": []}', "meshes/femur.ply": b"ply"}
    with pytest.raises(CaseRejected, match=r"meshes/femur\.ply"):
        source_of(package)


def test_only_what_is_asked_for_is_made() -> None:
    assert list(export_files(source(), ["json"])) == ["lut.json", "lut.schema.json"]
    assert set(FORMATS) == {"glb", "json", "osim", "slicer"}


def test_an_unknown_format_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown format 'fbx', expected one of glb, json, osim, slicer"):
        export_files(source(), ["glb", "fbx"])


def test_a_single_attitude_has_no_clip() -> None:
    sample = source()
    grid = Grid(np.array([10.0]), np.array([0.0]))
    files = export_files(replace(sample, content=content(grid=grid)))
    assert "animations" not in Glb(files["knee.glb"]).document
    assert "slicer/tibia_flexion_10_varus_0.tfm" in files


@SIDES
def test_the_same_source_gives_the_same_bytes(side: str, both: dict[str, Files]) -> None:
    assert export_files(source(side)) == both[side]
