"""Exact clearance along delta between two triangle surfaces, feature by feature (compiled).

Seen along delta, the least clearance of two overlapping triangles lies at a corner of one above the face of the other,
or where two edges cross. Each such feature gives a height that is linear in x and y and smooth in theta; the depth at a
pose is the least of all features that are *there* (corner within the face, crossing within both edges).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.kinematics.compilation import compiled
from pipeline.kinematics.direct.surfaces import FAR_MM, NOTHING_MM, SHARED, Attitude, Bins, Float, Int, Rows, Surface

#: Kinds of features: a corner of the moving body under a face, a corner of the reference above a face, two edges.
CORNER_BELOW, CORNER_ABOVE, CROSSING = 0, 1, 2
#: Edges whose cross product seen along z is below this (mm^2) do not cross.
PARALLEL = 1e-12

Bytes = NDArray[np.uint8]
Flags = NDArray[np.bool_]
#: No triangle has claimed its corners and edges yet.
UNCLAIMED = 255

Cell = tuple[int, int]
#: A reference triangle, and a cell.
At = tuple[int, int]
#: Box and plane of a reference triangle, the last to meet each triangle of the moving body, and the reach.
Span = tuple[Float, Int, Float]
#: x, y and the cosine and sine of theta of a pose.
Place = tuple[float, float, float, float]

#: Clearance, its slopes in x and y, and the place (x, y) from the moving origin.
Feature = tuple[float, float, float, float, float]


@compiled
def _may_meet(facing: Float, item: int, own: Float, sideways: float, highest: float) -> bool:
    """Whether two triangles, each as box and plane, may come as near as a depth.

    Bounded from below by the clearance of the two planes over what the boxes share.
    """
    x0, x1 = max(own[0] - sideways, facing[item, 0]), min(own[3] + sideways, facing[item, 3])
    y0, y1 = max(own[1] - sideways, facing[item, 1]), min(own[4] + sideways, facing[item, 4])
    # one comparison for three reasons: a processor guesses it right
    if max(x0 - x1, y0 - y1, own[2] - facing[item, 5] - highest) > 0.0:
        return False
    gx, gy = own[7] - facing[item, 7], own[8] - facing[item, 8]
    middle = own[6] - facing[item, 6] + 0.5 * (gx * (x0 + x1) + gy * (y0 + y1))
    tilt = 0.5 * (abs(gx) * (x1 - x0) + abs(gy) * (y1 - y0))
    return bool(middle - tilt - sideways * (abs(own[7]) + abs(own[8])) <= highest)


@compiled
def layout_of(bins: Bins) -> Float:
    """Where the cells lie: x0, y0, cells per mm, columns, rows."""
    return np.array([bins.x0, bins.y0, 1.0 / bins.size, bins.cover.shape[1], bins.cover.shape[0]])


@compiled
def box_and_cells(corner: Float, layout: Float, sideways: float, own: Float, cells: Int) -> None:
    """Write least and greatest x, y, z of three corners; first and last column, first and last row of their cells."""
    for j in range(3):
        own[j] = min(corner[0, j], corner[1, j], corner[2, j])
        own[j + 3] = max(corner[0, j], corner[1, j], corner[2, j])
    for axis in range(2):
        first, last = own[axis] - sideways - layout[axis], own[axis + 3] + sideways - layout[axis]
        cells[2 * axis] = max(int(np.floor(first * layout[2])), 0)
        cells[2 * axis + 1] = min(int(np.floor(last * layout[2])), int(layout[axis + 3]) - 1)


@compiled
def any_active(active: Flags, layout: Float, cells: Int) -> bool:
    """Whether one of a range of cells is active."""
    columns = int(layout[3])
    for j in range(cells[2], cells[3] + 1):
        for i in range(cells[0], cells[1] + 1):
            if active[j * columns + i]:
                return True
    return False


@compiled
def _plane(corner: Float, own: Float) -> bool:
    """Write height at (0, 0) and slopes of the plane of three corners; whether it faces against z."""
    ux, uy, uz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    vx, vy, vz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    det = ux * vy - vx * uy
    if det >= 0.0:
        return False
    own[7], own[8] = (uz * vy - vz * uy) / det, (ux * vz - vx * uz) / det
    own[6] = corner[0, 2] - own[7] * corner[0, 0] - own[8] * corner[0, 1]
    return True


@compiled
def _above_cell(cover: Float, layout: Float, cell: Cell, own: Float, sideways: float) -> float:
    """Bound from below of the clearance of a triangle, as box and plane, above a cell of the moving body."""
    i, j = cell
    size = 1.0 / layout[2]
    gx, gy = own[7] - cover[j, i, 1], own[8] - cover[j, i, 2]
    x0, y0 = layout[0] + i * size, layout[1] + j * size
    x1, y1 = min(x0 + size, own[3] + sideways), min(y0 + size, own[4] + sideways)
    x0, y0 = max(x0, own[0] - sideways), max(y0, own[1] - sideways)
    planes = own[6] - cover[j, i, 0] + min(gx * x0, gx * x1) + min(gy * y0, gy * y1)
    least: float = max(planes - sideways * (abs(own[7]) + abs(own[8])), own[2] - cover[j, i, 3])
    return least


@compiled
def near_pairs(reference: Surface, bins: Bins, pose: Float, reach: Float, active: Flags) -> Int:
    """Pairs of triangles that may meet within a reach of a pose.

    Parameters
    ----------
    reference : Surface
        Attitude frame.
    bins : Bins
        Of the moving body.
    pose : (3,) float64
        x, y (mm), theta (rad).
    reach : (2,) float64
        Sideways motion allowed for (mm), and the depth z (mm) above which clearances do not matter.
    active : (NY * NX,) bool
        Cells that are looked at.

    Returns
    -------
    (K, 2) int32
        Reference and moving triangle. Every feature with a clearance below ``reach[1]``, at any pose within the
        sideways reach and in an active cell, belongs to one of them.
    """
    points, triangles, cover = reference.points, reference.triangles, bins.cover
    sideways, ceiling, highest = reach[0], reach[1], bins.highest
    c, s, px, py = np.cos(pose[2]), np.sin(pose[2]), pose[0], pose[1]
    corner, own, cells = np.empty((3, 3)), np.empty(9), np.empty(4, dtype=np.int32)
    layout = layout_of(bins)
    seen = np.full(bins.facing.shape[0], -1, dtype=np.int32)
    pairs, count = np.empty((4096, 2), dtype=np.int32), 0
    for t in range(triangles.shape[0]):
        lowest = min(points[triangles[t, 0], 2], points[triangles[t, 1], 2], points[triangles[t, 2], 2])
        if lowest - highest > ceiling:
            continue
        for k in range(3):
            u, v = points[triangles[t, k], 0] - px, points[triangles[t, k], 1] - py
            corner[k, 0], corner[k, 1], corner[k, 2] = c * u + s * v, c * v - s * u, points[triangles[t, k], 2]
        box_and_cells(corner, layout, sideways, own, cells)
        if not any_active(active, layout, cells) or not _plane(corner, own):
            continue
        for j in range(cells[2], cells[3] + 1):
            for i in range(cells[0], cells[1] + 1):
                open_cell = active[j * cover.shape[1] + i]
                if open_cell and _above_cell(cover, layout, (i, j), own, sideways) <= ceiling:
                    pairs, count = _with_cell(bins, (t, j * cover.shape[1] + i), (own, seen, reach), pairs, count)
    return pairs[:count].copy()


@compiled
def _with_cell(bins: Bins, at: At, triangle: Span, pairs: Int, count: int) -> tuple[Int, int]:
    """Add the pairs of one reference triangle with the triangles of one cell that it has not met in another cell."""
    t, cell = at
    own, seen, reach = triangle
    items, facing, numbers = bins.items, bins.facing, bins.triangles
    for k in range(bins.start[cell], bins.start[cell + 1]):
        item = items[k]
        if seen[item] != t and _may_meet(facing, item, own, reach[0], reach[1]):
            seen[item] = t
            if count == pairs.shape[0]:
                pairs = _longer(pairs)
            pairs[count, 0], pairs[count, 1] = t, numbers[item]
            count += 1
    return pairs, count


@compiled
def _longer(pairs: Int) -> Int:
    out = np.empty((2 * pairs.shape[0], pairs.shape[1]), dtype=np.int32)
    out[: pairs.shape[0]] = pairs
    return out


class Claims(NamedTuple):
    """Which corners and edges of a surface have been taken, and by whom.

    Attributes
    ----------
    owned : (M,) uint8
        Bits of what each triangle owns; ``UNCLAIMED`` before its turn.
    points, edges : (N,), (E,) bool
        What is taken.
    """

    owned: Bytes
    points: Flags
    edges: Flags


@compiled
def features_of(attitude: Attitude, pairs: Int, pose: Float, sideways: float) -> Int:
    """(K, 5) features of triangle pairs that may be there within a sideways reach, each once.

    ``CORNER_BELOW``: moving point, reference triangle. ``CORNER_ABOVE``: reference point, moving triangle.
    ``CROSSING``: two reference points, two moving points.
    """
    reference, moving = attitude.reference, attitude.moving
    corners, others, edges, other_edges = reference.triangles, moving.triangles, reference.edges, moving.edges
    above, below = reference.points, moving.points
    claims, other_claims = _no_claims(reference), _no_claims(moving)
    own_r, own_m = claims.owned, other_claims.owned
    c, s, px, py = np.cos(pose[2]), np.sin(pose[2]), pose[0], pose[1]
    out, count = np.empty((15 * len(pairs), 5), dtype=np.int32), 0
    first, second = np.empty((3, 2)), np.empty((3, 2))
    for p in range(len(pairs)):
        t, m = pairs[p, 0], pairs[p, 1]
        _claim(corners, edges, t, claims)
        _claim(others, other_edges, m, other_claims)
        for k in range(3):
            first[k, 0], first[k, 1] = above[corners[t, k], 0] - px, above[corners[t, k], 1] - py
            x, y = below[others[m, k], 0], below[others[m, k], 1]
            second[k, 0], second[k, 1] = c * x - s * y, s * x + c * y
        for k in range(3):
            if own_m[m] >> k & 1 and _near_triangle(first, second[k, 0], second[k, 1], sideways):
                out[count, 0], out[count, 1], out[count, 2] = CORNER_BELOW, others[m, k], t
                count += 1
            if own_r[t] >> k & 1 and _near_triangle(second, first[k, 0], first[k, 1], sideways):
                out[count, 0], out[count, 1], out[count, 2] = CORNER_ABOVE, corners[t, k], m
                count += 1
            for n in range(3):
                both = own_r[t] >> (k + 3) & 1 and own_m[m] >> (n + 3) & 1
                if both and _near_edges(first, k, second, n, sideways):
                    out[count, 0], out[count, 1], out[count, 2] = CROSSING, corners[t, k], corners[t, (k + 1) % 3]
                    out[count, 3], out[count, 4] = others[m, n], others[m, (n + 1) % 3]
                    count += 1
    return out[:count].copy()


@compiled
def _near_triangle(corner: Float, x: float, y: float, sideways: float) -> bool:
    """Whether (x, y) lies within a distance of the box of three corners."""
    x0, x1 = min(corner[0, 0], corner[1, 0], corner[2, 0]), max(corner[0, 0], corner[1, 0], corner[2, 0])
    y0, y1 = min(corner[0, 1], corner[1, 1], corner[2, 1]), max(corner[0, 1], corner[1, 1], corner[2, 1])
    return bool(max(x0 - x, x - x1, y0 - y, y - y1) <= sideways)


@compiled
def _near_edges(first: Float, k: int, second: Float, n: int, sideways: float) -> bool:
    """Whether the boxes of edge k and edge n of two triangles come within a distance."""
    apart = -1.0
    for axis in range(2):
        a, b = first[k, axis], first[(k + 1) % 3, axis]
        p, q = second[n, axis], second[(n + 1) % 3, axis]
        apart = max(apart, min(a, b) - max(p, q), min(p, q) - max(a, b))
    return apart <= sideways


@compiled
def _claim(triangles: Int, edges: Int, t: int, claims: Claims) -> None:
    """Let the first triangle that comes own its corners (bits 0..2) and edges (bits 3..5): each counts once."""
    if claims.owned[t] != UNCLAIMED:
        return
    bits = 0
    for k in range(3):
        if not claims.points[triangles[t, k]]:
            claims.points[triangles[t, k]] = True
            bits |= 1 << k
        if not claims.edges[edges[t, k]]:
            claims.edges[edges[t, k]] = True
            bits |= 8 << k
    claims.owned[t] = bits


@compiled
def _no_claims(surface: Surface) -> Claims:
    return Claims(
        np.full(len(surface.triangles), UNCLAIMED, np.uint8),
        np.zeros(len(surface.points), np.bool_),
        np.zeros(surface.edge_count, np.bool_),
    )


@compiled
def clearances(attitude: Attitude, features: Int, pose: Float, found: Rows) -> float:
    """Clearance of each feature along z at a pose, and its slopes; the least: the depth of the body at this pose."""
    reference, moving = attitude.reference, attitude.moving
    place = (pose[0], pose[1], np.cos(pose[2]), np.sin(pose[2]))
    least = NOTHING_MM
    for k in range(features.shape[0]):
        kind = features[k, 0]
        if kind == CORNER_BELOW:
            gap, gx, gy, rx, ry = _corner_below(reference, moving, features, k, place)
        elif kind == CORNER_ABOVE:
            gap, gx, gy, rx, ry = _corner_above(reference, moving, features, k, place)
        else:
            gap, gx, gy, rx, ry = _crossing(reference, moving, features, k, place)
        found.gaps[k] = gap
        found.rates[k, 0], found.rates[k, 1], found.rates[k, 2] = gx, gy, gy * rx - gx * ry
        found.arms[k, 0], found.arms[k, 1] = rx, ry
        least = min(least, gap)
    return least


@compiled
def _over_triangle(points: Float, triangles: Int, face: int, x: float, y: float) -> tuple[float, float, float]:
    """Height of a face above (x, y) and its slopes; ``NOTHING_MM`` where the point is not below it."""
    a, b, c = triangles[face, 0], triangles[face, 1], triangles[face, 2]
    ax, ay, az = points[a, 0], points[a, 1], points[a, 2]
    ux, uy, uz = points[b, 0] - ax, points[b, 1] - ay, points[b, 2] - az
    vx, vy, vz = points[c, 0] - ax, points[c, 1] - ay, points[c, 2] - az
    per = 1.0 / (ux * vy - vx * uy)
    v, w = ((x - ax) * vy - vx * (y - ay)) * per, (ux * (y - ay) - (x - ax) * uy) * per
    if min(v, w, 1.0 - v - w) < -SHARED:
        return NOTHING_MM, 0.0, 0.0
    return az + v * uz + w * vz, (uz * vy - vz * uy) * per, (ux * vz - vx * uz) * per


@compiled
def _corner_below(reference: Surface, moving: Surface, features: Int, k: int, place: Place) -> Feature:
    x, y, c, s = place
    p, face = features[k, 1], features[k, 2]
    rx = c * moving.points[p, 0] - s * moving.points[p, 1]
    ry = s * moving.points[p, 0] + c * moving.points[p, 1]
    z, gx, gy = _over_triangle(reference.points, reference.triangles, face, rx + x, ry + y)
    return (z - moving.points[p, 2] if z < FAR_MM else z), gx, gy, rx, ry


@compiled
def _corner_above(reference: Surface, moving: Surface, features: Int, k: int, place: Place) -> Feature:
    x, y, c, s = place
    p, face = features[k, 1], features[k, 2]
    rx, ry = reference.points[p, 0] - x, reference.points[p, 1] - y
    z, gx, gy = _over_triangle(moving.points, moving.triangles, face, c * rx + s * ry, c * ry - s * rx)
    return (reference.points[p, 2] - z if z < FAR_MM else z), c * gx - s * gy, s * gx + c * gy, rx, ry


@compiled
def _crossing(reference: Surface, moving: Surface, features: Int, k: int, place: Place) -> Feature:
    x, y, c, s = place
    a, b, p, q = features[k, 1], features[k, 2], features[k, 3], features[k, 4]
    ax, ay, az = reference.points[a, 0] - x, reference.points[a, 1] - y, reference.points[a, 2]
    ux, uy = reference.points[b, 0] - x - ax, reference.points[b, 1] - y - ay
    uz = reference.points[b, 2] - az
    px, py, pz = moving.points[p, 0], moving.points[p, 1], moving.points[p, 2]
    ex, ey, vz = moving.points[q, 0] - px, moving.points[q, 1] - py, moving.points[q, 2] - pz
    dx, dy = c * px - s * py - ax, s * px + c * py - ay
    vx, vy = c * ex - s * ey, s * ex + c * ey
    det = ux * vy - vx * uy
    if abs(det) < PARALLEL:
        return NOTHING_MM, 0.0, 0.0, 0.0, 0.0
    per = 1.0 / det
    on_u, on_v = (dx * vy - vx * dy) * per, (dx * uy - ux * dy) * per
    if min(on_u, 1.0 - on_u, on_v, 1.0 - on_v) < 0.0:
        return NOTHING_MM, 0.0, 0.0, 0.0, 0.0
    gap = az + on_u * uz - pz - on_v * vz
    return gap, (uz * vy - vz * uy) * per, (ux * vz - vx * uz) * per, ax + on_u * ux, ay + on_u * uy
