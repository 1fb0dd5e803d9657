"""Cross-sections and volume centroids against closed forms, SciPy's hulls and trimesh."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from pipeline.geometry.cross_sections import cross_sections, volume_centroid
from pipeline.geometry.mesh import Float, TriangleMesh, merged, transformed
from pipeline.geometry.validation_objects import revolved
from tests.geometry.knees import about
from tests.geometry.meshes import torus
from tests.kinematics.shapes import convex, shifted

Z = np.array([0.0, 0.0, 1.0])
SECTORS = 24
#: Area of a regular polygon of that many corners on the unit circle.
POLYGON = SECTORS / 2.0 * np.sin(2.0 * np.pi / SECTORS)


def cylinder(radius_mm: float, length_mm: float) -> TriangleMesh:
    return revolved(np.array([[0, 0], [radius_mm, 0], [radius_mm, length_mm], [0, length_mm]], dtype=float), SECTORS)


def test_sections_of_a_cone_shrink_with_the_square_of_the_way_to_its_tip() -> None:
    cone = revolved(np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 40.0]]), SECTORS)
    heights = np.array([0.5, 10.0, 20.0, 39.0])
    cuts = cross_sections(cone, Z, heights)
    np.testing.assert_array_equal(cuts.heights, heights)
    np.testing.assert_allclose(cuts.areas, POLYGON * (10.0 * (1.0 - heights / 40.0)) ** 2, rtol=1e-12)
    np.testing.assert_allclose(cuts.centroids, np.outer(heights, Z), rtol=0, atol=1e-12)


def test_sections_of_an_oblique_cylinder_are_alike_with_centroids_on_its_axis() -> None:
    shear = np.eye(4)
    shear[:2, 2] = 0.3, -0.2
    heights = np.linspace(1.0, 49.0, 9)
    cuts = cross_sections(transformed(cylinder(12.0, 50.0), shear), Z, heights)
    np.testing.assert_allclose(cuts.areas, POLYGON * 144.0, rtol=1e-12)
    np.testing.assert_allclose(cuts.centroids, np.outer(heights, [0.3, -0.2, 1.0]), rtol=0, atol=1e-11)


def test_a_plane_oblique_to_a_cylinder_cuts_an_ellipse_of_area_over_the_cosine() -> None:
    axis = about(0.0, 25.0, 0.0) @ Z
    cuts = cross_sections(cylinder(12.0, 50.0), axis, np.array([25.0 * axis[2]]))
    assert cuts.areas[0] == pytest.approx(POLYGON * 144.0 / np.cos(np.radians(25.0)), rel=1e-12)
    np.testing.assert_allclose(cuts.centroids[0], [0.0, 0.0, 25.0], rtol=0, atol=1e-12)


def test_both_parts_of_a_torus_cut_lengthwise_count() -> None:
    cuts = cross_sections(torus(20.0, 5.0, 64, SECTORS), np.array([1.0, 0.0, 0.0]), np.array([0.0]))
    # the plane through the axis runs midway between two rings of vertices there: facets of chords, cos(pi / 64)
    assert cuts.areas[0] == pytest.approx(2.0 * POLYGON * 25.0, rel=2e-3)
    np.testing.assert_allclose(cuts.centroids[0], 0.0, atol=1e-10)


def test_the_hole_of_a_torus_is_taken_away() -> None:
    around = 64
    cuts = cross_sections(torus(20.0, 5.0, around, SECTORS), Z, np.array([1e-9]))
    ring = around / 2.0 * np.sin(2.0 * np.pi / around) * (25.0**2 - 15.0**2)
    assert cuts.areas[0] == pytest.approx(ring, rel=1e-8)
    np.testing.assert_allclose(cuts.centroids[0], 0.0, atol=1e-8)


def test_two_bodies_have_the_centroid_of_both_weighted_by_area() -> None:
    pair = merged([cylinder(10.0, 20.0), shifted(cylinder(5.0, 20.0), x=40.0)])
    cuts = cross_sections(pair, Z, np.array([10.0]))
    assert cuts.areas[0] == pytest.approx(POLYGON * 125.0)
    np.testing.assert_allclose(cuts.centroids[0], [40.0 * 25.0 / 125.0, 0.0, 10.0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_sections_of_a_random_polyhedron_are_the_hulls_of_its_cut_edges(seed: int) -> None:
    random = np.random.default_rng(seed)
    body = convex(random.normal(size=(40, 3)) * [10.0, 20.0, 15.0] + [100.0, -50.0, 30.0])
    axis = about(*random.uniform(-180.0, 180.0, 3)) @ Z
    inside = body.points.mean(axis=0) @ axis
    heights = inside + np.array([-4.0, 0.0, 4.0])
    cuts = cross_sections(body, axis, heights)
    for height, area, centroid in zip(heights, cuts.areas, cuts.centroids, strict=True):
        corners, expected = _hull_section(body, axis, float(height))
        assert area == pytest.approx(expected, rel=1e-9)
        assert centroid @ axis == pytest.approx(height)
        assert np.all(corners.min(axis=0) < centroid)
        assert np.all(centroid < corners.max(axis=0))


def _hull_section(body: TriangleMesh, axis: Float, height: float) -> tuple[Float, float]:
    """Points (N, 3) in which the edges meet the plane, and the area of their convex hull in it."""
    edges = np.concatenate([body.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    start, end = body.points[edges[:, 0]], body.points[edges[:, 1]]
    share = (height - start @ axis) / ((end - start) @ axis)
    crossing = (share > 0) & (share < 1)
    points = (start + share[:, None] * (end - start))[crossing]
    plane = np.linalg.svd(axis[None])[2][1:]
    return points, float(ConvexHull(points @ plane.T).volume)


def test_planes_that_miss_are_left_out() -> None:
    cuts = cross_sections(cylinder(12.0, 50.0), Z, np.array([-1.0, 25.0, 51.0]))
    np.testing.assert_array_equal(cuts.heights, [25.0])
    nothing = cross_sections(cylinder(12.0, 50.0), Z, np.array([-1.0, 51.0]))
    assert [part.shape for part in nothing] == [(0,), (0,), (0, 3)]


def test_a_plane_through_vertices_counts_once() -> None:
    body = revolved(np.array([[0, 0], [10, 0], [12, 25], [10, 50], [0, 50]], dtype=float), SECTORS)
    cuts = cross_sections(body, Z, np.array([25.0]))
    assert cuts.areas[0] == pytest.approx(POLYGON * 144.0)


@pytest.mark.parametrize("seed", range(3))
def test_the_volume_centroid_is_that_of_trimesh(seed: int) -> None:
    random = np.random.default_rng(seed)
    body = convex(random.normal(size=(30, 3)) * 20.0 + random.uniform(-500.0, 500.0, 3))
    reference = trimesh.Trimesh(body.points, body.triangles, process=False).center_mass
    np.testing.assert_allclose(volume_centroid(body), reference, rtol=0, atol=1e-8)


def test_the_volume_centroid_of_a_cone_lies_at_a_quarter_of_its_height() -> None:
    cone = revolved(np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 40.0]]), SECTORS)
    np.testing.assert_allclose(volume_centroid(cone), [0.0, 0.0, 10.0], rtol=0, atol=1e-12)
