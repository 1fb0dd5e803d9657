"""Playback from the file: one attitude and many, both sides, and what the table does not cover."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.files.lut_file import encode_lut
from pipeline.kinematics.interpolation import moved_from_scan_table
from pipeline.kinematics.joint_coordinates import rotation_x, rotation_y
from pipeline.playback import Lut
from tests.files.lut_sample import GRID, content

BAD = ((3, 1), (4, 1))


def written(folder: Path, side: str = "right", bad: tuple[tuple[int, int], ...] = ()) -> Lut:
    path = folder / "lut.h5"
    path.write_bytes(encode_lut(content(side, bad=bad)))
    return Lut.open(path)


@pytest.mark.parametrize("side", ["right", "left"])
def test_entries_are_played_back(tmp_path: Path, side: str) -> None:
    lut, expected = written(tmp_path, side), moved_from_scan_table(content(side).table)
    assert (lut.joint, lut.side, lut.software) == ("knee", side, "ct2lut 0.0.0")
    assert lut.flexion_range == (0.0, 60.0)
    assert lut.varus_range == (-4.0, 2.5)
    for (i, flexion), (j, varus) in zip(enumerate(GRID.flexion_deg), enumerate(GRID.varus_deg), strict=False):
        np.testing.assert_allclose(lut.pose(float(flexion), float(varus)), expected[i, j], rtol=0, atol=1e-10)
    everywhere = lut.pose(GRID.flexion_deg[:, None], GRID.varus_deg[None, :])
    np.testing.assert_allclose(everywhere, expected, rtol=0, atol=1e-10)


def test_one_attitude_and_many_agree(tmp_path: Path) -> None:
    lut = written(tmp_path, "left", BAD)
    rng = np.random.default_rng(3)
    flexion, varus = rng.uniform(-3, 63, 300), rng.uniform(-4.5, 3, 300)
    for policy in ("clamp", "nan"):
        many = lut.pose(flexion, varus, policy)
        for one, f, v in zip(many, flexion, varus, strict=True):
            np.testing.assert_allclose(lut.pose(float(f), float(v), policy), one, rtol=0, atol=1e-10)


def test_attitudes_broadcast(tmp_path: Path) -> None:
    lut = written(tmp_path)
    assert lut.pose(12).shape == (4, 4)
    assert lut.pose(np.linspace(0, 60, 7)).shape == (7, 4, 4)
    assert lut.pose(np.linspace(0, 60, 7)[:, None], [0.0, 1.0, 2.0]).shape == (7, 3, 4, 4)
    np.testing.assert_array_equal(lut.pose(12), lut.pose(12.0, 0.0))


def test_coordinates_have_clinical_units_and_say_what_was_used(tmp_path: Path) -> None:
    lut = written(tmp_path)
    entry = lut.coordinates(25.0, 2.5)
    poses = content().smooth.poses
    assert entry == (
        25.0,
        2.5,
        *(
            curve[5, 3]
            for curve in (poses.internal_rotation_deg, poses.lateral_mm, poses.anterior_mm, poses.proximal_mm)
        ),
    )
    beyond = lut.coordinates([25.0, 99.0], 2.5, outside="clamp")
    np.testing.assert_array_equal(beyond.flexion_deg, [25.0, 60.0])
    assert beyond.internal_rotation_deg[1] == poses.internal_rotation_deg[-1, 3]


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_frames_of_both_bodies_give_the_same_pose(tmp_path: Path, side: str) -> None:
    lut, made = written(tmp_path, side), content(side)
    flexion = np.linspace(0.0, 60.0, 7)
    frames = lut.reference_from_moving(flexion, -0.5)
    chained = made.scan_from_reference @ frames @ np.linalg.inv(made.scan_from_moving)
    np.testing.assert_allclose(lut.pose(flexion, -0.5), chained, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(frames[:, :3, :3]), 1.0, rtol=0, atol=1e-12)
    expected = lut.coordinates(60.0, -0.5)
    attitude = frames[-1, :3, 3] @ (rotation_x(-np.radians(60.0)) @ rotation_y(np.radians(-0.5)))
    np.testing.assert_allclose(attitude, expected[3:], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("flexion", "varus"), [(60.1, 0.0), (10.0, 2.6), (17.5, -1.0), (17.5, -0.7), (float("nan"), 0.0)]
)
def test_what_is_not_covered_is_refused_or_named(tmp_path: Path, flexion: float, varus: float) -> None:
    lut = written(tmp_path, bad=BAD)
    with pytest.raises(ValueError, match=r"outside the table|no stable pose at"):
        lut.pose(flexion, varus)
    assert np.isnan(lut.pose(flexion, varus, "nan")).all()


def test_clamp_never_leaves_the_covered_table(tmp_path: Path) -> None:
    lut = written(tmp_path, bad=BAD)
    np.testing.assert_allclose(lut.pose(80.0, 0.0, "clamp"), lut.pose(60.0, 0.0), rtol=0, atol=1e-10)
    np.testing.assert_allclose(lut.pose(17.5, -0.1, "clamp"), lut.pose(17.5, 0.0), rtol=0, atol=1e-10)


def test_bodies_are_those_of_the_table(tmp_path: Path) -> None:
    bodies = written(tmp_path).bodies
    np.testing.assert_array_equal(bodies.reference.points, content().reference_body.points)
    np.testing.assert_array_equal(bodies.moving.triangles, content().moving_body.triangles)


def test_the_message_names_the_file_and_not_its_folder(tmp_path: Path) -> None:
    path = tmp_path / "other.h5"
    path.write_bytes(b"not a table")
    with pytest.raises(ValueError, match=r"^other\.h5: not a readable table") as caught:
        Lut.open(path)
    assert str(tmp_path) not in str(caught.value)


def test_playback_needs_numpy_and_h5py_alone(tmp_path: Path) -> None:
    written(tmp_path)
    script = (
        "import sys; from pipeline.playback import Lut; Lut.open(sys.argv[1]).pose(30.0, 1.0, 'clamp')\n"
        "print(*sorted({name.partition('.')[0] for name in sys.modules} & "
        "{'pydantic', 'scipy', 'vtk', 'vtkmodules', 'trimesh', 'fcl', 'cv2', 'matplotlib', 'yaml'}))"
    )
    run = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "lut.h5")], capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == ""
