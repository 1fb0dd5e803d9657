"""From scan space into kinematic frames, for a right and for a left joint."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.mesh import check_closed, volume_mm3
from pipeline.kinematics.body_frames import FARTHEST_MM, in_frame, ligaments_in_frames, scan_pose, stray_fibre
from pipeline.kinematics.joint_coordinates import JointCoordinates, attitude_rotation, reference_from_moving, rigid
from pipeline.kinematics.ligaments import NO_LOAD, Fibres, fibre_load
from pipeline.records import LigamentFibre, Vector
from tests.geometry.knees import MIRROR, about
from tests.geometry.meshes import octahedron

FRAME = rigid(about(10.0, -20.0, 30.0), np.array([50.0, -80.0, 120.0]))


@pytest.mark.parametrize("scan_from_frame", [FRAME, MIRROR @ FRAME], ids=["right", "left"])
def test_a_body_in_its_frame_is_closed_outward_and_where_the_frame_says(
    scan_from_frame: np.ndarray[tuple[int, int], np.dtype[np.float64]],
) -> None:
    body = octahedron(10.0)
    seen = in_frame(body, scan_from_frame)
    check_closed(seen, "body")
    assert volume_mm3(seen) == pytest.approx(volume_mm3(body))
    back = seen.points @ scan_from_frame[:3, :3].T + scan_from_frame[:3, 3]
    np.testing.assert_allclose(back, body.points, rtol=0, atol=1e-12)


def test_a_left_body_looks_like_the_right_one_in_its_frame() -> None:
    body = octahedron(10.0)
    mirrored = in_frame(body, MIRROR)  # the mirrored scan of the body
    np.testing.assert_allclose(
        in_frame(mirrored, MIRROR @ FRAME).points, in_frame(body, FRAME).points, rtol=0, atol=1e-12
    )


def test_the_scan_pose_leaves_the_driven_angles_out() -> None:
    pose = scan_pose((8.0, 1.0, 90.0, 0.5, 2.0, -21.0))
    assert pose == pytest.approx((0.5, 2.0, -21.0, np.pi / 2.0))


SCAN = JointCoordinates(0.4, -0.05, 0.2, 3.0, -2.0, -31.0)
SCAN_FROM_MOVING = FRAME @ reference_from_moving(SCAN)
FIBRES = (
    LigamentFibre("ACL", (40.0, -70.0, 130.0), (52.0, -85.0, 95.0), None, 820.0),
    LigamentFibre("LCL", (90.0, -60.0, 120.0), (95.0, -70.0, 60.0), 55.0, 600.0),
    LigamentFibre("cord", (20.0, -60.0, 120.0), (15.0, -70.0, 60.0), None, None),
)
LENGTHS = [math.dist(fibre.reference, fibre.moving) for fibre in FIBRES]


@pytest.mark.parametrize("k", range(3))
def test_at_the_scan_pose_a_fibre_is_as_long_as_in_the_scan(k: int) -> None:
    found = ligaments_in_frames(FIBRES[k : k + 1], FRAME, SCAN_FROM_MOVING)
    on_reference = found.on_reference @ attitude_rotation(SCAN.flexion_rad, SCAN.varus_rad)
    unstretched = Fibres(on_reference, found.on_moving, np.zeros(1), np.ones(1))
    place = (SCAN.lateral_mm, SCAN.anterior_mm, SCAN.internal_rotation_rad, SCAN.proximal_mm)
    assert fibre_load(unstretched, place).energy_mm == pytest.approx(0.5 * LENGTHS[k] ** 2)
    assert found.names == (FIBRES[k].name,)


def test_ligaments_of_a_left_knee_are_those_of_its_mirror_image() -> None:
    def flipped(point: Vector) -> Vector:
        x, y, z = MIRROR[:3, :3] @ point
        return float(x), float(y), float(z)

    left = [replace(fibre, reference=flipped(fibre.reference), moving=flipped(fibre.moving)) for fibre in FIBRES]
    assert left[0].reference != FIBRES[0].reference
    here = ligaments_in_frames(FIBRES, FRAME, SCAN_FROM_MOVING)
    there = ligaments_in_frames(left, MIRROR @ FRAME, MIRROR @ SCAN_FROM_MOVING)
    np.testing.assert_allclose(there.on_reference, here.on_reference, rtol=0, atol=1e-12)
    np.testing.assert_allclose(there.on_moving, here.on_moving, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(there.slack_mm, here.slack_mm)


def test_slack_lengths_that_are_not_given_come_from_the_scan() -> None:
    plain, strained = (ligaments_in_frames(FIBRES, FRAME, SCAN_FROM_MOVING, strain) for strain in (0.0, 0.05))
    np.testing.assert_allclose(plain.slack_mm, [LENGTHS[0], 55.0, LENGTHS[2]])
    np.testing.assert_allclose(strained.slack_mm, [LENGTHS[0] / 1.05, 55.0, LENGTHS[2]])
    np.testing.assert_array_equal(plain.stiffness_n, [820.0, 600.0, np.inf])


def test_a_case_without_ligaments() -> None:
    none = ligaments_in_frames((), FRAME, SCAN_FROM_MOVING)
    assert fibre_load(none.fibres(10.0), (1.0, 2.0, 0.3, 4.0)) is NO_LOAD
    assert stray_fibre(none, octahedron(10.0), octahedron(10.0)) is None


def test_a_fibre_that_ends_nowhere_near_its_body() -> None:
    body = octahedron(10.0)
    near = LigamentFibre("near", (0.0, 0.0, 10.0), (0.0, 0.0, -10.0 - FARTHEST_MM + 0.1), None, None)
    aside = (0.0, 60.0, 0.0)
    for end, far in (("reference", replace(near, reference=aside)), ("moving", replace(near, moving=aside))):
        found = ligaments_in_frames([near, replace(far, name="far")], np.eye(4), np.eye(4))
        assert stray_fibre(found, body, body) == f"Fibre far ends 50 mm from the {end} body, expected at most 40 mm."
    assert stray_fibre(ligaments_in_frames([near], np.eye(4), np.eye(4)), body, body) is None
