"""Quadric edge collapse that cannot open, pinch or fold a closed mesh: many collapses at once, in numpy.

Costs are the quadrics of Garland & Heckbert, "Surface simplification using quadric error metrics" (1997). An edge is
collapsed only where the link condition of Dey et al., "Topology preserving edge contraction" (1999) holds, so the
result has the topology of the input. The collapses of one pass lie so far apart that none sees another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mesh import Float, Index, TriangleMesh, compacted

Bool = NDArray[np.bool_]

#: Share of the edges, cheapest first, that one pass may collapse; smaller is nearer to the greedy order, and slower.
CANDIDATES = 0.4
#: A triangle may turn by at most acos(0.2) = 78 deg in one collapse, else the surface could fold over.
LEAST_COSINE = 0.2
#: Twice the area over the sum of squared sides: below this a triangle is a needle and its normal is noise.
LEAST_SHAPE = 1e-3
#: Weight of squared edge length against squared distance to the planes: spreads triangles evenly over flats.
LENGTH_WEIGHT = 1e-4
#: Share of a quadric's trace that ties the new vertex to the middle of its edge where the planes leave it free.
MIDDLE_WEIGHT = 1e-3


@dataclass(eq=False)
class _State:
    """A mesh while it is decimated; vertex numbers never change, so that refused edges can be remembered."""

    points: Float
    triangles: Index
    quadrics: Float


@dataclass(frozen=True, eq=False)
class _Choice:
    """Edges of one pass, far apart: end points ``keep`` and ``drop``, new places (K, 3)."""

    keep: Index
    drop: Index
    places: Float

    def where(self, mask: Bool | slice) -> _Choice:
        return _Choice(self.keep[mask], self.drop[mask], self.places[mask])


def decimate(mesh: TriangleMesh, triangles: int) -> TriangleMesh:
    """Fewer triangles, the same topology.

    Parameters
    ----------
    mesh : TriangleMesh
        Passes :func:`pipeline.geometry.mesh.check_closed`.
    triangles : int
        Wanted number; reached unless topology or folding forbids every further collapse.

    Returns
    -------
    TriangleMesh
        Closed, of the same genus and number of pieces; the same bits for the same input.
    """
    state = _State(mesh.points.copy(), mesh.triangles.astype(np.intp), _vertex_quadrics(mesh))
    refused, since_retry = np.empty(0, dtype=np.intp), 0
    while (excess := len(state.triangles) - triangles) > 0:
        done, newly_refused = _collapse_pass(state, refused, (excess + 1) // 2)
        refused, since_retry = np.union1d(refused, newly_refused), since_retry + done
        if done == 0 and len(newly_refused) == 0:
            if since_retry == 0:
                break
            # what was refused long ago may be allowed among the neighbours of today
            refused, since_retry = refused[:0], 0
    return compacted(TriangleMesh(state.points, state.triangles.astype(np.int32)))


def _vertex_quadrics(mesh: TriangleMesh) -> Float:
    """(N, 16) sums over the triangles around each vertex of area x plane x plane, as flat 4x4."""
    a, b, c = (mesh.points[mesh.triangles[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    double_area = np.linalg.norm(normal, axis=1)
    normal = normal / double_area[:, None]
    plane = np.column_stack([normal, -(normal * a).sum(axis=1)])
    quadric = (0.5 * double_area[:, None, None] * plane[:, :, None] * plane[:, None, :]).reshape(-1, 16)
    corners, repeated = mesh.triangles.ravel(), np.repeat(quadric, 3, axis=0)
    return np.stack([np.bincount(corners, repeated[:, k], len(mesh.points)) for k in range(16)], axis=1)


def _collapse_pass(state: _State, refused: Index, most: int) -> tuple[int, Index]:
    """Collapse up to ``most`` edges in place; return how many, and the keys of edges that must not be collapsed."""
    edges = _edges(state.triangles)
    keys = edges[:, 0] * len(state.points) + edges[:, 1]
    cost = _costs(state, edges)
    cost[np.isin(keys, refused)] = np.inf
    chosen = _independent(edges, cost, len(state.points))
    choice = _placed(state, edges[chosen])
    allowed = _link_condition(edges, choice, len(state.points)) & ~_folds(state, choice)
    _apply(state, choice.where(allowed).where(slice(most)))
    return min(int(allowed.sum()), most), keys[chosen][~allowed]


def _edges(triangles: Index) -> Index:
    """(E, 2) edges, lower vertex first: in a closed oriented mesh each is run along upward exactly once."""
    directed = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    return directed[directed[:, 0] < directed[:, 1]]


def _costs(state: _State, edges: Index) -> Float:
    """(E,) quadric error of the middle of each edge, and a little for its length."""
    a, b = state.points[edges[:, 0]], state.points[edges[:, 1]]
    quadric = (state.quadrics[edges[:, 0]] + state.quadrics[edges[:, 1]]).reshape(-1, 4, 4)
    place = np.column_stack([(a + b) / 2.0, np.ones(len(edges))])
    weight = quadric[:, 0, 0] + quadric[:, 1, 1] + quadric[:, 2, 2]
    error: Float = np.einsum("ei,eij,ej->e", place, quadric, place)
    return np.asarray(error + LENGTH_WEIGHT * weight * ((a - b) ** 2).sum(axis=1))


def _independent(edges: Index, cost: Float, vertices: int) -> Index:
    """Numbers of the edges cheaper than every edge at their ends' neighbours, cheapest first: no two share a ring."""
    order = np.argsort(cost, kind="stable")[: max(1, int(CANDIDATES * len(edges)))]
    order = order[np.isfinite(cost[order])]
    rank = np.full(len(edges), len(edges), dtype=np.intp)
    rank[order] = np.arange(len(order))
    first, second = edges.T
    at_vertex = np.full(vertices, len(edges), dtype=np.intp)
    np.minimum.at(at_vertex, first, rank)
    np.minimum.at(at_vertex, second, rank)
    near_vertex = at_vertex.copy()
    np.minimum.at(near_vertex, first, at_vertex[second])
    np.minimum.at(near_vertex, second, at_vertex[first])
    cheapest = np.minimum(near_vertex[first[order]], near_vertex[second[order]])
    return np.asarray(order[rank[order] == cheapest])


def _placed(state: _State, edges: Index) -> _Choice:
    """Put each new vertex where its planes want it, but no further from the middle than the edge is long."""
    a, b = state.points[edges[:, 0]], state.points[edges[:, 1]]
    quadric = (state.quadrics[edges[:, 0]] + state.quadrics[edges[:, 1]]).reshape(-1, 4, 4)
    matrix, middle = quadric[:, :3, :3], (a + b) / 2.0
    tie = MIDDLE_WEIGHT * np.trace(matrix, axis1=1, axis2=2)[:, None]
    place = np.linalg.solve(matrix + tie[:, :, None] * np.eye(3), (tie * middle - quadric[:, :3, 3])[:, :, None])[
        :, :, 0
    ]
    far = np.linalg.norm(place - middle, axis=1) > np.linalg.norm(a - b, axis=1)
    return _Choice(edges[:, 0], edges[:, 1], np.where(far[:, None], middle, place))


def _link_condition(edges: Index, choice: _Choice, vertices: int) -> Bool:
    """(K,) whether the two ends share exactly two neighbours and do not belong to a tetrahedron."""
    from scipy.sparse import csr_array  # noqa: PLC0415 - slow to import, and runs of cached stages never need it

    ends = (np.r_[edges[:, 0], edges[:, 1]], np.r_[edges[:, 1], edges[:, 0]])
    adjacent = csr_array((np.ones(len(ends[0]), dtype=np.int32), ends), shape=(vertices, vertices))
    shared = np.asarray(adjacent[choice.keep].multiply(adjacent[choice.drop]).sum(axis=1)).ravel()
    valence = np.diff(adjacent.indptr)
    return np.asarray((shared == 2) & (valence[choice.keep] + valence[choice.drop] >= 7))


def _folds(state: _State, choice: _Choice) -> Bool:
    """(K,) whether the collapse would turn a triangle over or squeeze it to a needle."""
    owner = np.full(len(state.points), -1, dtype=np.intp)
    owner[choice.keep] = owner[choice.drop] = np.arange(len(choice.keep))
    owners = owner[state.triangles]
    touched = np.flatnonzero((owners >= 0).sum(axis=1) == 1)
    collapse = owners[touched].max(axis=1)
    before = state.points[state.triangles[touched]]
    after = np.where((owners[touched] >= 0)[:, :, None], choice.places[collapse][:, None, :], before)
    bad = np.zeros(len(choice.keep), dtype=np.bool_)
    bad[collapse[_turned_or_needle(before, after)]] = True
    return bad


def _turned_or_needle(before: Float, after: Float) -> Bool:
    """(T,) for corners (T, 3, 3) of the same triangles before and after."""
    old, new = (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) for corners in (before, after))
    old_length, new_length = np.linalg.norm(old, axis=1), np.linalg.norm(new, axis=1)
    sides = ((after - np.roll(after, 1, axis=1)) ** 2).sum(axis=(1, 2))
    turned = (old * new).sum(axis=1) < LEAST_COSINE * old_length * new_length
    return np.asarray(turned | (new_length < LEAST_SHAPE * sides))


def _apply(state: _State, choice: _Choice) -> None:
    """Collapse the chosen edges in place."""
    state.quadrics[choice.keep] += state.quadrics[choice.drop]
    state.points[choice.keep] = choice.places
    renamed = np.arange(len(state.points))
    renamed[choice.drop] = choice.keep
    triangles = renamed[state.triangles]
    a, b, c = triangles.T
    state.triangles = triangles[(a != b) & (b != c) & (c != a)]
