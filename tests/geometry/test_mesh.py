"""Measures and checks of triangle meshes, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.mesh import (
    EdgeDefects,
    TriangleMesh,
    area_mm2,
    check_closed,
    compacted,
    components,
    edge_defects,
    face_normals,
    flipped,
    genus,
    merged,
    pinched_vertices,
    transformed,
    vertex_normals,
    volume_mm3,
)
from tests.geometry.meshes import octahedron, torus, turned

FAR = turned((1.0, 2.0, 3.0), 0.7, (500.0, -900.0, 1200.0))
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


def test_measures_of_an_octahedron() -> None:
    mesh = octahedron(3.0)
    assert volume_mm3(mesh) == pytest.approx(36.0)
    assert area_mm2(mesh) == pytest.approx(36.0 * np.sqrt(3.0))
    assert np.allclose(vertex_normals(mesh), mesh.points / 3.0)
    assert np.allclose(face_normals(mesh), mesh.points[mesh.triangles].sum(axis=1) / 3.0 / np.sqrt(3.0))


def test_measures_of_a_torus_converge_to_pappus() -> None:
    mesh = torus(10.0, 3.0, 200, 100)
    assert volume_mm3(mesh) == pytest.approx(2.0 * np.pi**2 * 10.0 * 9.0, rel=2e-3)
    assert area_mm2(mesh) == pytest.approx(4.0 * np.pi**2 * 30.0, rel=1e-3)


def test_a_rigid_motion_changes_no_measure() -> None:
    mesh = torus(10.0, 3.0, 20, 12)
    moved = transformed(mesh, FAR)
    assert volume_mm3(moved) == pytest.approx(volume_mm3(mesh), rel=1e-12)
    assert area_mm2(moved) == pytest.approx(area_mm2(mesh), rel=1e-12)
    assert np.allclose(vertex_normals(moved), vertex_normals(mesh) @ FAR[:3, :3].T)


def test_a_mirrored_mesh_is_the_exact_mirror_image_and_outward() -> None:
    mesh = torus(10.0, 3.0, 20, 12)
    mirrored = transformed(mesh, MIRROR)
    assert np.array_equal(mirrored.points, mesh.points * [-1.0, 1.0, 1.0])
    check_closed(mirrored, "mirrored")
    assert volume_mm3(mirrored) == pytest.approx(volume_mm3(mesh))


def test_pieces_of_a_merged_mesh_are_the_meshes() -> None:
    small, large = octahedron(1.0), torus(10.0, 3.0, 8, 6)
    both = merged([small, large])
    check_closed(both, "both")
    pieces = components(both)
    assert [len(piece.triangles) for piece in pieces] == [8, 96]
    assert np.array_equal(pieces[1].points, large.points)
    assert np.array_equal(pieces[1].triangles, large.triangles)
    assert genus(small) == 0
    assert genus(both) == 1


def test_merging_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one mesh"):
        merged([])


def test_compacted_drops_only_unused_vertices() -> None:
    mesh = octahedron()
    padded = TriangleMesh(np.vstack([np.full((2, 3), 9.0), mesh.points]), mesh.triangles + np.int32(2))
    small = compacted(padded)
    assert np.array_equal(small.points, mesh.points)
    assert np.array_equal(small.triangles, mesh.triangles)


def _with_points(mesh: TriangleMesh, row: int, value: float) -> TriangleMesh:
    points = mesh.points.copy()
    points[row] = value
    return replace(mesh, points=points)


def _with_corner(mesh: TriangleMesh, value: int) -> TriangleMesh:
    triangles = mesh.triangles.copy()
    triangles[0, 0] = value
    return replace(mesh, triangles=triangles)


def _one_turned(mesh: TriangleMesh) -> TriangleMesh:
    triangles = mesh.triangles.copy()
    triangles[0] = triangles[0, [0, 2, 1]]
    return replace(mesh, triangles=triangles)


def _kissing(mesh: TriangleMesh) -> TriangleMesh:
    """Two octahedra that share one vertex."""
    both = merged([mesh, TriangleMesh(mesh.points + np.array([2.0, 0.0, 0.0]), mesh.triangles)])
    triangles = np.where(both.triangles == 7, 0, both.triangles)
    return TriangleMesh(both.points, triangles.astype(np.int32))


def _sharing_an_edge(mesh: TriangleMesh) -> TriangleMesh:
    both = merged([mesh, TriangleMesh(mesh.points + np.array([1.0, 1.0, 0.0]), mesh.triangles)])
    shared = {7: 2, 9: 0}
    triangles = np.vectorize(lambda vertex: shared.get(vertex, vertex))(both.triangles)
    return TriangleMesh(both.points, triangles.astype(np.int32))


@pytest.mark.parametrize(
    ("mesh", "defect"),
    [
        (TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)), "bone has no triangles"),
        (_with_points(octahedron(), 3, np.nan), "bone has 1 vertices that are not finite"),
        (_with_corner(octahedron(), 6), r"bone refers to vertices outside 0\.\.5"),
        (_with_corner(octahedron(), -1), r"bone refers to vertices outside 0\.\.5"),
        (_with_corner(octahedron(), 2), "bone has 1 degenerate triangles"),
        (TriangleMesh(octahedron().points, octahedron().triangles[1:]), "bone has 3 open edges"),
        (_sharing_an_edge(octahedron()), "bone has 1 edges shared by more than two"),
        (_one_turned(octahedron()), "bone has 3 edges whose triangles are oriented against"),
        (_kissing(octahedron()), "bone touches itself in 1 vertices"),
        (flipped(octahedron()), r"bone is inside out \(1 pieces"),
        (merged([octahedron(5.0), flipped(octahedron())]), r"bone is inside out \(1 pieces"),
    ],
)
def test_each_defect_is_named(mesh: TriangleMesh, defect: str) -> None:
    with pytest.raises(ValueError, match=defect):
        check_closed(mesh, "bone")


def test_a_closed_mesh_has_no_edge_defects_and_no_pinch() -> None:
    for mesh in (octahedron(), torus(10.0, 3.0, 9, 7)):
        found = edge_defects(mesh.triangles)
        assert (found.open, found.crowded, found.misoriented) == (0, 0, 0)
        assert pinched_vertices(mesh.triangles) == 0


def test_edges_and_fans_are_counted_on_any_order_of_the_triangles() -> None:
    """Two tori and an octahedron that share single vertices: three fans at one vertex, two at another."""
    parts = merged([torus(10.0, 3.0, 9, 7), torus(10.0, 3.0, 12, 8), octahedron()])
    second, third = 9 * 7, 9 * 7 + 12 * 8
    renamed = np.arange(len(parts.points), dtype=np.int32)
    renamed[[second, third]], renamed[second + 5] = 0, 11
    triangles = renamed[np.random.default_rng(3).permutation(parts.triangles)]
    assert edge_defects(triangles) == EdgeDefects(0, 0, 0)
    assert pinched_vertices(triangles) == 3
    assert edge_defects(triangles[1:]) == EdgeDefects(3, 0, 0)
    assert edge_defects(np.vstack([triangles, triangles[:1]])) == EdgeDefects(0, 3, 0)
