"""From scan space into kinematic frames, for a right and for a left joint."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.mesh import check_closed, volume_mm3
from pipeline.kinematics.body_frames import in_frame, scan_pose
from pipeline.kinematics.joint_coordinates import rigid
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
