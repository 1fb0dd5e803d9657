"""Triangle meshes as arrays: construction, measures, and the one check every mesh passes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Int = NDArray[np.int32]
Index = NDArray[np.intp]

#: A triangle smaller than this has no usable normal: its height is near the rounding of single-precision filters.
DEGENERATE_MM2 = 1e-9


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A closed surface.

    Attributes
    ----------
    points : (N, 3) float64
        Vertices, millimetres, LPS unless a name says another frame.
    triangles : (M, 3) int32
        Vertex indices, counter-clockwise seen from outside (outward normals).
    """

    points: Float
    triangles: Int


@dataclass(frozen=True)
class EdgeDefects:
    """Edges that a closed, oriented surface does not have.

    Attributes
    ----------
    open : int
        Edges of one triangle only.
    crowded : int
        Edges of more than two triangles.
    misoriented : int
        Edges whose two triangles run along them in the same direction.
    """

    open: int
    crowded: int
    misoriented: int


def _area_vectors(mesh: TriangleMesh) -> Float:
    """(M, 3) normals whose length is the area of the triangle."""
    a, b, c = (mesh.points[mesh.triangles[:, corner]] for corner in range(3))
    return np.asarray(0.5 * np.cross(b - a, c - a), dtype=np.float64)


def _unit(vectors: Float) -> Float:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0.0, length, 1.0), dtype=np.float64)


def triangle_areas(mesh: TriangleMesh) -> Float:
    """(M,) area of each triangle, mm2."""
    return np.asarray(np.linalg.norm(_area_vectors(mesh), axis=1), dtype=np.float64)


def area_mm2(mesh: TriangleMesh) -> float:
    """Area of the surface."""
    return float(triangle_areas(mesh).sum())


def volume_mm3(mesh: TriangleMesh) -> float:
    """Signed volume inside a closed mesh (divergence theorem); positive where normals point outward."""
    centred = mesh.points - mesh.points.mean(axis=0)
    a, b, c = (centred[mesh.triangles[:, corner]] for corner in range(3))
    return float((a * np.cross(b, c)).sum() / 6.0)


def face_normals(mesh: TriangleMesh) -> Float:
    """(M, 3) outward unit normals; zero for a degenerate triangle."""
    return _unit(_area_vectors(mesh))


def vertex_normals(mesh: TriangleMesh) -> Float:
    """(N, 3) outward unit normals, means of the triangles around, weighted by area; zero where there is none."""
    corners = mesh.triangles.ravel()
    spread = np.repeat(_area_vectors(mesh), 3, axis=0)
    sums = [np.bincount(corners, spread[:, axis], len(mesh.points)) for axis in range(3)]
    return _unit(np.stack(sums, axis=1))


def transformed(mesh: TriangleMesh, new_from_old: Float) -> TriangleMesh:
    """The mesh under an affine (4, 4) map; a mirroring map flips the winding, so that normals stay outward.

    Written without a matrix product, whose rounding depends on the blocking of the library: a mirrored map gives
    exactly mirrored points.
    """
    linear, shift = new_from_old[:3, :3], new_from_old[:3, 3]
    x, y, z = (mesh.points[:, axis, None] for axis in range(3))
    points = x * linear[:, 0] + y * linear[:, 1] + z * linear[:, 2] + shift
    return TriangleMesh(points, mesh.triangles if np.linalg.det(linear) > 0.0 else flipped(mesh).triangles)


def flipped(mesh: TriangleMesh) -> TriangleMesh:
    """The same surface with its inside out."""
    return TriangleMesh(mesh.points, np.ascontiguousarray(mesh.triangles[:, [0, 2, 1]]))


def merged(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """All meshes as one, vertices kept apart.

    Raises
    ------
    ValueError
        For an empty sequence.
    """
    if not meshes:
        raise ValueError("expected at least one mesh to merge, got none")
    starts = np.cumsum([0, *(len(mesh.points) for mesh in meshes[:-1])])
    triangles = [mesh.triangles + np.int32(start) for mesh, start in zip(meshes, starts, strict=True)]
    return TriangleMesh(np.concatenate([mesh.points for mesh in meshes]), np.concatenate(triangles))


def compacted(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh without vertices that no triangle uses; order is kept."""
    used, index = np.unique(mesh.triangles, return_inverse=True)
    return TriangleMesh(mesh.points[used], index.reshape(-1, 3).astype(np.int32))


def _directed_edges(triangles: Int) -> Index:
    """(3 M, 2) edges as each triangle runs along them; row ``k`` starts at corner ``k`` of ``triangles.ravel()``."""
    return np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2).astype(np.intp)


def _by_edge(directed: Index) -> tuple[Index, Index]:
    """Corners in an order that puts those of one undirected edge side by side, and where in it each edge starts."""
    lower, upper = np.minimum(*directed.T), np.maximum(*directed.T)
    keys = lower * (upper.max(initial=0) + 1) + upper
    order = np.argsort(keys)
    return order, np.flatnonzero(np.diff(keys[order], prepend=-1))


def edge_defects(triangles: Int) -> EdgeDefects:
    """Count the edges that keep triangles (M, 3) from being a closed, consistently oriented surface."""
    directed = _directed_edges(triangles)
    order, starts = _by_edge(directed)
    count = np.diff(starts, append=len(order))
    forward = np.add.reduceat((directed[order, 0] <= directed[order, 1]).astype(np.intp), starts)
    pairs = count == 2
    return EdgeDefects(int((count == 1).sum()), int((count > 2).sum()), int((forward[pairs] != 1).sum()))


def _piece_of_vertex(triangles: Int, vertices: int) -> Index:
    """(vertices,) number of the connected piece that each vertex belongs to, in the order of their first vertex."""
    # slow to import, and runs of cached stages never need them
    from scipy.sparse import coo_array  # noqa: PLC0415
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    # two of its edges join the corners of a triangle
    edges = (triangles[:, :2].ravel(), triangles[:, 1:].ravel())
    graph = coo_array((np.ones(len(edges[0]), dtype=np.int8), edges), shape=(vertices, vertices))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.intp)


def components(mesh: TriangleMesh) -> tuple[TriangleMesh, ...]:
    """Pieces of the mesh that share no vertex, in the order of their first vertex."""
    piece = _piece_of_vertex(mesh.triangles, len(mesh.points))[mesh.triangles[:, 0]]
    if len(piece) == 0 or (piece == piece[0]).all():
        return (mesh,) if len(piece) else ()
    return tuple(compacted(TriangleMesh(mesh.points, mesh.triangles[piece == name])) for name in np.unique(piece))


def pinched_vertices(triangles: Int) -> int:
    """Number of vertices where a closed, oriented surface touches itself in a point (more than one fan of triangles).

    From each corner one turns about its vertex to the next triangle; every fan of triangles is one cycle of such turns.
    The lowest corner of a cycle is found by steps of 1, 2, 4, ... turns.
    """
    directed = _directed_edges(triangles)
    corner = np.arange(len(directed))
    following = np.roll(corner.reshape(-1, 3), -1, axis=1).ravel()
    here, there = _by_edge(directed)[0].reshape(-1, 2).T
    turn = np.empty_like(corner)
    turn[here], turn[there] = following[there], following[here]
    corners_of = np.bincount(triangles.ravel())
    lowest = corner
    for _ in range(int(corners_of.max()).bit_length()):
        lowest = np.minimum(lowest, lowest[turn])
        turn = turn[turn]
    return int(np.count_nonzero(lowest == corner) - np.count_nonzero(corners_of))


def genus(mesh: TriangleMesh) -> int:
    """Number of handles of a closed mesh, all pieces together (Euler's formula; each edge belongs to two triangles)."""
    vertices = int(np.count_nonzero(np.bincount(mesh.triangles.ravel())))
    return len(components(mesh)) - (vertices - len(mesh.triangles) // 2) // 2


def _array_defect(mesh: TriangleMesh) -> str | None:
    if len(mesh.triangles) == 0:
        return "has no triangles"
    if not np.isfinite(mesh.points).all():
        return f"has {int((~np.isfinite(mesh.points)).any(axis=1).sum())} vertices that are not finite numbers"
    if mesh.triangles.min() < 0 or mesh.triangles.max() >= len(mesh.points):
        return f"refers to vertices outside 0..{len(mesh.points) - 1}"
    small = int((triangle_areas(mesh) <= DEGENERATE_MM2).sum())
    return f"has {small} degenerate triangles" if small else None


def _surface_defect(mesh: TriangleMesh) -> str | None:
    edges = edge_defects(mesh.triangles)
    for count, what in (
        (edges.open, "open edges"),
        (edges.crowded, "edges shared by more than two triangles"),
        (edges.misoriented, "edges whose triangles are oriented against each other"),
    ):
        if count:
            return f"has {count} {what}"
    pinched = pinched_vertices(mesh.triangles)
    if pinched:
        return f"touches itself in {pinched} vertices"
    inverted = sum(volume_mm3(piece) <= 0.0 for piece in components(mesh))
    return f"is inside out ({inverted} pieces with inward normals)" if inverted else None


def check_arrays(mesh: TriangleMesh, name: str) -> None:
    """Refuse a mesh that compiled filters would crash on.

    Raises
    ------
    ValueError
        For no triangles, NaN or infinity, an index out of range, a degenerate triangle.
    """
    defect = _array_defect(mesh)
    if defect:
        raise ValueError(f"{name} {defect}")


def check_closed(mesh: TriangleMesh, name: str) -> None:
    """Refuse a mesh that is not the oriented border of a solid; pieces are allowed, each of positive volume.

    Raises
    ------
    ValueError
        Naming ``name`` and the first defect found: those of :func:`check_arrays`, open edges, edges of more than two
        triangles, inconsistent orientation, a vertex where the surface touches itself, a piece that is inside out.
    """
    check_arrays(mesh, name)
    defect = _surface_defect(mesh)
    if defect:
        raise ValueError(f"{name} {defect}")
