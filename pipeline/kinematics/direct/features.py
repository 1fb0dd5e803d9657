"""Exact clearance along delta between two triangle surfaces, feature by feature (compiled).

Seen along delta, the least clearance of two overlapping triangles lies at a corner of one above the face of the other,
or where two edges cross. Each such feature gives a height that is linear in x and y and smooth in theta; the depth at a
pose is the least of all features that are *there* (corner within the face, crossing within both edges).
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from pipeline.kinematics.compilation import compiled, inlined
from pipeline.kinematics.direct.surfaces import (
    NOTHING_MM,
    PEAK_CELLS,
    SHARED,
    Attitude,
    Bins,
    Flags,
    Float,
    Int,
    Rows,
)

#: Edges whose cross product seen along z is below this (mm^2) do not cross.
PARALLEL = 1e-12

Table = TypeVar("Table", Float, Int)
Cell = tuple[int, int]
#: x0, y0 and size of the cells.
Corner = tuple[float, float, float]
#: Three corners, and the number of the side from corner k to corner k + 1.
Side = tuple[Float, int]


@compiled
def triangles_over(attitude: Attitude, active: Flags, pose: Float, ceiling: float, around: float) -> Int:
    """Triangles of the reference that may come above an active cell which reaches up to them.

    Parameters
    ----------
    attitude : Attitude
    active : (NY, NX) bool
        Cells of the moving body that are looked at.
    pose : (3,) float64
        x, y (mm), theta (rad).
    ceiling : float
        Clearances above this do not matter, mm.
    around : float
        No point of the body gets farther sideways from this pose, mm.

    Returns
    -------
    (K,) int32
    """
    spots, peaks = attitude.spots, _peaks(attitude.bins, active)
    x0, y0, size = attitude.bins.x0, attitude.bins.y0, attitude.bins.size
    c, s, x, y = np.cos(pose[2]), np.sin(pose[2]), pose[0], pose[1]
    near, count = np.empty(spots.shape[0], np.int32), 0
    for t in range(spots.shape[0]):
        if spots[t, 2] + around <= PEAK_CELLS * size:
            u, v = spots[t, 0] - x, spots[t, 1] - y
            i = int(np.floor((c * u + s * v - x0) / size)) + PEAK_CELLS
            j = int(np.floor((c * v - s * u - y0) / size)) + PEAK_CELLS
            if min(i, j, peaks.shape[1] - 1 - i, peaks.shape[0] - 1 - j) < 0 or spots[t, 3] - peaks[j, i] > ceiling:
                continue
        near[count] = t
        count += 1
    return near[:count]


@compiled
def _peaks(bins: Bins, active: Flags) -> Float:
    """Greatest z of the active cells within ``PEAK_CELLS`` of each cell, from so many cells before the first on."""
    rows, columns = active.shape
    around = 2 * PEAK_CELLS + 1
    peaks = np.full((rows + around - 1, columns + around - 1), -NOTHING_MM)
    for j in range(rows):
        for i in range(columns):
            if active[j, i]:
                for n in range(j, j + around):
                    for m in range(i, i + around):
                        peaks[n, m] = max(peaks[n, m], bins.cover[j, i, 3])
    return peaks


@compiled
def near_pairs(attitude: Attitude, active: Flags, among: Int, pose: Float, ceiling: float) -> Int:
    """Pairs of triangles that may meet at a pose below a ceiling.

    Parameters
    ----------
    attitude : Attitude
    active : (NY, NX) bool
        Cells that are looked at.
    among : (M,) int32
        Triangles of the reference that are looked at.
    pose : (3,) float64
        x, y (mm), theta (rad).
    ceiling : float
        Clearances above this do not matter, mm.

    Returns
    -------
    (K, 2) int32
        Reference and moving triangle. Every feature of these with a clearance up to the ceiling in an active cell
        belongs to one of them.
    """
    start, items, spans = attitude.bins.start, attitude.bins.items, attitude.bins.spans
    facing, numbers, cover = attitude.bins.facing, attitude.bins.triangles, attitude.bins.cover
    corner = (attitude.bins.x0, attitude.bins.y0, attitude.bins.size)
    near, boxes, cells = _boxes(attitude, among, pose)
    seen = np.full(facing.shape[0], -1, dtype=np.int32)
    pairs, count = np.empty((1024, 2), dtype=np.int32), 0
    for n in range(near.shape[0]):
        t, x0, y0, x1, y1 = near[n], boxes[n, 0], boxes[n, 1], boxes[n, 3], boxes[n, 4]
        least = boxes[n, 2] - ceiling
        for j in range(cells[n, 2], cells[n, 3] + 1):
            for i in range(cells[n, 0], cells[n, 1] + 1):
                if not active[j, i] or cover[j, i, 3] < least or _above_cell(cover, (i, j), corner, boxes, n) > ceiling:
                    continue
                cell = j * cover.shape[1] + i
                if count + start[cell + 1] - start[cell] > pairs.shape[0]:
                    pairs = _longer(pairs, start[cell + 1] - start[cell])
                for k in range(start[cell], start[cell + 1]):
                    # one comparison for five reasons: a processor guesses it right
                    if (
                        max(x0 - spans[k, 2], spans[k, 0] - x1, y0 - spans[k, 3], spans[k, 1] - y1, least - spans[k, 4])
                        > 0.0
                    ):
                        continue
                    item = items[k]
                    if seen[item] != t and _planes_meet(facing, item, boxes, n, ceiling):
                        seen[item] = t
                        pairs[count, 0], pairs[count, 1] = t, numbers[item]
                        count += 1
    return pairs[:count]


@compiled
def _boxes(attitude: Attitude, among: Int, pose: Float) -> tuple[Int, Float, Int]:
    """Boxes, planes and cells of triangles of the reference that lie over the moving body.

    Returns
    -------
    near : (K,) int32
        Which.
    boxes : (K, 9) float64
        Least x, y, z, greatest x, y, z in the moving frame, then height at (0, 0) and slopes in x and y of the plane.
    cells : (K, 4) int32
        First and last column, first and last row of the cells below.
    """
    points, triangles = attitude.reference.points, attitude.reference.triangles
    x0, y0, per, count = attitude.bins.x0, attitude.bins.y0, 1.0 / attitude.bins.size, 0
    rows, columns = attitude.bins.cover.shape[:2]
    c, s, px, py = np.cos(pose[2]), np.sin(pose[2]), pose[0], pose[1]
    near, boxes, cells = np.empty(among.size, np.int32), np.empty((among.size, 9)), np.empty((among.size, 4), np.int32)
    for t in among:
        a, b, d = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        u, v = points[a, 0] - px, points[a, 1] - py
        ax, ay, az = c * u + s * v, c * v - s * u, points[a, 2]
        u, v = points[b, 0] - px, points[b, 1] - py
        ux, uy, uz = c * u + s * v - ax, c * v - s * u - ay, points[b, 2] - az
        u, v = points[d, 0] - px, points[d, 1] - py
        vx, vy, vz = c * u + s * v - ax, c * v - s * u - ay, points[d, 2] - az
        low_x, low_y = ax + min(0.0, ux, vx), ay + min(0.0, uy, vy)
        high_x, high_y = ax + max(0.0, ux, vx), ay + max(0.0, uy, vy)
        # what lies before the first cell rounds to it: one cell too many does no harm
        i0, i1 = max(int((low_x - x0) * per), 0), min(int((high_x - x0) * per), columns - 1)
        j0, j1 = max(int((low_y - y0) * per), 0), min(int((high_y - y0) * per), rows - 1)
        det = ux * vy - vx * uy
        if det >= 0.0 or i0 > i1 or j0 > j1:
            continue
        gx, gy = (uz * vy - vz * uy) / det, (ux * vz - vx * uz) / det
        near[count] = t
        boxes[count, 0], boxes[count, 1], boxes[count, 2] = low_x, low_y, az + min(0.0, uz, vz)
        boxes[count, 3], boxes[count, 4], boxes[count, 5] = high_x, high_y, az + max(0.0, uz, vz)
        boxes[count, 6], boxes[count, 7], boxes[count, 8] = az - gx * ax - gy * ay, gx, gy
        cells[count, 0], cells[count, 1], cells[count, 2], cells[count, 3] = i0, i1, j0, j1
        count += 1
    return near[:count], boxes[:count], cells[:count]


@inlined
def _above_cell(cover: Float, cell: Cell, corner: Corner, boxes: Float, n: int) -> float:
    """Bound from below of the clearance of a triangle, by its box and plane, above a cell of the moving body."""
    i, j = cell
    size, gx, gy = corner[2], boxes[n, 7] - cover[j, i, 1], boxes[n, 8] - cover[j, i, 2]
    x0, y0 = corner[0] + i * size, corner[1] + j * size
    x1, y1 = min(x0 + size, boxes[n, 3]), min(y0 + size, boxes[n, 4])
    x0, y0 = max(x0, boxes[n, 0]), max(y0, boxes[n, 1])
    least: float = boxes[n, 6] - cover[j, i, 0] + min(gx * x0, gx * x1) + min(gy * y0, gy * y1)
    return least


@inlined
def _planes_meet(facing: Float, item: int, boxes: Float, n: int, ceiling: float) -> bool:
    """Whether the planes of two triangles come as near as a ceiling over what their boxes share."""
    x0, x1 = max(boxes[n, 0], facing[item, 0]), min(boxes[n, 3], facing[item, 3])
    y0, y1 = max(boxes[n, 1], facing[item, 1]), min(boxes[n, 4], facing[item, 4])
    gx, gy = boxes[n, 7] - facing[item, 7], boxes[n, 8] - facing[item, 8]
    middle = boxes[n, 6] - facing[item, 6] + 0.5 * (gx * (x0 + x1) + gy * (y0 + y1))
    tilt = 0.5 * (abs(gx) * (x1 - x0) + abs(gy) * (y1 - y0))
    return bool(middle - tilt <= ceiling)


@compiled
def _longer(rows: Table, more: int) -> Table:
    """The same rows with room for as many again and some more."""
    out = np.empty((2 * rows.shape[0] + more, rows.shape[1]), dtype=rows.dtype)
    out[: rows.shape[0]] = rows
    return out


@compiled
def rows_of(attitude: Attitude, pairs: Int, pose: Float, ceiling: float) -> Rows:
    """Every feature of some pairs of triangles that is there at a pose, once, with a clearance up to a ceiling."""
    above, below = attitude.reference.points, attitude.moving.points
    corners, others = attitude.reference.triangles, attitude.moving.triangles
    own_above, own_below = attitude.reference.owned, attitude.moving.owned
    c, s, px, py = np.cos(pose[2]), np.sin(pose[2]), pose[0], pose[1]
    first, second, face, other = np.empty((3, 3)), np.empty((3, 3)), np.empty(9), np.empty(9)
    found, count = np.empty((256, 5)), 0
    for p in range(pairs.shape[0]):
        t, m = pairs[p, 0], pairs[p, 1]
        for k in range(3):
            first[k, 0], first[k, 1] = above[corners[t, k], 0] - px, above[corners[t, k], 1] - py
            first[k, 2], second[k, 2] = above[corners[t, k], 2], below[others[m, k], 2]
            x, y = below[others[m, k], 0], below[others[m, k], 1]
            second[k, 0], second[k, 1] = c * x - s * y, s * x + c * y
        _face(first, face)
        _face(second, other)
        if count + MOST_OF_A_PAIR > found.shape[0]:
            found = _longer(found, 0)
        for k in range(3):
            if own_below[m] >> k & 1 and _over(face, second, k, found, count):
                found[count, 0] -= second[k, 2]
                count += found[count, 0] <= ceiling
            if own_above[t] >> k & 1 and _over(other, first, k, found, count):
                found[count, 0] = first[k, 2] - found[count, 0]
                count += found[count, 0] <= ceiling
            if own_above[t] >> (k + 3) & 1:
                for n in range(3):
                    if own_below[m] >> (n + 3) & 1 and _crossing((first, k), (second, n), found, count):
                        count += found[count, 0] <= ceiling
    return _rows(found[:count])


#: Two triangles have no more features than this: six corners and nine crossings of edges.
MOST_OF_A_PAIR = 15


@inlined
def _face(corner: Float, face: Float) -> None:
    """Write the first corner, the slopes of both barycentric coordinates and those of the height of a triangle."""
    ux, uy, uz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    vx, vy, vz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    per = 1.0 / (ux * vy - vx * uy)
    face[0], face[1], face[2] = corner[0, 0], corner[0, 1], corner[0, 2]
    face[3], face[4], face[5], face[6] = vy * per, -vx * per, -uy * per, ux * per
    face[7], face[8] = (uz * vy - vz * uy) * per, (ux * vz - vx * uz) * per


@inlined
def _over(face: Float, corners: Float, k: int, found: Float, row: int) -> bool:
    """Whether a face lies above or below a corner; its height there, its slopes and the place are written."""
    x, y = corners[k, 0], corners[k, 1]
    dx, dy = x - face[0], y - face[1]
    v, w = dx * face[3] + dy * face[4], dx * face[5] + dy * face[6]
    found[row, 0], found[row, 1], found[row, 2] = face[2] + dx * face[7] + dy * face[8], face[7], face[8]
    found[row, 3], found[row, 4] = x, y
    return bool(min(v, w, 1.0 - v - w) >= -SHARED)


@inlined
def _crossing(above: Side, below: Side, found: Float, row: int) -> bool:
    """Whether a side of one triangle crosses one of the other below it; clearance, slopes and place are written."""
    (first, a), (second, p) = above, below
    b, q = (a + 1) % 3, (p + 1) % 3
    ux, uy, uz = first[b, 0] - first[a, 0], first[b, 1] - first[a, 1], first[b, 2] - first[a, 2]
    vx, vy, vz = second[q, 0] - second[p, 0], second[q, 1] - second[p, 1], second[q, 2] - second[p, 2]
    dx, dy = second[p, 0] - first[a, 0], second[p, 1] - first[a, 1]
    det = ux * vy - vx * uy
    if abs(det) < PARALLEL:
        return False
    per = 1.0 / det
    on_u, on_v = (dx * vy - vx * dy) * per, (dx * uy - ux * dy) * per
    found[row, 0] = first[a, 2] + on_u * uz - second[p, 2] - on_v * vz
    found[row, 1], found[row, 2] = (uz * vy - vz * uy) * per, (ux * vz - vx * uz) * per
    found[row, 3], found[row, 4] = first[a, 0] + on_u * ux, first[a, 1] + on_u * uy
    return bool(min(on_u, 1.0 - on_u, on_v, 1.0 - on_v) >= 0.0)


@compiled
def _rows(found: Float) -> Rows:
    """Rows from clearance, slopes in x and y, and place."""
    count = found.shape[0]
    rows = Rows(np.empty(count), np.empty((count, 3)), np.empty((count, 2)))
    for k in range(count):
        rows.gaps[k], rows.rates[k, 0], rows.rates[k, 1] = found[k, 0], found[k, 1], found[k, 2]
        rows.rates[k, 2] = found[k, 2] * found[k, 3] - found[k, 1] * found[k, 4]
        rows.arms[k, 0], rows.arms[k, 1] = found[k, 3], found[k, 4]
    return rows
