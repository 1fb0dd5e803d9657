"""Joint coordinates: round trip, an independent oracle, and the clinical meaning of every sign."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeline.kinematics.joint_coordinates import (
    JointCoordinates,
    attitude_rotation,
    joint_coordinates,
    moved_from_scan,
    reference_from_moving,
    rigid,
    rotation_x,
    rotation_y,
    rotation_z,
)

LATERAL, ANTERIOR, PROXIMAL = np.eye(3)
FOOT = np.array([0.0, 0.0, -350.0])
RIGHT_HANDED = np.eye(4)


def full_turn() -> st.SearchStrategy[float]:
    return st.floats(-3.1, 3.1)


def coordinates() -> st.SearchStrategy[JointCoordinates]:
    length = st.floats(-200.0, 200.0)
    return st.builds(JointCoordinates, full_turn(), st.floats(-1.5, 1.5), full_turn(), length, length, length)


def oracle(pose: JointCoordinates) -> Rotation:
    """Grood & Suntay's three turns as intrinsic rotations, by scipy."""
    return Rotation.from_euler("XYZ", [-pose.flexion_rad, pose.varus_rad, pose.internal_rotation_rad])


@given(coordinates())
def test_round_trip(pose: JointCoordinates) -> None:
    np.testing.assert_allclose(joint_coordinates(reference_from_moving(pose)), pose, atol=1e-9)


@given(coordinates())
def test_rotation_against_scipy(pose: JointCoordinates) -> None:
    matrix = reference_from_moving(pose)
    np.testing.assert_allclose(matrix[:3, :3], oracle(pose).as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0])


@given(coordinates())
def test_shift_lies_along_the_axes_of_the_attitude(pose: JointCoordinates) -> None:
    """d is measured in the attitude frame, whose z is the moving body's: proximal is along delta at any attitude."""
    matrix = reference_from_moving(pose)
    attitude = Rotation.from_euler("XY", [-pose.flexion_rad, pose.varus_rad])
    np.testing.assert_allclose(matrix[:3, 3], attitude.apply(pose[3:]), atol=1e-9)
    np.testing.assert_allclose(matrix[:3, 2], attitude.apply(PROXIMAL), atol=1e-12)


@given(st.integers(0, 2**32 - 1))
def test_any_motion_has_coordinates(seed: int) -> None:
    random = np.random.default_rng(seed)
    motion = rigid(Rotation.random(random_state=random).as_matrix(), random.normal(size=3) * 50.0)
    found = joint_coordinates(motion)
    np.testing.assert_allclose(reference_from_moving(found), motion, atol=1e-9)
    assert abs(found.varus_rad) <= np.pi / 2


def zero() -> JointCoordinates:
    return JointCoordinates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def moved(pose: JointCoordinates, point: np.ndarray) -> np.ndarray:
    return np.asarray(reference_from_moving(pose)[:3] @ np.append(point, 1.0))


@pytest.mark.parametrize("angle", [0.05, 0.7, 1.4])
def test_flexion_moves_the_foot_backward_and_up(angle: float) -> None:
    foot = moved(zero()._replace(flexion_rad=angle), FOOT)
    assert foot @ ANTERIOR < 0.0
    assert foot @ PROXIMAL > -350.0
    assert foot @ LATERAL == 0.0


@pytest.mark.parametrize("flexion", [0.0, 0.5, 1.5])
def test_varus_tilts_the_distal_tibia_medially(flexion: float) -> None:
    assert moved(zero()._replace(flexion_rad=flexion, varus_rad=0.1), FOOT) @ LATERAL < -30.0


@pytest.mark.parametrize("flexion", [0.0, 0.5, 1.5])
def test_internal_rotation_turns_the_anterior_axis_medially(flexion: float) -> None:
    pose = zero()._replace(flexion_rad=flexion, internal_rotation_rad=0.2)
    assert moved(pose, ANTERIOR) @ LATERAL == pytest.approx(-np.sin(0.2))


@pytest.mark.parametrize(("name", "axis"), [("lateral_mm", 0), ("anterior_mm", 1), ("proximal_mm", 2)])
def test_translations_in_extension(name: str, axis: int) -> None:
    np.testing.assert_allclose(moved(zero()._replace(**{name: 3.0}), np.zeros(3)), 3.0 * np.eye(3)[axis])


def test_left_joint_is_the_mirror_image_of_the_right() -> None:
    """Frames mirrored in the sagittal plane, the same six numbers: the motion is the mirrored motion, and proper."""
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    reference = rigid(Rotation.from_euler("XYZ", [0.2, -0.1, 0.3]).as_matrix(), np.array([5.0, -3.0, 700.0]))
    moving = rigid(Rotation.from_euler("XYZ", [0.1, 0.2, -0.2]).as_matrix(), np.array([4.0, -2.0, 690.0]))
    pose = JointCoordinates(0.8, 0.05, 0.15, 1.0, -4.0, 2.0)
    right, left = moved_from_scan(reference, moving, pose), moved_from_scan(mirror @ reference, mirror @ moving, pose)
    np.testing.assert_allclose(left, mirror @ right @ mirror, atol=1e-9)
    assert np.linalg.det(left[:3, :3]) == pytest.approx(1.0)


def test_scan_pose_does_not_move() -> None:
    reference = rigid(rotation_z(0.3) @ rotation_x(0.1), np.array([1.0, 2.0, 3.0]))
    moving = rigid(rotation_y(-0.2) @ rotation_z(0.5), np.array([-2.0, 1.0, 8.0]))
    at_scan = joint_coordinates(np.linalg.inv(reference) @ moving)
    np.testing.assert_allclose(moved_from_scan(reference, moving, at_scan), RIGHT_HANDED, atol=1e-12)


@pytest.mark.parametrize(("turn", "axis"), [(rotation_x, 0), (rotation_y, 1), (rotation_z, 2)])
def test_elementary_rotations_against_scipy(turn: object, axis: int) -> None:
    assert callable(turn)
    expected = Rotation.from_rotvec(0.7 * np.eye(3)[axis]).as_matrix()
    np.testing.assert_allclose(turn(0.7), expected, atol=1e-15)


def test_attitude_is_flexion_then_varus() -> None:
    expected = Rotation.from_euler("XY", [-0.4, 0.2]).as_matrix()
    np.testing.assert_allclose(attitude_rotation(0.4, 0.2), expected, atol=1e-15)
