"""The last steps on the exact triangles, and exact depths (compiled)."""

from __future__ import annotations

import numpy as np

from pipeline.kinematics.compilation import compiled
from pipeline.kinematics.direct.features import near_pairs, rows_of, triangles_over
from pipeline.kinematics.direct.height_map import depth_over
from pipeline.kinematics.direct.programme import best_motion
from pipeline.kinematics.direct.search import farthest, fibre_load, loaded_rows, new_rows, rows_within, sideways_way
from pipeline.kinematics.direct.settings import SearchLimits
from pipeline.kinematics.direct.surfaces import (
    FAR_MM,
    NOTHING_MM,
    Attitude,
    Flags,
    Float,
    Int,
    Rows,
)

#: Heights this near are the same, mm.
ROUNDING_MM = 1e-9
#: Features are wanted that lie up to so far above the depth (mm): those that the next step may meet.
ABOVE_MM = 0.03
#: A promise of less than this times the trust region is none.
FLAT = 5e-4
#: Farther than this from where cells were chosen, they are chosen anew, mm.
AWAY_MM = 0.5
#: Where nothing is found, the search for features goes up by so much first.
FIRST_RISE_MM = 0.1


@compiled
def cells_near(attitude: Attitude, pose: Float, slack: float) -> Flags:
    """Cells of the moving body where contact is possible, and the eight around each.

    By the height map: a sample of the cell comes within a slack of contact. Without a map or a slack that ends, every
    cell.
    """
    rows, columns = attitude.bins.cover.shape[:2]
    if attitude.heights.z.size == 1 or slack > FAR_MM:
        return np.ones((rows, columns), np.bool_)
    samples = attitude.samples
    gaps, active = np.empty(samples.shape[0]), np.zeros((rows, columns), np.bool_)
    least = depth_over(attitude.heights, samples, pose, gaps)
    for k in range(samples.shape[0]):
        if gaps[k] < least + slack:
            row, column = divmod(attitude.sample_cells[k], columns)
            for j in range(max(row - 1, 0), min(row + 2, rows)):
                for i in range(max(column - 1, 0), min(column + 2, columns)):
                    active[j, i] = True
    return active


@compiled
def rows_near(attitude: Attitude, active: Flags, among: Int, pose: Float, above: float) -> Rows:
    """Every feature that is there at a pose with a clearance up to so much above the least.

    Parameters
    ----------
    attitude : Attitude
    active : (NY, NX) bool
        Cells that are looked at.
    among : (M,) int32
        Triangles of the reference that are looked at.
    pose : (4,) float64
        x, y (mm), theta (rad), and z where contact is expected; with nothing there the search goes higher.
    above : float
        mm.

    Returns
    -------
    Rows
        None where the bodies never meet along delta; some may lie higher.
    """
    ceiling, more = pose[3] + above, FIRST_RISE_MM
    while True:
        rows = rows_of(attitude, near_pairs(attitude, active, among, pose, ceiling), pose, ceiling)
        least = lowest(rows)
        if least + above <= ceiling + ROUNDING_MM or ceiling > FAR_MM:
            return rows
        more *= 4.0
        ceiling = least + above if least < FAR_MM else ceiling + more


@compiled
def lowest(rows: Rows) -> float:
    """The least clearance: the depth of the body at this pose; ``NOTHING_MM`` where there is none."""
    least = NOTHING_MM
    for gap in rows.gaps:
        least = min(least, gap)
    return least


@compiled
def depth_at(attitude: Attitude, pose: Float) -> float:
    """Exact depth at (x, y, theta, expected z): how far the body goes along delta; ``NOTHING_MM`` where for ever."""
    ceiling, more = pose[3] + ROUNDING_MM, FIRST_RISE_MM
    while True:
        least = lowest(rows_below(attitude, pose, ceiling))
        if least <= ceiling or ceiling > FAR_MM:
            return least
        ceiling, more = ceiling + more, 4.0 * more


@compiled
def rows_below(attitude: Attitude, pose: Float, ceiling: float) -> Rows:
    """Every feature that is there at (x, y, theta) with a clearance up to a ceiling, wherever it lies."""
    every = np.ones(attitude.bins.cover.shape[:2], np.bool_)
    among = triangles_over(attitude, every, pose, ceiling, 0.0)
    return rows_of(attitude, near_pairs(attitude, every, among, pose, ceiling), pose, ceiling)


@compiled
def polish(attitude: Attitude, start: Float, limits: SearchLimits, found: Float) -> int:
    """Climb on the exact triangles from (x, y, theta, expected z); the same steps as ``search``.

    Every trial is held against all features that are there, so a step never rests on what was seen elsewhere.
    """
    fibres, lever = attitude.fibres, farthest(attitude.bins)
    pose, trial, home = start.copy(), start.copy(), start.copy()
    load, motion, energy = np.zeros(4), np.zeros(3), 0.0
    active, here = cells_near(attitude, start, limits.slack_mm), new_rows(0)
    near = triangles_over(attitude, active, start, FAR_MM, AWAY_MM)
    pose[3], trust, promise, step = -np.inf, limits.first_mm, 0.0, 0
    while True:
        if sideways_way(trial, home, lever) > AWAY_MM:
            active, home[:] = cells_near(attitude, trial, limits.slack_mm), trial
            near = triangles_over(attitude, active, trial, FAR_MM, AWAY_MM)
        there = rows_near(attitude, active, near, trial, ABOVE_MM)
        trial[3] = lowest(there)
        new_energy = fibre_load(fibres, trial, load)
        gain = trial[3] - pose[3] - (new_energy - energy)
        if gain < 0.1 * promise:
            trust *= 0.4
            fibre_load(fibres, pose, load)
        else:
            pose[:], energy, here = trial, new_energy, there
            if gain > 0.7 * promise > 0.0:
                trust = min(2.0 * trust, limits.largest_mm)
        promise, trust, step = _promised(here, (pose, load, motion), trust, step, limits)
        if promise == 0.0:
            break
        trial[:3], trial[3] = pose[:3] + motion, pose[3] + promise
    found[:] = pose
    return step


@compiled
def _promised(
    here: Rows, at: tuple[Float, Float, Float], trust: float, step: int, limits: SearchLimits
) -> tuple[float, float, int]:
    """Write the best motion from a pose under a load in the widest box that promises a gain.

    Returns
    -------
    promise, trust : float
        The gain, 0 where even the smallest box promises none; the half width of the box.
    step : int
        Linear programmes solved so far.
    """
    pose, load, motion = at
    size, box = len(here.gaps), np.empty(3)
    rows, programme = np.empty(size, np.int64), new_rows(size)
    while trust > limits.last_mm and step < limits.steps and pose[3] < FAR_MM:
        step += 1
        count = rows_within(here.gaps, pose[3] + limits.steepest * trust, rows)
        loaded_rows(here, rows[:count], pose[3], load, programme)
        box[0], box[1], box[2] = trust, trust, trust / limits.radius_mm
        promise = best_motion(programme.rates, programme.gaps, rows[:count], box, motion)
        if promise >= max(limits.gain_mm, FLAT * trust):
            return promise, trust, step
        trust *= 0.3
    return 0.0, trust, step
