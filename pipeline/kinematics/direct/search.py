"""The search over the height map: sequential linear programming with a trust region (compiled)."""

from __future__ import annotations

import numpy as np

from pipeline.kinematics.compilation import compiled
from pipeline.kinematics.direct.height_map import Index, gaps_at
from pipeline.kinematics.direct.programme import best_motion
from pipeline.kinematics.direct.settings import SearchLimits
from pipeline.kinematics.direct.surfaces import FAR_MM, Attitude, Float, Rows
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
def rows_within(gaps: Float, among: Index, highest: float, out: Index) -> int:
    """Write the rows whose gap is below a height; how many."""
    count = 0
    for k in among:
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
    heights, samples, fibres = attitude.heights, attitude.samples, attitude.fibres
    count = samples.shape[0]
    every, near, rows = np.arange(count), np.empty(count, np.int64), np.empty(count, np.int64)
    here, there, programme = new_rows(count), new_rows(count), new_rows(count)
    pose, trial, anchor = start.copy(), start.copy(), start.copy()
    load, motion, box = np.zeros(4), np.zeros(3), np.zeros(3)
    pose[3] = gaps_at(heights, samples, every, pose, here)
    energy = fibre_load(fibres, pose, load)
    around = limits.steepest * limits.largest_mm
    near_count = rows_within(here.gaps, every, pose[3] + around, near)
    trust, step = limits.first_mm, 0
    while trust > limits.last_mm and step < limits.steps and pose[3] < FAR_MM:
        step += 1
        row_count = rows_within(here.gaps, near[:near_count], pose[3] + limits.steepest * trust, rows)
        loaded_rows(here, rows[:row_count], pose[3], load, programme)
        box[0], box[1], box[2] = trust, trust, trust / limits.radius_mm
        promise = best_motion(programme.rates, programme.gaps, rows[:row_count], box, motion)
        if promise < limits.gain_mm:
            trust *= 0.3
            continue
        trial[:3] = pose[:3] + motion
        trial[3] = gaps_at(heights, samples, near[:near_count], trial, there)
        if trial[3] > FAR_MM:
            pose[:] = trial
            break
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
        if sideways_way(pose, anchor, limits.radius_mm) > limits.largest_mm:
            pose[3] = gaps_at(heights, samples, every, pose, here)
            near_count = rows_within(here.gaps, every, pose[3] + around, near)
            anchor[:] = pose
    found[:] = pose
    found[3] = gaps_at(heights, samples, every, pose, here)
    return step


@compiled
def sideways_way(pose: Float, other: Float, radius: float) -> float:
    """How far sideways a point of the body gets between two poses, at half as far again as the lever."""
    way: float = max(abs(pose[0] - other[0]), abs(pose[1] - other[1])) + 1.5 * radius * abs(pose[2] - other[2])
    return way
