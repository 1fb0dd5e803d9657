"""Jumps between neighbours: what counts as one, and which side a cell takes."""

from __future__ import annotations

import numpy as np

from pipeline.kinematics.contact import Pose
from pipeline.kinematics.incremental import StablePose
from pipeline.kinematics.jumps import Again, JumpLimits, jumps, mended, solve_again, to_solve_again
from pipeline.kinematics.sweep import Found, Place
from pipeline.kinematics.table import Grid, Status

GRID = Grid(np.arange(6.0), np.array([-1.0, 0.0, 1.0]))
LIMITS = JumpLimits(1.0, 3.0)
CENTRE = Pose(0.0, 0.0, 0.0, 0.0)


def found(x: float, z: float = 0.0, theta_deg: float = 0.0, status: Status = Status.OK) -> Found:
    return Found(CENTRE, StablePose(Pose(x, 0.0, z, float(np.radians(theta_deg))), status, 1, 0))


def table(step_mm: float = 0.1, step_deg: float = 0.5) -> dict[Place, Found]:
    """Poses that change evenly along flexion."""
    return {(r, c): found(step_mm * r, theta_deg=step_deg * r) for r in range(6) for c in range(3)}


def test_a_step_is_found_and_an_even_slope_is_none() -> None:
    assert jumps(GRID, table(), LIMITS).places == ()
    assert jumps(GRID, table(step_mm=3.0, step_deg=8.0), LIMITS).places == ()
    shifted = table() | {(r, 1): found(0.1 * r + 2.0) for r in range(3, 6)}
    places = jumps(GRID, shifted, LIMITS).places
    assert ((2, 1), (3, 1)) in places
    assert ((3, 1), (4, 1)) not in places


def test_a_turn_jumps_as_a_shift_does_and_the_largest_is_told() -> None:
    turned = table(0.0, 0.0) | {(3, 1): found(0.0, theta_deg=9.0)}
    found_jumps = jumps(GRID, turned, LIMITS)
    assert {place for pair in found_jumps.places for place in pair} >= {(2, 1), (3, 1), (4, 1)}
    assert np.isclose(found_jumps.largest_deg, 9.0)
    assert found_jumps.largest_mm == 0.0


def test_failed_cells_have_no_jumps() -> None:
    broken = table() | {(3, 1): found(50.0, status=Status.SLID_OFF)}
    assert jumps(GRID, broken, LIMITS).places == ()


def test_cells_at_jumps_start_from_the_other_side() -> None:
    odd = table() | {(3, 1): found(5.0)}
    work = {again.at: again for again in to_solve_again(GRID, odd, LIMITS, CENTRE)}
    assert {start.x for start in work[(2, 1)].starts} == {5.0}
    assert len(work[(3, 1)].starts) == 2  # along flexion: three columns are too few to say what is usual across
    assert work[(3, 1)].attitude_deg == (3.0, 0.0)


class Stuck:
    """An attitude at which a body stays where it is let go, except where nothing holds it."""

    def at(self, angles_rad: tuple[float, float]) -> Stuck:
        return self

    def solve(self, start: Pose, centre: Pose) -> StablePose:
        return StablePose(start, Status.SLID_OFF if start.x > 100.0 else Status.OK, 1, 0)


def test_only_poses_that_hold_are_offered() -> None:
    starts = (Pose(1.0, 0.0, 0.0, 0.0), Pose(101.0, 0.0, 0.0, 0.0))
    offered = solve_again(Stuck(), Again((0, 0), (0.0, 0.0), starts, CENTRE))  # type: ignore[arg-type]
    assert [one.stable.pose.x for one in offered] == [1.0]


def mend(cells: dict[Place, Found], candidate: Found, rounds: int = 3) -> dict[Place, Found]:
    def solve(work: list[Again]) -> list[list[Found]]:
        return [[candidate] if again.at == (3, 1) else [] for again in work]

    return mended(cells, lambda now: to_solve_again(GRID, now, LIMITS, CENTRE), solve, rounds)


def test_a_cell_that_stands_apart_joins_its_neighbours() -> None:
    odd = table() | {(3, 1): found(5.0, z=0.02)}
    assert mend(odd, found(0.3))[(3, 1)].stable.pose.x == 0.3


def test_a_far_deeper_place_is_kept() -> None:
    odd = table() | {(3, 1): found(5.0, z=2.0)}
    assert mend(odd, found(0.3))[(3, 1)].stable.pose.x == 5.0


def test_no_round_changes_nothing() -> None:
    odd = table() | {(3, 1): found(5.0)}
    assert mend(odd, found(0.3), rounds=0) == odd
