"""Paths of contact of two balls on two flat tiles, which the poses of the made-up knee move: known in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.mesh import TriangleMesh, merged, transformed
from pipeline.kinematics.joint_coordinates import rotation_z
from pipeline.kinematics.table import Grid, Status
from pipeline.records import Side
from pipeline.report.contact_paths import BAND_MM, ContactPath, contact_paths, excursion_mm
from pipeline.report.evidence import Evidence
from tests.geometry.knees import sphere
from tests.report.sample import CONDYLE_MM, only_one_attitude, sample_evidence, with_status

#: How far the balls stand to either side, and how deep the table lets the tiles fall away from them.
MIDDLE_MM, FALL_MM = 22.0, 0.3


def tile(middle_mm: float) -> TriangleMesh:
    """A square 36 mm wide that faces up."""
    corners = np.array([[-18.0, -18.0, 0.0], [18.0, -18.0, 0.0], [18.0, 18.0, 0.0], [-18.0, 18.0, 0.0]])
    return TriangleMesh(np.add(corners, [middle_mm, 0.0, 0.0]), np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))


def balls_on_tiles(knee: Side = "right", *middles_mm: float) -> Evidence:
    """Evidence of these bodies; tiles under both balls unless it is said under which."""
    evidence = sample_evidence(knee)
    balls = merged([sphere(CONDYLE_MM, (side * MIDDLE_MM, 0.0, 0.0), fine=5) for side in (-1.0, 1.0)])
    tiles = merged([tile(middle) for middle in middles_mm or (-MIDDLE_MM, MIDDLE_MM)])
    return replace(
        evidence,
        reference=transformed(balls, evidence.scan_from_reference),
        moving=transformed(tiles, evidence.scan_from_moving),
    )


def expected(evidence: Evidence, side_mm: float) -> np.ndarray:
    """(F, 2) lateral and anterior of the foot of a ball, in the moving body's frame."""
    poses, places = evidence.smooth.poses, []
    for row in range(len(evidence.smooth.grid.flexion_deg)):
        turned = rotation_z(float(np.radians(poses.internal_rotation_deg[row, 1]))).T
        places.append(turned @ [side_mm - poses.lateral_mm[row, 1], -poses.anterior_mm[row, 1], 0.0])
    return np.array(places)[:, :2]


@pytest.mark.parametrize("knee", ["right", "left"])
def test_the_middle_of_contact_lies_under_each_ball(knee: Side) -> None:
    evidence = balls_on_tiles(knee)
    medial, lateral = contact_paths(evidence)
    assert (medial.side, lateral.side) == ("medial", "lateral")
    for path, side_mm in ((medial, -MIDDLE_MM), (lateral, MIDDLE_MM)):
        np.testing.assert_array_equal(path.flexion_deg, evidence.smooth.grid.flexion_deg)
        found = np.column_stack([path.lateral_mm, path.anterior_mm])
        np.testing.assert_allclose(found, expected(evidence, side_mm), rtol=0, atol=0.5)
        fall = FALL_MM * np.sin(np.radians(path.flexion_deg))
        np.testing.assert_allclose(path.gap_mm, fall, rtol=0, atol=0.05)


def test_a_side_that_is_open_by_more_than_the_band_does_not_touch() -> None:
    path = contact_paths(balls_on_tiles())[0]
    assert path.touching[[0, 1, 2]].all()
    assert not path.touching[[5, 9, 12]].any()


def test_flexions_are_five_degrees_apart_and_usable() -> None:
    evidence = with_status(balls_on_tiles(), (3, 1), Status.SLID_OFF)
    assert 30.0 not in contact_paths(evidence)[0].flexion_deg
    fine = replace(evidence.smooth, grid=Grid(np.arange(0.0, 13.0), evidence.smooth.grid.varus_deg))
    np.testing.assert_array_equal(contact_paths(replace(evidence, smooth=fine))[0].flexion_deg, [0.0, 5.0, 10.0])


def test_no_pose_and_no_surface_on_a_side_have_no_path() -> None:
    alone = only_one_attitude(balls_on_tiles())
    assert [len(path.flexion_deg) for path in contact_paths(alone)] == [1, 1]
    assert contact_paths(with_status(alone, (0, 0), Status.NO_CONTACT)) == ()
    assert [path.side for path in contact_paths(balls_on_tiles("right", MIDDLE_MM))] == ["lateral"]


def test_a_body_that_is_far_away_has_places_that_are_not_known() -> None:
    evidence = balls_on_tiles()
    far = replace(evidence.smooth.poses, proximal_mm=evidence.smooth.poses.proximal_mm - 10.0)
    path = contact_paths(replace(evidence, smooth=replace(evidence.smooth, poses=far)))[0]
    assert np.isnan([path.lateral_mm, path.anterior_mm, path.gap_mm]).all()
    assert np.isnan(excursion_mm(path))


def test_an_excursion_counts_where_the_side_touches() -> None:
    forwards, gap = np.array([3.0, -2.0, 40.0]), np.array([0.0, BAND_MM, BAND_MM + 0.01])
    assert excursion_mm(ContactPath("medial", np.arange(3.0), np.zeros(3), forwards, gap)) == 5.0


def test_the_paths_are_found_once() -> None:
    evidence = balls_on_tiles()
    assert contact_paths(evidence) is contact_paths(evidence)
