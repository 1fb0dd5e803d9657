"""Inside or outside: what a test of crossing surfaces cannot see, a body that lies wholly within another."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mesh import TriangleMesh

Float = NDArray[np.float64]

#: Point-triangle pairs held in memory at a time.
BLOCK = 500_000


def winding_number(points: Float, mesh: TriangleMesh) -> Float:
    """How often a closed surface winds about each point: 1 inside, 0 outside, -1 inside a surface turned inside out.

    The sum of the solid angles of all triangles over 4 pi (van Oosterom & Strackee, IEEE Trans. Biomed. Eng. 30,
    1983). Robust: gaps in the surface change it in proportion to the solid angle that they fill.

    Parameters
    ----------
    points : (N, 3) float64
        In the mesh's frame, mm; meaningless for points on the surface itself.
    mesh : TriangleMesh

    Returns
    -------
    (N,) float64
    """
    corners = mesh.points[mesh.triangles]
    size = max(1, BLOCK // max(1, len(corners)))
    blocks = [_solid_angles(points[start : start + size], corners) for start in range(0, len(points), size)]
    return np.concatenate([np.empty(0), *blocks]) / (4.0 * np.pi)


def contains(mesh: TriangleMesh, points: Float) -> NDArray[np.bool_]:
    """(N,) whether points (N, 3) lie inside a closed mesh."""
    return np.asarray(winding_number(points, mesh) > 0.5)


def nested(
    first: TriangleMesh, second: TriangleMesh, rotation: Float | None = None, shift: Float | None = None
) -> bool:
    """Whether one of two bodies holds a piece of the other, given that their surfaces do not cross.

    One vertex of each connected piece decides: without crossings a piece is inside as a whole or not at all.

    Parameters
    ----------
    first, second : TriangleMesh
        Closed.
    rotation, shift : (3, 3) and (3,) float64, optional
        Placement of the second in the first's frame, mm; as it is when not given.
    """
    turn, way = np.eye(3) if rotation is None else rotation, np.zeros(3) if shift is None else shift
    placed, taken_back = piece_points(second) @ turn.T + way, (piece_points(first) - way) @ turn
    return bool(contains(first, placed).any() or contains(second, taken_back).any())


def _solid_angles(points: Float, corners: Float) -> Float:
    """(N,) sum of the signed solid angles of triangles (M, 3, 3) seen from points (N, 3)."""
    a, b, c = (corners[None, :, k] - points[:, None] for k in range(3))
    la, lb, lc = (np.sqrt(_dot(side, side)) for side in (a, b, c))
    volume = _dot(a, np.cross(b, c))
    spread = la * lb * lc + _dot(a, b) * lc + _dot(b, c) * la + _dot(c, a) * lb
    return np.asarray(2.0 * np.arctan2(volume, spread).sum(axis=1))


def _dot(a: Float, b: Float) -> Float:
    return np.asarray(np.einsum("...i,...i->...", a, b))


@lru_cache(maxsize=8)
def piece_points(mesh: TriangleMesh) -> Float:
    """(P, 3) one vertex of each connected piece of a mesh; vertices of no triangle do not count."""
    from scipy.sparse import coo_array  # noqa: PLC0415 - not loaded by a cached run
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    start, end = mesh.triangles[:, [0, 1, 2]].ravel(), mesh.triangles[:, [1, 2, 0]].ravel()
    links = coo_array((np.ones(len(start)), (start, end)), shape=(len(mesh.points),) * 2)
    piece = connected_components(links, directed=False)[1]
    used = np.unique(mesh.triangles)
    return mesh.points[used[np.unique(piece[used], return_index=True)[1]]]
