"""The kernels of the direct solver in plain numpy: what they compute, without how they are quick about it.

Same signatures as the compiled ones, so that ``DirectSolver(kernels=PLAIN)`` is the same solver, for bodies of a few
hundred triangles. Every corner is held against every face and every edge against every edge; nothing is gathered in
neighbourhoods, nothing is left out.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.kinematics.direct.kernels import Kernels
from pipeline.kinematics.direct.settings import SearchLimits
from pipeline.kinematics.direct.surfaces import FAR_MM, NOTHING_MM, SHARED, Attitude, Float, HeightMap, Int, Rows
from pipeline.kinematics.least_rate import best_motion
from pipeline.kinematics.ligaments import fibre_load

#: Gaps and slopes of whatever is above the body at (x, y, theta).
Seen = Callable[[Float], Rows]


def rasterise(points: Float, triangles: Int, heights: HeightMap) -> None:
    """Lower the nodes of a height map to the triangles above them whose normal opposes z."""
    rows, columns = heights.z.shape
    x = heights.x0 + heights.spacing * np.arange(columns)
    y = heights.y0 + heights.spacing * np.arange(rows)
    across, along = np.meshgrid(x, y)
    for a, b, c in points[triangles]:
        u, v = b - a, c - a
        det = u[0] * v[1] - v[0] * u[1]
        if det < 0.0:
            s = ((across - a[0]) * v[1] - v[0] * (along - a[1])) / det
            t = (u[0] * (along - a[1]) - (across - a[0]) * u[1]) / det
            above = np.minimum(np.minimum(s, t), 1.0 - s - t) >= -SHARED
            heights.z[above] = np.minimum(heights.z, a[2] + s * u[2] + t * v[2])[above]


def map_rows(attitude: Attitude, pose: Float) -> Rows:
    """Gap of every sample under the height map, and its slopes."""
    heights, samples = attitude.heights, attitude.samples
    arms = _turned(samples[:, :2], pose[2])
    place = (arms + pose[:2] - [heights.x0, heights.y0]) / heights.spacing
    rows, columns = heights.z.shape
    inside = np.all((place > 0.0) & (place < [columns - 1, rows - 1]), axis=1)
    gaps, rates = np.full(len(samples), NOTHING_MM), np.zeros((len(samples), 3))
    i, j = np.floor(place[inside]).astype(int).T
    u, v = (place[inside] - np.floor(place[inside])).T
    z00, z01, z10, z11 = heights.z[j, i], heights.z[j, i + 1], heights.z[j + 1, i], heights.z[j + 1, i + 1]
    z = (z00 * (1.0 - u) + z01 * u) * (1.0 - v) + (z10 * (1.0 - u) + z11 * u) * v
    known = np.max([z00, z01, z10, z11], axis=0) <= FAR_MM
    gaps[inside] = np.where(known, z - samples[inside, 2], NOTHING_MM)
    slopes = np.column_stack([(z01 - z00) * (1 - v) + (z11 - z10) * v, (z10 - z00) * (1 - u) + (z11 - z01) * u])
    rates[inside] = _with_turn(np.where(known[:, None], slopes / heights.spacing, 0.0), arms[inside])
    return Rows(gaps, rates, arms)


def exact_rows(attitude: Attitude, pose: Float) -> Rows:
    """Clearance of every feature that is there, and its slopes: all corners, all faces, all edges."""
    reference = attitude.reference.points[attitude.reference.triangles] - [pose[0], pose[1], 0.0]
    facing = attitude.moving.triangles[np.sort(attitude.bins.triangles)]
    moving = attitude.moving.points[facing].copy()
    moving[..., :2] = _turned(moving[..., :2], pose[2])
    parts = [
        _corners(np.unique(moving.reshape(-1, 3), axis=0), reference, 1.0),
        _corners(np.unique(reference.reshape(-1, 3), axis=0), moving, -1.0),
        _crossings(_edges(reference), _edges(moving)),
    ]
    gaps, slopes, arms = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Rows(gaps, _with_turn(slopes, arms), arms)


def search(attitude: Attitude, start: Float, limits: SearchLimits, found: Float) -> int:
    """Climb over the height map; see :func:`pipeline.kinematics.direct.search.search`."""
    return _climb(attitude, start, limits, found, lambda pose: map_rows(attitude, pose))


def polish(attitude: Attitude, start: Float, limits: SearchLimits, found: Float) -> int:
    """Climb on the triangles; see :func:`pipeline.kinematics.direct.polish.polish`."""
    return _climb(attitude, start, limits, found, lambda pose: exact_rows(attitude, pose))


def depth_at(attitude: Attitude, pose: Float) -> float:
    """Exact depth at (x, y, theta)."""
    return float(exact_rows(attitude, pose).gaps.min(initial=NOTHING_MM))


def _climb(attitude: Attitude, start: Float, limits: SearchLimits, found: Float, seen: Seen) -> int:
    """Sequential linear programming with a trust region: a step stands where it gains a tenth of its promise."""
    pose, rows = _placed(start, seen)
    trust, step = limits.first_mm, 0
    while trust > limits.last_mm and step < limits.steps and pose[3] < FAR_MM:
        step += 1
        load = fibre_load(attitude.fibres, (pose[0], pose[1], pose[2], pose[3]))
        near = rows.gaps < pose[3] + limits.steepest * trust
        rates = load.push * rows.rates[near] - load.slope[:3]
        slack = load.push * (rows.gaps[near] - pose[3])
        motion = np.array(best_motion(rates, slack, (trust, trust, trust / limits.radius_mm)))
        promise = float((slack + rates @ motion).min())
        if promise < limits.gain_mm:
            trust *= 0.3
            continue
        trial, there = _placed(pose + np.append(motion, 0.0), seen)
        if trial[3] > FAR_MM:
            pose = trial
            break
        energy = fibre_load(attitude.fibres, (trial[0], trial[1], trial[2], trial[3])).energy_mm
        gain = trial[3] - pose[3] - (energy - load.energy_mm)
        if gain < 0.1 * promise:
            trust *= 0.4
            continue
        pose, rows = trial, there
        trust = min(2.0 * trust, limits.largest_mm) if gain > 0.7 * promise else trust
    found[:] = pose
    return step


def _placed(pose: Float, seen: Seen) -> tuple[Float, Rows]:
    """The pose with its depth, and the rows there."""
    rows = seen(pose[:3])
    return np.array([*pose[:3], rows.gaps.min(initial=NOTHING_MM)]), rows


def _turned(points: Float, theta: float) -> Float:
    c, s = np.cos(theta), np.sin(theta)
    return np.asarray(points @ np.array([[c, s], [-s, c]]))


def _with_turn(slopes: Float, arms: Float) -> Float:
    """Slopes in x and y, and per rad of theta by the lever arm."""
    return np.column_stack([slopes, slopes[:, 1] * arms[:, 0] - slopes[:, 0] * arms[:, 1]])


def _corners(corners: Float, faces: Float, sign: float) -> tuple[Float, Float, Float]:
    """Clearances of corners under faces (sign 1) or above them (sign -1): gaps, slopes, places."""
    a, u, v = faces[:, 0], faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]
    det = u[:, 0] * v[:, 1] - v[:, 0] * u[:, 1]
    way = corners[:, None, :2] - a[:, :2]
    s = (way[..., 0] * v[:, 1] - v[:, 0] * way[..., 1]) / det
    t = (u[:, 0] * way[..., 1] - way[..., 0] * u[:, 1]) / det
    k, f = np.nonzero(np.minimum(np.minimum(s, t), 1.0 - s - t) >= -SHARED)
    z = a[f, 2] + s[k, f] * u[f, 2] + t[k, f] * v[f, 2]
    slopes = (
        np.column_stack([u[:, 2] * v[:, 1] - v[:, 2] * u[:, 1], u[:, 0] * v[:, 2] - v[:, 0] * u[:, 2]]) / det[:, None]
    )
    return sign * (z - corners[k, 2]), slopes[f], corners[k, :2]


def _edges(faces: Float) -> Float:
    """(K, 2, 3) every edge of the faces once."""
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 6)
    swap = np.array([tuple(e[:3]) > tuple(e[3:]) for e in ends], dtype=bool)
    ends[swap] = ends[swap][:, [3, 4, 5, 0, 1, 2]]
    return np.unique(ends, axis=0).reshape(-1, 2, 3)


def _crossings(above: Float, below: Float) -> tuple[Float, Float, Float]:
    """Clearances where edges cross as seen along z: gaps, slopes, places."""
    u, v = above[:, 1] - above[:, 0], below[:, 1] - below[:, 0]
    way = below[None, :, 0] - above[:, None, 0]
    det = u[:, None, 0] * v[:, 1] - v[:, 0] * u[:, None, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (way[..., 0] * v[:, 1] - v[:, 0] * way[..., 1]) / det
        t = (way[..., 0] * u[:, None, 1] - u[:, None, 0] * way[..., 1]) / det
        meet = (np.minimum(np.minimum(s, 1.0 - s), np.minimum(t, 1.0 - t)) >= 0.0) & (np.abs(det) >= 1e-12)
    i, j = np.nonzero(meet)
    place = above[i, 0] + s[i, j, None] * u[i]
    gaps = place[:, 2] - below[j, 0, 2] - t[i, j] * v[j, 2]
    cross = np.column_stack([u[i, 2] * v[j, 1] - v[j, 2] * u[i, 1], u[i, 0] * v[j, 2] - v[j, 0] * u[i, 2]])
    return gaps, cross / det[i, j, None], place[:, :2]


PLAIN = Kernels(search, polish, depth_at)
