"""What the drawings of the guides show is so: signs in the patient's own directions, frames, shifts, zero pose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.kinematics.joint_coordinates import JointCoordinates, joint_coordinates
from pipeline.records import Side
from tools.frames_drawing import SIGN_PX, SIGNS, Knee, Sign, raised, shift_steps, sign_view, signs_picture, way

Float = NDArray[np.float64]
CHECKOUT = Path(__file__).parents[1]
SIDES: tuple[Side, Side] = ("right", "left")
#: Directions of the patient, LPS: what is lateral depends on the leg, the rest does not.
PATIENT = {"anterior": (0, -1, 0), "posterior": (0, 1, 0), "proximal": (0, 0, 1), "distal": (0, 0, -1)}
BY_SIDE = {
    "right": PATIENT | {"lateral": (-1, 0, 0), "medial": (1, 0, 0)},
    "left": PATIENT | {"lateral": (1, 0, 0), "medial": (-1, 0, 0)},
}
#: Written down anew, and not read from the drawing: coordinate -> where its marked point goes.
MEANINGS = {
    "flexion_rad": "posterior",
    "varus_rad": "medial",
    "internal_rotation_rad": "medial",
    "lateral_mm": "lateral",
    "anterior_mm": "anterior",
    "proximal_mm": "proximal",
}
both_sides = pytest.mark.parametrize("side", SIDES)
each_sign = pytest.mark.parametrize("sign", SIGNS, ids=lambda sign: sign.coordinate)


def test_there_is_a_panel_for_each_coordinate() -> None:
    assert [sign.coordinate for sign in SIGNS] == list(JointCoordinates._fields) == list(MEANINGS)


@both_sides
@each_sign
def test_marked_point_goes_where_the_sign_says(side: Side, sign: Sign) -> None:
    """Internal rotation, say, turns the front of the tibia towards the other leg, on both sides."""
    path = way(Knee(side), sign)
    gone = path[-1] - path[0]
    assert sign.toward == MEANINGS[sign.coordinate]
    along = float(gone @ BY_SIDE[side][sign.toward])
    assert along > 5.0
    assert along > 0.85 * np.linalg.norm(gone)


@both_sides
@each_sign
def test_arrow_points_to_the_word_at_the_edge(side: Side, sign: Sign) -> None:
    knee = Knee(side)
    seen = sign_view(knee, sign)
    start, end = seen.pixels(way(knee, sign)[[0, -1]], (SIGN_PX, SIGN_PX))
    right, down = end - start
    left_to_right = abs(right) > abs(down)
    edge = (1 if right > 0 else 0) if left_to_right else (3 if down > 0 else 2)
    assert seen.edges[edge] == sign.toward


@both_sides
@each_sign
def test_only_one_coordinate_changes(side: Side, sign: Sign) -> None:
    """Found from the motion itself, between the phantom's true frames."""
    knee = Knee(side)
    motion = knee.motion(raised(knee.start, sign))
    moving_frame = motion @ knee.truth.scan_from_moving
    found = joint_coordinates(np.linalg.inv(knee.truth.scan_from_reference) @ moving_frame)
    change = np.subtract(found, knee.start)
    expected = [sign.amount if name == sign.coordinate else 0.0 for name in JointCoordinates._fields]
    np.testing.assert_allclose(change, expected, atol=1e-9)
    assert np.linalg.det(motion[:3, :3]) == pytest.approx(1.0)


@both_sides
def test_shifts_lead_from_one_origin_to_the_other(side: Side) -> None:
    """And the last of them, proximal, is along delta where the tibia is by then, not along the femur."""
    knee = Knee(side)
    pose = knee.start._replace(flexion_rad=np.radians(60.0), varus_rad=0.1, lateral_mm=3.0, anterior_mm=14.0)
    corners = shift_steps(knee, pose)
    delta = knee.motion(pose)[:3, :3] @ knee.truth.delta
    np.testing.assert_allclose(corners[0], knee.truth.scan_from_reference[:3, 3], atol=1e-9)
    np.testing.assert_allclose(corners[3], knee.moved(knee.truth.scan_from_moving[None, :3, 3], pose)[0], atol=1e-9)
    np.testing.assert_allclose(corners[3] - corners[2], pose.proximal_mm * delta, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(np.diff(corners, axis=0), axis=1), np.abs(pose[3:]), atol=1e-9)


@both_sides
def test_frames_coincide_in_the_zero_pose(side: Side) -> None:
    knee = Knee(side)
    zero = JointCoordinates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    placed = knee.motion(zero) @ knee.truth.scan_from_moving
    np.testing.assert_allclose(placed, knee.truth.scan_from_reference, atol=1e-9)


def test_drawing_of_a_left_knee_is_not_that_of_a_right_one() -> None:
    """Both are drawn, and bones are there: neither is blank."""
    right, left = (signs_picture(Knee(side, spacing_mm=2.5)) for side in SIDES)
    assert right.shape == left.shape
    assert (right != left).any(axis=2).mean() > 0.05
    assert (right < 200).any(axis=2).mean() > 0.1


def test_pictures_of_the_guides_are_light_and_shown() -> None:
    """What no page shows any more does not stay behind."""
    texts = "".join(path.read_text() for path in [CHECKOUT / "README.md", *sorted((CHECKOUT / "docs").glob("*.md"))])
    pictures = sorted((CHECKOUT / "docs" / "images").iterdir())
    assert sum(picture.stat().st_size for picture in pictures) < 1_500_000
    assert not [picture.name for picture in pictures if f"images/{picture.name})" not in texts]
