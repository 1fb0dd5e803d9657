"""A sample of cells solved once more by the other solver, from the same start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pipeline.kinematics.contact import Pose
from pipeline.kinematics.incremental import StablePose
from pipeline.kinematics.jumps import EQUAL_MM
from pipeline.kinematics.solvers import Solver
from pipeline.kinematics.sweep import Found, Place, angles_rad, attitude_deg
from pipeline.kinematics.table import Grid


class Recheck(NamedTuple):
    """A cell to be solved by the other solver: attitude in degrees, start, middle of the bounds."""

    at: Place
    attitude_deg: tuple[float, float]
    start: Pose
    centre: Pose


class Differences(NamedTuple):
    """The two solvers against one another, over the cells that both found.

    Attributes
    ----------
    shift_mm, rotation_deg : (K,) float64
        Difference of (x, y) and of rotation.
    deeper_mm : (K,) float64
        How much farther along delta the table's solver came.
    unsolved : int
        Cells in which the other solver found no stable pose.
    """

    shift_mm: np.ndarray[tuple[int], np.dtype[np.float64]]
    rotation_deg: np.ndarray[tuple[int], np.dtype[np.float64]]
    deeper_mm: np.ndarray[tuple[int], np.dtype[np.float64]]
    unsolved: int


def rechecks(grid: Grid, found: Mapping[Place, Found], fraction: float, centre: Pose) -> list[Recheck]:
    """Every n-th usable cell, so that a fraction of all is taken, evenly over the table."""
    usable = sorted(at for at, one in found.items() if one.stable.status.usable)
    count = round(fraction * len(usable))
    picked = np.unique(np.linspace(0, len(usable) - 1, count).round().astype(np.int64))
    return [Recheck(usable[k], attitude_deg(grid, usable[k]), found[usable[k]].start, centre) for k in picked]


def solve_recheck(solver: Solver, recheck: Recheck) -> StablePose:
    """What another solver finds from the same start."""
    return solver.at(angles_rad(recheck.attitude_deg)).solve(recheck.start, recheck.centre)


def differences(found: Mapping[Place, Found], asked: Sequence[Recheck], answers: Sequence[StablePose]) -> Differences:
    """What the answers of the other solver differ by."""
    rows = [
        np.subtract(found[one.at].stable.pose, other.pose)
        for one, other in zip(asked, answers, strict=True)
        if other.status.usable
    ]
    away = np.array(rows).reshape(-1, 4)
    return Differences(
        np.hypot(away[:, 0], away[:, 1]), np.degrees(np.abs(away[:, 3])), away[:, 2], len(asked) - len(rows)
    )


def agreeing(different: Differences, shift_mm: float, rotation_deg: float) -> int:
    """How many cells agree within the resolutions."""
    return int(((different.shift_mm <= shift_mm) & (different.rotation_deg <= rotation_deg)).sum())


def shallower(different: Differences) -> int:
    """In how many cells the table's solver stopped shallower than the other."""
    return int((different.deeper_mm < -EQUAL_MM).sum())
