"""Exact motions: where they stop, on which side of contact, and what they may step over."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.validation_objects import BarOnPyramids, box
from pipeline.kinematics.contact import AttitudeContact, Pose
from pipeline.kinematics.descent import MotionSettings, drop, move_until_contact
from tests.kinematics.shapes import at_attitude, ellipsoid, falling, joined

SETTINGS = MotionSettings()


@pytest.fixture(scope="module")
def pyramids() -> AttitudeContact:
    return falling(BarOnPyramids().pair())


@pytest.mark.parametrize("tolerance_mm", [0.01, 2e-4, 1e-7])
@pytest.mark.parametrize("pose", [Pose(0.3, 1.0, -20, 0.2), Pose(-1.0, 0.0, -9.37, -0.1), Pose(0.2, 0.0, -1.0, 0.05)])
def test_drop_ends_clear_and_touches_one_tolerance_on(
    pyramids: AttitudeContact, pose: Pose, tolerance_mm: float
) -> None:
    """From above, from near by and from within an intersection; the height is that of the closed form."""
    landed = drop(pyramids, pose, MotionSettings(tolerance_mm))
    assert landed is not None
    assert (landed.x, landed.y, landed.theta) == (pose.x, pose.y, pose.theta)
    assert not pyramids.touches(landed)
    assert pyramids.touches(landed._replace(z=landed.z + tolerance_mm))
    sideways = pose.x * np.cos(pose.theta) + pose.y * np.sin(pose.theta)
    height = BarOnPyramids().standing_height_mm(sideways, pose.theta)
    assert landed.z == pytest.approx(-height, abs=1.01 * tolerance_mm + 1e-9)


def test_drop_without_contact(pyramids: AttitudeContact) -> None:
    assert drop(pyramids, Pose(100.0, 0.0, -20.0, 0.0), SETTINGS) is None


def test_drop_reaches_as_far_as_the_travel(pyramids: AttitudeContact) -> None:
    assert drop(pyramids, Pose(0, 0, -20, 0), MotionSettings(travel_mm=14.0)) is None
    assert drop(pyramids, Pose(0, 0, -20, 0), MotionSettings(travel_mm=15.5)) is not None


@pytest.mark.parametrize("dx", [0.7, 5.0, 30.0])
def test_translation_stops_at_the_wall(dx: float) -> None:
    wall, cube = box((3.0, 4.0), (-9.0, 9.0), (-9.0, 9.0)), box((-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0))
    ended, collided = move_until_contact(at_attitude(wall, cube), Pose(0, 0, 0, 0), (dx, 0.0, 0.0), SETTINGS)
    assert collided is (dx > 2.0)
    assert ended.x == pytest.approx(min(dx, 2.0), abs=SETTINGS.tolerance_mm)
    assert ended.x <= 2.0


def test_rotation_stops_at_the_wall() -> None:
    """The corner of a 4 x 2 mm plate meets a wall at x = 2.1 where the plate's half diagonal reaches it."""
    wall, plate = box((2.1, 3.0), (-9.0, 9.0), (-9.0, 9.0)), box((-2.0, 2.0), (-1.0, 1.0), (-1.0, 1.0))
    ended, collided = move_until_contact(at_attitude(wall, plate), Pose(0, 0, 0, 0), (0.0, 0.0, 1.0), SETTINGS)
    expected = np.arctan2(1.0, 2.0) - np.arccos(2.1 / np.sqrt(5.0))
    assert collided
    assert ended.theta == pytest.approx(expected, abs=SETTINGS.tolerance_mm / SETTINGS.radius_mm)


@pytest.mark.parametrize("rim_mm", [0.02, 0.1, 0.3])
def test_a_thin_rim_is_not_jumped_by_a_long_step(rim_mm: float) -> None:
    """A body thicker than the substep meets even a rim far thinner than it: their surfaces cross all the way."""
    plate = box((-20, 20), (-10, 10), (0, 2))
    rim = box((3.0, 3.0 + rim_mm), (-10, 10), (-4, 1))
    pair = at_attitude(joined(plate, rim), box((-2, 2), (-2, 2), (-6, 0)))
    landed = drop(pair, Pose(0, 0, -0.3, 0), SETTINGS)
    assert landed is not None
    ended, collided = move_until_contact(pair, landed, (12.0, 0.0, 0.0), SETTINGS)
    assert collided
    assert ended.x == pytest.approx(1.0, abs=2 * SETTINGS.tolerance_mm)


def test_limit_two_things_thinner_than_the_substep_may_pass() -> None:
    """A sheet of 0.2 mm through one of 0.1 mm: seen with substeps below their joint thickness, not surely above."""
    sheet, leaf = box((-9, 9), (-9, 9), (0.0, 0.2)), box((-1, 1), (-1, 1), (-0.1, 0.0))
    pair = at_attitude(sheet, leaf)
    for start in np.linspace(-3.0, -2.5, 11):
        landed = drop(pair, Pose(0, 0, float(start), 0), MotionSettings(substep_mm=0.1))
        assert landed is not None
        assert landed.z == pytest.approx(0.0, abs=3e-4)
    coarse = [drop(pair, Pose(0, 0, float(start), 0), MotionSettings(substep_mm=2.0)) for start in (-2.9, -2.1)]
    assert None in coarse


def test_height_of_two_ellipsoids_is_that_of_their_curvatures() -> None:
    """Near the apex each sinks as d^2 / (2 (R + R')); the lattice has no symmetry: as exact as its facets are fine."""
    pair = at_attitude(ellipsoid((10, 8, 6), 1500), ellipsoid((9, 7, 5), 1500))
    heights = []
    for x, y in ((2.0, 1.0), (-2.0, 1.0), (2.0, -1.0), (-2.0, -1.0)):
        landed = drop(pair, Pose(x, y, -30.0, 0.0), SETTINGS)
        assert landed is not None
        heights.append(landed.z)
    np.testing.assert_allclose(heights, heights[0], atol=0.05)
    top = drop(pair, Pose(0, 0, -30.0, 0.0), SETTINGS)
    assert top is not None
    assert top.z == pytest.approx(-11.0, abs=0.05)
    across, along = 10**2 / 6 + 9**2 / 5, 8**2 / 6 + 7**2 / 5
    rise = 2.0**2 / (2 * across) + 1.0**2 / (2 * along)
    assert heights[0] - top.z == pytest.approx(rise, abs=0.03)
