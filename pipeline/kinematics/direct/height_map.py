"""The reference seen along delta as a map of heights, and the gaps of points below it (compiled)."""

from __future__ import annotations

import numpy as np

from pipeline.kinematics.compilation import compiled, inlined
from pipeline.kinematics.direct.surfaces import (
    FAR_MM,
    NOTHING_MM,
    SHARED,
    STEEPEST,
    Body,
    Float,
    HeightMap,
    Int,
    Rows,
    Surface,
)


@compiled
def facing_below(body: Body, ceiling_mm: float, box: Float) -> tuple[Surface, Float]:
    """The triangles whose normal opposes z and whose lowest corner lies below a ceiling, and what they span.

    Walls are left out. The first triangle that comes owns its corners and edges.

    Parameters
    ----------
    body : Body
        Points and spheres in the attitude frame.
    ceiling_mm : float
    box : (4,) float64
        Written: least x and y, greatest x and y.

    Returns
    -------
    surface : Surface
    spots : (M, 4) float64
        See :class:`Attitude`.
    """
    points, triangles, spheres, count = body.points, body.triangles, body.spheres, 0
    kept, owned, spots = np.empty_like(triangles), np.empty(len(triangles), np.uint8), np.empty((len(triangles), 4))
    taken, taken_edges = np.zeros(points.shape[0], np.bool_), np.zeros(body.edge_count, np.bool_)
    box[0], box[1], box[2], box[3] = np.inf, np.inf, -np.inf, -np.inf
    for block in range(spheres.shape[0]):
        if spheres[block, 2] - spheres[block, 3] > ceiling_mm:
            continue
        for t in range(body.blocks[block], body.blocks[block + 1]):
            a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
            lowest = min(points[a, 2], points[b, 2], points[c, 2])
            if lowest > ceiling_mm or not _opposes(points, a, b, c):
                continue
            bits = 0
            for k in range(3):
                corner, edge = triangles[t, k], body.edges[t, k]
                bits |= ((not taken[corner]) << k) | ((not taken_edges[edge]) << (k + 3))
                taken[corner], taken_edges[edge], kept[count, k] = True, True, corner
            owned[count] = bits
            for axis in range(2):
                low = min(points[a, axis], points[b, axis], points[c, axis])
                high = max(points[a, axis], points[b, axis], points[c, axis])
                box[axis], box[axis + 2] = min(box[axis], low), max(box[axis + 2], high)
                spots[count, axis] = (points[a, axis] + points[b, axis] + points[c, axis]) / 3.0
            away = 0.0
            for k in range(3):
                corner = triangles[t, k]
                x, y = points[corner, 0] - spots[count, 0], points[corner, 1] - spots[count, 1]
                away = max(away, x * x + y * y)
            spots[count, 2], spots[count, 3] = np.sqrt(away), lowest
            count += 1
    return Surface(points, kept[:count], owned[:count]), spots[:count]


@inlined
def _opposes(points: Float, a: int, b: int, c: int) -> bool:
    """Whether the normal of a triangle opposes z; that of a wall does not."""
    ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
    vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
    nx, ny, nz = uy * vz - vy * uz, uz * vx - vz * ux, ux * vy - vx * uy
    return bool(nz < 0.0 and nx * nx + ny * ny <= STEEPEST * STEEPEST * nz * nz)


@compiled
def rasterise(points: Float, triangles: Int, heights: HeightMap) -> None:
    """Lower the nodes of a height map to the triangles above them whose normal opposes z."""
    z, per = heights.z, 1.0 / heights.spacing
    ny, nx = z.shape
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        # in units of the spacing, from node (0, 0)
        ax, ay, az = (points[a, 0] - heights.x0) * per, (points[a, 1] - heights.y0) * per, points[a, 2]
        bx, by = (points[b, 0] - heights.x0) * per, (points[b, 1] - heights.y0) * per
        cx, cy = (points[c, 0] - heights.x0) * per, (points[c, 1] - heights.y0) * per
        det = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        i0, i1 = max(int(np.ceil(min(ax, bx, cx))), 0), min(int(np.floor(max(ax, bx, cx))), nx - 1)
        j0, j1 = max(int(np.ceil(min(ay, by, cy))), 0), min(int(np.floor(max(ay, by, cy))), ny - 1)
        if det >= 0.0 or i0 > i1 or j0 > j1:
            continue
        per_det = 1.0 / det
        vx, vy = (cy - ay) * per_det, (ax - cx) * per_det
        wx, wy = (ay - by) * per_det, (bx - ax) * per_det
        uz, wz = points[b, 2] - az, points[c, 2] - az
        for j in range(j0, j1 + 1):
            for i in range(i0, i1 + 1):
                v = (i - ax) * vx + (j - ay) * vy
                w = (i - ax) * wx + (j - ay) * wy
                if min(v, w, 1.0 - v - w) >= -SHARED:
                    z[j, i] = min(z[j, i], az + v * uz + w * wz)


@inlined
def _height_above(z: Float, u: float, v: float) -> tuple[float, float, float]:
    """Height between the nodes at (u, v), in units of the spacing from node (0, 0), and its slopes per unit.

    ``NOTHING_MM`` outside the map and where a node beside it has nothing above.
    """
    if min(u, v, z.shape[1] - 1 - u, z.shape[0] - 1 - v) <= 0.0:
        return NOTHING_MM, 0.0, 0.0
    i, j = int(u), int(v)
    z00, z01, z10, z11 = z[j, i], z[j, i + 1], z[j + 1, i], z[j + 1, i + 1]
    if max(z00, z01, z10, z11) > FAR_MM:
        return NOTHING_MM, 0.0, 0.0
    u, v = u - i, v - j
    height = (z00 * (1.0 - u) + z01 * u) * (1.0 - v) + (z10 * (1.0 - u) + z11 * u) * v
    return height, (z01 - z00) * (1.0 - v) + (z11 - z10) * v, (z10 - z00) * (1.0 - u) + (z11 - z01) * u


@compiled
def gaps_at(heights: HeightMap, samples: Float, pose: Float, found: Rows) -> float:
    """Gap along z of each sample at a pose, and its change per mm of x, of y and per rad of theta.

    Parameters
    ----------
    heights : HeightMap
    samples : (S, 3) float64
    pose : (3,) float64
        x, y (mm) and theta (rad).
    found : Rows
        Written; gaps are ``NOTHING_MM`` where the reference is not above the sample.

    Returns
    -------
    float
        The least gap.
    """
    c, s, per = np.cos(pose[2]), np.sin(pose[2]), 1.0 / heights.spacing
    gaps, rates, z = found.gaps, found.rates, heights.z
    least = NOTHING_MM
    for k in range(samples.shape[0]):
        rx = c * samples[k, 0] - s * samples[k, 1]
        ry = s * samples[k, 0] + c * samples[k, 1]
        u, v = (rx + pose[0] - heights.x0) * per, (ry + pose[1] - heights.y0) * per
        height, along_u, along_v = _height_above(z, u, v)
        gaps[k] = NOTHING_MM
        if height > FAR_MM:
            continue
        gaps[k] = height - samples[k, 2]
        rates[k, 0], rates[k, 1] = along_u * per, along_v * per
        rates[k, 2] = rates[k, 1] * rx - rates[k, 0] * ry
        least = min(least, gaps[k])
    return least


@compiled
def depth_over(heights: HeightMap, samples: Float, pose: Float, gaps: Float) -> float:
    """Write the gap of every sample as :func:`gaps_at` does, without its change; the least."""
    c, s, per, z = np.cos(pose[2]), np.sin(pose[2]), 1.0 / heights.spacing, heights.z
    least = NOTHING_MM
    for k in range(samples.shape[0]):
        rx = c * samples[k, 0] - s * samples[k, 1]
        ry = s * samples[k, 0] + c * samples[k, 1]
        u, v = (rx + pose[0] - heights.x0) * per, (ry + pose[1] - heights.y0) * per
        height, _, _ = _height_above(z, u, v)
        gaps[k] = height - samples[k, 2] if height <= FAR_MM else NOTHING_MM
        least = min(least, gaps[k])
    return least
