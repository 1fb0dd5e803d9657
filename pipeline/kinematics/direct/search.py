"""The search over the height map: sequential linear programming with a trust region (compiled)."""

from __future__ import annotations

import numpy as np

from pipeline.kinematics.compilation import compiled
from pipeline.kinematics.direct.height_map import depth_over, gaps_at
from pipeline.kinematics.direct.programme import Index, best_motion
from pipeline.kinematics.direct.settings import SearchLimits
from pipeline.kinematics.direct.surfaces import FAR_MM, Attitude, Bins, Float, Rows
from pipeline.kinematics.ligaments import LEAST_PUSH, Fibres


@compiled
def fibre_load(fibres: Fibres, pose: Float, load: Float) -> float:
    """Elastic energy of the taut fibres at (x, y, theta, z) over the push (mm), and its slope in these, written.

    The same as :func:`pipeline.kinematics.ligaments.fibre_load`.
    """
    energy = 0.0
    load[:] = 0.0
    c, s = np.cos(pose[2]), np.sin(pose[2])
    for k in range(fibres.slack_mm.shape[0]):
        rx = c * fibres.on_moving[k, 0] - s * fibres.on_moving[k, 1]
        ry = s * fibres.on_moving[k, 0] + c * fibres.on_moving[k, 1]
        dx = rx + pose[0] - fibres.on_reference[k, 0]
        dy = ry + pose[1] - fibres.on_reference[k, 1]
        dz = fibres.on_moving[k, 2] + pose[3] - fibres.on_reference[k, 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        stretch = length - fibres.slack_mm[k]
        if stretch > 0.0:
            pull = fibres.stiffness[k] * stretch
            energy += 0.5 * pull * stretch
            pull /= length
            load[0] += pull * dx
            load[1] += pull * dy
            load[2] += pull * (dy * rx - dx * ry)
            load[3] += pull * dz
    return energy


@compiled
def rows_within(gaps: Float, highest: float, out: Index) -> int:
    """Write the rows whose gap is below a height; how many."""
    count = 0
    for k in range(gaps.shape[0]):
        if gaps[k] < highest:
            out[count] = k
            count += 1
    return count


@compiled
def loaded_rows(found: Rows, rows: Index, least: float, load: Float, out: Rows) -> None:
    """Rows of the linear programme: gaps above the least, and rates tilted by what the fibres pull."""
    push = max(1.0 - load[3], LEAST_PUSH)
    for k in rows:
        out.gaps[k] = push * (found.gaps[k] - least)
        for j in range(3):
            out.rates[k, j] = push * found.rates[k, j] - load[j]


@compiled
def new_rows(count: int) -> Rows:
    """Rows to be written."""
    return Rows(np.empty(count), np.zeros((count, 3)), np.empty((count, 2)))


@compiled
def search(attitude: Attitude, start: Float, limits: SearchLimits, found: Float) -> int:
    """Climb from (x, y, theta, z) to a maximum of depth minus fibre energy over the height map.

    Parameters
    ----------
    attitude : Attitude
    start : (4,) float64
        The last is not looked at.
    limits : SearchLimits
    found : (4,) float64
        Written: x, y (mm), theta (rad) and the depth z (mm), ``NOTHING_MM`` where the body has left the reference.

    Returns
    -------
    int
        Linear programmes solved; ``limits.steps`` where they ran out, 0 where nothing is above the body at the start.
    """
    heights, samples, fibres, lever = attitude.heights, attitude.samples, attitude.fibres, farthest(attitude.bins)
    gaps, close = np.empty(samples.shape[0]), np.empty_like(samples)
    rows, here, there, programme = np.empty(0, np.int64), new_rows(0), new_rows(0), new_rows(0)
    pose, trial, anchor = start.copy(), start.copy(), start.copy()
    load, motion, box = np.zeros(4), np.zeros(3), np.zeros(3)
    trust, step, count, energy = limits.first_mm, 0, 0, 0.0
    around, sure, look = limits.steepest * limits.largest_mm, -np.inf, True
    while True:
        if look or trust <= limits.last_mm:
            pose[3] = depth_over(heights, samples, pose, gaps)
            energy = fibre_load(fibres, pose, load)
            if pose[3] - energy < sure:
                # a wall came up from out of sight: back to where all was seen, and look farther
                pose[:], around, trust = anchor, 2.0 * around, 0.5 * limits.first_mm
                depth_over(heights, samples, pose, gaps)
                energy = fibre_load(fibres, pose, load)
            elif trust <= limits.last_mm:
                break
            count = samples_below(samples, gaps, pose[3] + around, close)
            here, there, programme, rows = new_rows(count), new_rows(count), new_rows(count), np.empty(count, np.int64)
            gaps_at(heights, close[:count], pose, here)
            anchor[:], sure, look = pose, pose[3] - energy, False
        if step >= limits.steps or pose[3] > FAR_MM:
            break
        step += 1
        row_count = rows_within(here.gaps, pose[3] + limits.steepest * trust, rows)
        loaded_rows(here, rows[:row_count], pose[3], load, programme)
        box[0], box[1], box[2] = trust, trust, trust / limits.radius_mm
        promise = best_motion(programme.rates, programme.gaps, rows[:row_count], box, motion)
        if promise < limits.gain_mm:
            trust *= 0.3
            continue
        trial[:3] = pose[:3] + motion
        trial[3] = gaps_at(heights, close[:count], trial, there)
        new_energy = fibre_load(fibres, trial, load)
        gain = trial[3] - pose[3] - (new_energy - energy)
        if gain < 0.1 * promise:
            trust *= 0.4
            fibre_load(fibres, pose, load)
            continue
        pose[:], energy = trial, new_energy
        here, there = there, here
        if gain > 0.7 * promise:
            trust = min(2.0 * trust, limits.largest_mm)
        look = sideways_way(pose, anchor, lever) > limits.largest_mm or pose[3] > FAR_MM
    found[:] = pose
    return step


@compiled
def samples_below(samples: Float, gaps: Float, highest: float, out: Float) -> int:
    """Write the samples whose gap is below a height; how many."""
    count = 0
    for k in range(samples.shape[0]):
        if gaps[k] < highest:
            out[count, 0], out[count, 1], out[count, 2] = samples[k, 0], samples[k, 1], samples[k, 2]
            count += 1
    return count


@compiled
def sideways_way(pose: Float, other: Float, lever: float) -> float:
    """How far sideways a point of the body gets between two poses, at most."""
    way: float = max(abs(pose[0] - other[0]), abs(pose[1] - other[1])) + lever * abs(pose[2] - other[2])
    return way


@compiled
def farthest(bins: Bins) -> float:
    """How far from its origin any point of the moving body that faces along delta lies, in (x, y); at most."""
    rows, columns = bins.cover.shape[:2]
    x = max(-bins.x0, bins.x0 + columns * bins.size)
    y = max(-bins.y0, bins.y0 + rows * bins.size)
    lever: float = np.sqrt(x * x + y * y)
    return lever
