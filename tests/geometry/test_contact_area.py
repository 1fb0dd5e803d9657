"""The middle of contact against closed forms: a ball on a plane, two balls on a plane, and how triangles are cut."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.contact_area import FACET_MM, FacetPlanes, Facets, facets, middle_of_contact
from pipeline.geometry.mesh import TriangleMesh, area_mm2, merged
from tests.geometry.knees import sphere

RADIUS_MM, GAP_MM, BAND_MM = 20.0, 0.05, 0.2
#: Two triangles, 60 mm wide: far coarser than what touches.
PLANE = TriangleMesh(
    np.array([[-30.0, -30.0, 0.0], [30.0, -30.0, 0.0], [30.0, 30.0, 0.0], [-30.0, 30.0, 0.0]]),
    np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32),
)


def upper(surface: Facets) -> Facets:
    return surface.chosen(surface.normals[:, 2] > 0.0)


def on_a_ball(*balls: TriangleMesh) -> tuple[Facets, np.ndarray]:
    patch = upper(facets(PLANE))
    return patch, FacetPlanes(facets(merged(list(balls)))).distances(patch.middles, 5.0)


def ball_over(x: float, y: float, gap_mm: float = GAP_MM) -> TriangleMesh:
    return sphere(RADIUS_MM, (x, y, RADIUS_MM + gap_mm), fine=5)


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (7.3, -4.1)])
def test_a_ball_touches_a_plane_below_its_middle(x: float, y: float) -> None:
    middle = middle_of_contact(*on_a_ball(ball_over(x, y)), BAND_MM)
    assert middle is not None
    assert middle.gap_mm == pytest.approx(GAP_MM, abs=0.03)
    np.testing.assert_allclose(middle.place, [x, y, 0.0], rtol=0, atol=0.35)
    # a cap of the height of the band, seen from above
    assert middle.area_mm2 == pytest.approx(np.pi * 2.0 * RADIUS_MM * BAND_MM, rel=0.25)


def test_a_plane_touches_a_ball_where_the_ball_is_the_patch() -> None:
    patch = facets(ball_over(3.0, 2.0))
    patch = patch.chosen(patch.normals[:, 2] < 0.0)
    middle = middle_of_contact(patch, FacetPlanes(facets(PLANE)).distances(patch.middles, 5.0), BAND_MM)
    assert middle is not None
    assert middle.gap_mm == pytest.approx(GAP_MM, abs=0.02)
    np.testing.assert_allclose(middle.place[:2], [3.0, 2.0], rtol=0, atol=0.1)
    assert middle.area_mm2 == pytest.approx(2.0 * np.pi * RADIUS_MM * BAND_MM, rel=0.1)


def test_equal_spots_have_their_middle_between_and_a_farther_one_does_not_count() -> None:
    even = middle_of_contact(*on_a_ball(ball_over(-15.0, 0.0), ball_over(15.0, 10.0)), BAND_MM)
    lower = middle_of_contact(*on_a_ball(ball_over(-15.0, 0.0), ball_over(15.0, 10.0, 2.0 * BAND_MM)), BAND_MM)
    assert even is not None
    assert lower is not None
    np.testing.assert_allclose(even.place[:2], [0.0, 5.0], rtol=0, atol=1.0)
    np.testing.assert_allclose(lower.place[:2], [-15.0, 0.0], rtol=0, atol=0.35)


def test_overlap_is_negative_and_what_is_far_is_not_known() -> None:
    patch, distances = on_a_ball(ball_over(0.0, 0.0, -0.5))
    assert distances.min() == pytest.approx(-0.5, abs=0.03)
    assert np.isinf(distances[np.hypot(*patch.middles[:, :2].T) > 25.0]).all()
    assert middle_of_contact(*on_a_ball(ball_over(0.0, 0.0, 6.0)), BAND_MM) is None
    nothing = patch.chosen(np.zeros(len(patch.areas), dtype=np.bool_))
    assert middle_of_contact(nothing, np.empty(0), BAND_MM) is None


@pytest.mark.parametrize("mesh", [PLANE, sphere(3.0, fine=1), sphere(3.0, fine=4)])
def test_facets_are_small_and_keep_area_and_moments(mesh: TriangleMesh) -> None:
    found = facets(mesh)
    corners = mesh.points[mesh.triangles]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2.0
    assert found.areas.sum() == pytest.approx(area_mm2(mesh), rel=1e-12)
    np.testing.assert_allclose(found.areas @ found.middles, areas @ corners.mean(axis=1), rtol=0, atol=1e-8)
    assert found.areas.max() <= FACET_MM**2 / 2.0
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0, rtol=0, atol=1e-12)
