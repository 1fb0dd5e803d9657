"""The last steps on the exact triangles, and exact depths (compiled)."""

from __future__ import annotations

import numpy as np

from pipeline.kinematics.compilation import compiled
from pipeline.kinematics.direct.features import (
    Flags,
    any_active,
    box_and_cells,
    clearances,
    features_of,
    layout_of,
    near_pairs,
)
from pipeline.kinematics.direct.height_map import gaps_at
from pipeline.kinematics.direct.programme import best_motion
from pipeline.kinematics.direct.search import fibre_load, loaded_rows, new_rows, rows_within, sideways_way
from pipeline.kinematics.direct.settings import SearchLimits
from pipeline.kinematics.direct.surfaces import FAR_MM, Attitude, Float, Int, Surface

#: Heights this near are the same, mm.
ROUNDING_MM = 1e-9
#: Number of features while they are unknown: at the start, and where the climb has left its neighbourhood.
UNKNOWN, LEFT = -1, -2
#: Above so many features a neighbourhood is not made wider, and the steps count: ridges of a real joint are endless.
MANY = 600


@compiled
def cells_near(attitude: Attitude, pose: Float, slack: float) -> Flags:
    """Cells of the moving body where contact is possible, and the eight around each.

    By the height map: a sample of the cell comes within a slack of contact. Without a map, every cell.
    """
    rows, columns = attitude.bins.cover.shape[:2]
    if attitude.heights.z.size == 1:
        return np.ones(rows * columns, np.bool_)
    count = attitude.samples.shape[0]
    found, active = new_rows(count), np.zeros(rows * columns, np.bool_)
    least = gaps_at(attitude.heights, attitude.samples, np.arange(count), pose, found)
    for k in range(count):
        if found.gaps[k] < least + slack:
            row, column = divmod(attitude.sample_cells[k], columns)
            for j in range(max(row - 1, 0), min(row + 2, rows)):
                for i in range(max(column - 1, 0), min(column + 2, columns)):
                    active[j * columns + i] = True
    return active


@compiled
def narrowed(attitude: Attitude, pose: Float, active: Flags) -> Attitude:
    """The attitude with only those triangles of the reference that lie over active cells and may come into reach."""
    reference, bins = attitude.reference, attitude.bins
    points, triangles = reference.points, reference.triangles
    c, s, x, y = np.cos(pose[2]), np.sin(pose[2]), pose[0], pose[1]
    corner, own, cells, layout = np.empty((3, 3)), np.empty(9), np.empty(4, dtype=np.int32), layout_of(bins)
    kept, numbers, count = np.empty_like(triangles), np.empty_like(triangles), 0
    for t in range(triangles.shape[0]):
        for k in range(3):
            u, v = points[triangles[t, k], 0] - x, points[triangles[t, k], 1] - y
            corner[k, 0], corner[k, 1], corner[k, 2] = c * u + s * v, c * v - s * u, 0.0
        box_and_cells(corner, layout, 0.0, own, cells)
        if any_active(active, layout, cells):
            for k in range(3):
                kept[count, k], numbers[count, k] = triangles[t, k], reference.edges[t, k]
            count += 1
    fewer = Surface(points, kept[:count], numbers[:count], reference.edge_count)
    return Attitude(
        fewer,
        attitude.moving,
        bins,
        attitude.samples,
        attitude.sample_cells,
        attitude.heights,
        attitude.ceiling_mm,
        attitude.fibres,
    )


@compiled
def features_near(attitude: Attitude, pose: Float, reach: Float, active: Flags) -> tuple[Int, float]:
    """Features that may touch near a pose, and the depth up to which none is missing.

    Parameters
    ----------
    pose : (4,) float64
        x, y (mm), theta (rad), and z where contact is expected; with nothing there the search goes higher.
    reach : (2,) float64
        Sideways motion allowed for, and how far above the depth at the pose features are wanted, mm.
    active : (C,) bool
        Cells that are looked at.

    Returns
    -------
    features : (K, 5) int32
        None where the bodies never meet along delta.
    ceiling : float
    """
    limit, more = np.array([reach[0], pose[3] + reach[1]]), reach[1]
    while True:
        pairs = near_pairs(attitude.reference, attitude.bins, pose, limit, active)
        features = features_of(attitude, pairs, pose, reach[0])
        least = clearances(attitude, features, pose, new_rows(features.shape[0]))
        if least + reach[1] <= limit[1] + ROUNDING_MM or limit[1] > FAR_MM:
            return features, limit[1]
        more *= 4.0
        limit[1] = least + reach[1] if least < FAR_MM else limit[1] + more


@compiled
def depth_at(attitude: Attitude, pose: Float) -> float:
    """Exact depth at (x, y, theta, expected z): how far the body goes along delta; ``NOTHING_MM`` where for ever."""
    every = np.ones(attitude.bins.start.shape[0] - 1, np.bool_)
    features, _ = features_near(attitude, pose, np.array([0.0, 0.02]), every)
    return clearances(attitude, features, pose, new_rows(features.shape[0]))


@compiled
def polish(attitude: Attitude, start: Float, limits: SearchLimits, found: Float) -> int:
    """Climb on the exact triangles from (x, y, theta, expected z); the same steps as ``search``.

    Features are gathered for a neighbourhood of the size of the largest trust region, and again, for one twice as wide,
    where the climb leaves it: along flat ridges, and on bodies of few features.
    """
    fibres = attitude.fibres
    active = cells_near(attitude, start, limits.slack_mm)
    near = narrowed(attitude, start, active)
    pose, trial, anchor = start.copy(), start.copy(), start.copy()
    load, motion, box = np.zeros(4), np.zeros(3), np.zeros(3)
    reach = np.array([limits.largest_mm, limits.steepest * limits.largest_mm])
    features = np.empty((0, 5), np.int32)
    trust, step, size, ceiling, energy = limits.first_mm, 0, UNKNOWN, 0.0, 0.0
    while trust > limits.last_mm and step < (limits.steps if features.shape[0] > MANY else 20 * limits.steps):
        if size < 0:
            if size == LEFT and features.shape[0] < MANY:
                reach *= 2.0
            features, ceiling = features_near(near, pose, reach, active)
            anchor[:], size = pose, features.shape[0]
            every, rows = np.arange(size), np.empty(size, np.int64)
            here, there, programme = new_rows(size), new_rows(size), new_rows(size)
            pose[3] = clearances(near, features, pose, here)
            energy = fibre_load(fibres, pose, load)
            if pose[3] > FAR_MM:
                break
        step += 1
        count = rows_within(here.gaps, every, min(pose[3] + limits.steepest * trust, ceiling), rows)
        loaded_rows(here, rows[:count], pose[3], load, programme)
        box[0], box[1], box[2] = trust, trust, trust / limits.radius_mm
        promise = best_motion(programme.rates, programme.gaps, rows[:count], box, motion)
        if promise < limits.gain_mm:
            trust *= 0.3
            continue
        trial[:3] = pose[:3] + motion
        if sideways_way(trial, anchor, limits.radius_mm) > reach[0]:
            trust, size = (0.5 * trust, size) if pose_is(pose, anchor) else (trust, LEFT)
            continue
        trial[3] = clearances(near, features, trial, there)
        new_energy = fibre_load(fibres, trial, load)
        gain = trial[3] - pose[3] - (new_energy - energy)
        if gain < 0.1 * promise or trial[3] > ceiling:
            trust *= 0.4
            fibre_load(fibres, pose, load)
            continue
        pose[:], energy = trial, new_energy
        here, there = there, here
        if gain > 0.7 * promise:
            trust = min(2.0 * trust, 0.5 * reach[0])
    found[:] = pose
    return step


@compiled
def pose_is(pose: Float, other: Float) -> bool:
    """Whether two poses are the same."""
    return bool(pose[0] == other[0] and pose[1] == other[1] and pose[2] == other[2])
