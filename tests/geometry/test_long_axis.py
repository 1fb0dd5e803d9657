"""The axis of shafts that are known: a flared, oblique cylinder whose far end the scan's border cuts."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.directions import angle_deg
from pipeline.geometry.long_axis import STRAY_MM, long_axis
from pipeline.geometry.mesh import TriangleMesh, merged, transformed
from pipeline.geometry.validation_objects import box, revolved
from pipeline.kinematics.joint_coordinates import rigid
from tests.geometry.knees import about

Z = np.array([0.0, 0.0, 1.0])


def bone(shaft_mm: float, cut_deg: float = 0.0, sectors: int = 64) -> TriangleMesh:
    """A flare of 40 mm radius that narrows to a shaft of 12 mm over 40 mm; its cap is tilted by ``cut_deg``."""
    top = 40.0 + shaft_mm
    rings = np.linspace(40.0, top, 12)[:-1]
    profile = np.vstack(
        [[[0, 0], [40, 0], [40, 10]], np.column_stack([np.full(11, 12.0), rings]), [[12, top], [0, top]]]
    )
    made = revolved(profile, sectors)
    end = made.points[:, 2] == top
    tilted = made.points.copy()
    tilted[end, 2] += np.tan(np.radians(cut_deg)) * made.points[end, 0]
    return TriangleMesh(tilted, made.triangles)


@pytest.mark.parametrize("cut_deg", [0.0, 15.0, 30.0])
@pytest.mark.parametrize("rough", [(0.0, 0.0, 0.0), (25.0, 0.0, 0.0), (-15.0, 20.0, 0.0)])
def test_the_axis_of_an_oblique_shaft_is_found(cut_deg: float, rough: tuple[float, float, float]) -> None:
    motion = rigid(about(25.0, -40.0, 70.0), np.array([30.0, -500.0, 800.0]))
    true = motion[:3, :3] @ Z
    found = long_axis(transformed(bone(60.0, cut_deg), motion), motion[:3, :3] @ about(*rough) @ Z)
    assert angle_deg(found.direction, true) < 0.1
    off = found.far_centre - motion[:3, 3]
    assert np.linalg.norm(off - (off @ true) * true) < 0.05
    # from where the flare has 0.6 of its area to where the oblique cut begins
    assert found.length_mm == pytest.approx(100.0 - 19.0 - 12.0 * np.tan(np.radians(cut_deg)), abs=4.0)


def test_the_uncertainty_is_the_stray_over_the_length() -> None:
    short, long = long_axis(bone(25.0), Z), long_axis(bone(80.0), Z)
    assert short.uncertainty_deg > long.uncertainty_deg > 0.5
    assert long.uncertainty_deg == pytest.approx(0.5 + np.degrees(np.arctan(STRAY_MM / long.length_mm)))


def test_a_bone_without_shaft_is_refused() -> None:
    with pytest.raises(ValueError, match="fewer than 6 cross-sections beyond the joint"):
        long_axis(box((-30.0, 30.0), (-20.0, 20.0), (0.0, 12.0)), Z)
    with pytest.raises(ValueError, match="too short for cross-sections"):
        long_axis(box((-30.0, 30.0), (-20.0, 20.0), (0.0, 5.0)), Z)


def test_without_a_shaft_the_last_of_the_flare_must_do_and_says_so() -> None:
    """A cone that never falls below 0.6 of its widest area: the last six sections, uncertain by 14 deg."""
    stump = revolved(np.array([[0, 0], [30, 0], [30, 4], [25, 44], [0, 44]], dtype=float), 48)
    found = long_axis(stump, Z)
    assert angle_deg(found.direction, Z) < 0.1
    assert found.length_mm == pytest.approx(10.0)
    assert found.uncertainty_deg == pytest.approx(0.5 + np.degrees(np.arctan(STRAY_MM / 10.0)))


def test_a_gap_in_the_bone_is_stepped_over() -> None:
    """The lower piece ends in a point, so nothing there looks like the scan's border; planes in the gap miss."""
    pointed = revolved(np.array([[0, 0], [40, 0], [40, 10], [12, 40], [12, 70], [0, 90]], dtype=float), 32)
    upper = revolved(np.array([[0, 100], [12, 120], [12, 150], [0, 170]], dtype=float), 32)
    found = long_axis(merged([pointed, upper]), Z)
    assert angle_deg(found.direction, Z) < 1e-6
    assert found.far_centre[2] > 160.0
