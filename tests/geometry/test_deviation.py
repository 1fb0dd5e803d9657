"""Distances between surfaces, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from pipeline.geometry.deviation import deviation, distances
from pipeline.geometry.mesh import TriangleMesh
from tests.geometry.meshes import octahedron, torus


def test_distance_from_face_edge_and_vertex() -> None:
    points = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    expected = [2.0 / np.sqrt(3.0), 1.0 / np.sqrt(2.0), 2.0, 1.0 / np.sqrt(3.0)]
    assert np.allclose(distances(points, octahedron()), expected)


def test_points_on_the_surface_have_no_distance() -> None:
    mesh = torus(10.0, 3.0, 60, 40)
    inside_faces = mesh.points[mesh.triangles].mean(axis=1)
    assert distances(inside_faces, mesh).max() < 1e-9


def test_distances_are_those_of_a_search_through_all_triangles() -> None:
    """Against the least distance from many points spread over every triangle."""
    mesh, points = torus(10.0, 3.0, 24, 16), np.random.default_rng(2).normal(0.0, 8.0, (300, 3))
    u, v = np.meshgrid(np.linspace(0.0, 1.0, 41), np.linspace(0.0, 1.0, 41))
    u, v = u[u + v <= 1.0], v[u + v <= 1.0]
    a, b, c = (mesh.points[mesh.triangles[:, k]][:, None, :] for k in range(3))
    spread = (a + u[:, None] * (b - a) + v[:, None] * (c - a)).reshape(-1, 3)
    reference = KDTree(spread).query(points)[0]
    found = distances(points, mesh)
    assert (found <= reference + 1e-12).all()
    assert (reference - found).max() < 0.06


def test_a_torus_inside_another() -> None:
    found = deviation(torus(10.0, 2.5, 200, 100), torus(10.0, 3.0, 200, 100))
    assert found.rms_mm == pytest.approx(0.5, abs=0.01)
    assert found.max_mm == pytest.approx(0.5, abs=0.01)
    assert found.worn_mm == pytest.approx(0.5, abs=0.01)


def test_a_lost_part_shows_only_as_wear() -> None:
    whole = torus(10.0, 1.0, 100, 20)
    kept = whole.points[whole.triangles[:, 0], 0] < 8.0
    found = deviation(TriangleMesh(whole.points, whole.triangles[kept]), whole)
    assert found.rms_mm < 1e-6
    assert found.worn_mm > 2.0
