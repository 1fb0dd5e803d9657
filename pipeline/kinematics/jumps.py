"""Jumps between neighbouring cells: found, solved again from every side, counted.

Roughness of the surfaces makes several maxima of the depth near one another, and a walk may stay in one while the next
cell falls into another. A cell at a jump is solved again from the pose on the other side, and takes the place that
fits its neighbours best for its depth: the deeper one where both are connected, else the connected one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pipeline.kinematics.contact import Pose
from pipeline.kinematics.solvers import Solver
from pipeline.kinematics.sweep import Found, Place, angles_rad, attitude_deg
from pipeline.kinematics.table import Grid

#: Depths nearer than this are equal: less than the facets of the surfaces decide (mm).
EQUAL_MM = 0.01
#: A millimetre of depth is worth so many of distance from the neighbours.
DEPTH_WEIGHT = 20.0
#: Neighbours farther apart than this are not held together any more, mm.
MOST_STRAIN_MM = 3.0
#: Lever that makes a rotation comparable with a shift, mm.
LEVER_MM = 30.0


class JumpLimits(NamedTuple):
    """Neighbours jump where they differ by more than this, in (x, y) or in rotation, beyond what is usual there.

    Usual is the median difference between neighbours along the same line of the table: a joint that turns steeply as it
    opens does not jump.
    """

    shift_mm: float = 0.75
    rotation_deg: float = 3.0


class Jumps(NamedTuple):
    """The jumps of a table.

    Attributes
    ----------
    places : tuple of pairs of (row, column)
    largest_mm, largest_deg : float
        Greatest difference of (x, y) and of rotation between two neighbours, jump or not.
    """

    places: tuple[tuple[Place, Place], ...]
    largest_mm: float
    largest_deg: float


class Again(NamedTuple):
    """A cell to be solved again: its attitude in degrees, the starts, the middle of the bounds."""

    at: Place
    attitude_deg: tuple[float, float]
    starts: tuple[Pose, ...]
    centre: Pose


def jumps(grid: Grid, found: Mapping[Place, Found], limits: JumpLimits) -> Jumps:
    """Every pair of usable neighbours, along flexion or varus, that differ by more than the limits."""
    places, largest = list[tuple[Place, Place]](), (0.0, 0.0)
    for line in _lines(grid):
        pairs = [pair for pair in pairwise(line) if _usable(found, pair[0]) and _usable(found, pair[1])]
        if not pairs:
            continue
        apart = np.array([_apart(found[a].stable.pose, found[b].stable.pose) for a, b in pairs])
        beyond = apart - np.median(apart, axis=0) > [limits.shift_mm, limits.rotation_deg]
        places += [pair for pair, jump in zip(pairs, beyond.any(axis=1), strict=True) if jump]
        largest = max(largest[0], float(apart[:, 0].max())), max(largest[1], float(apart[:, 1].max()))
    return Jumps(tuple(places), *largest)


def _lines(grid: Grid) -> Iterator[list[Place]]:
    """Every column of the table, then every row."""
    rows, columns = grid.shape
    yield from ([(row, column) for row in range(rows)] for column in range(columns))
    yield from ([(row, column) for column in range(columns)] for row in range(rows))


def _usable(found: Mapping[Place, Found], at: Place) -> bool:
    return at in found and found[at].stable.status.usable


def _apart(a: Pose, b: Pose) -> tuple[float, float]:
    return float(np.hypot(a.x - b.x, a.y - b.y)), float(np.degrees(abs(a.theta - b.theta)))


def to_solve_again(grid: Grid, found: Mapping[Place, Found], limits: JumpLimits, centre: Pose) -> list[Again]:
    """The cells at jumps, each to be started from the poses on the other side."""
    across: dict[Place, list[Pose]] = {}
    for a, b in jumps(grid, found, limits).places:
        across.setdefault(a, []).append(found[b].stable.pose)
        across.setdefault(b, []).append(found[a].stable.pose)
    return [Again(at, attitude_deg(grid, at), tuple(across[at]), centre) for at in sorted(across)]


def solve_again(solver: Solver, again: Again) -> list[Found]:
    """Where the other starts lead."""
    attitude = solver.at(angles_rad(again.attitude_deg))
    found = [Found(start, attitude.solve(start, again.centre)) for start in again.starts]
    return [one for one in found if one.stable.status.usable]


def mended(
    found: Mapping[Place, Found],
    cells_at_jumps: Callable[[Mapping[Place, Found]], list[Again]],
    solve: Callable[[list[Again]], list[list[Found]]],
    rounds: int,
) -> dict[Place, Found]:
    """The cells after so many rounds of solving again, or fewer where nothing changes any more.

    Cells choose one after the other, each knowing what those before it chose, so that two neighbours do not change
    sides at once.
    """
    now = dict(found)
    for _ in range(rounds):
        work, changed = cells_at_jumps(now), False
        for again, candidates in zip(work, solve(work), strict=True):
            costs = [_cost(now, again.at, one.stable.pose) for one in (now[again.at], *candidates)]
            best = (now[again.at], *candidates)[int(np.argmin(costs))]
            changed = changed or best != now[again.at]
            now[again.at] = best
        if not changed:
            break
    return now


def _cost(found: Mapping[Place, Found], at: Place, pose: Pose) -> float:
    """How badly a pose fits its neighbours, less its depth; mm. Beyond a jump, farther is no worse."""
    around = [(at[0] + 1, at[1]), (at[0] - 1, at[1]), (at[0], at[1] + 1), (at[0], at[1] - 1)]
    apart = [_strain(pose, found[other].stable.pose) for other in around if _usable(found, other)]
    return sum(min(one, MOST_STRAIN_MM) for one in apart) - DEPTH_WEIGHT * pose.z


def _strain(a: Pose, b: Pose) -> float:
    return float(np.hypot(a.x - b.x, a.y - b.y)) + LEVER_MM * abs(a.theta - b.theta)
