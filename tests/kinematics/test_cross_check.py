"""The sample that the other solver solves, and what its answers are counted as."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.kinematics.contact import Pose
from pipeline.kinematics.cross_check import agreeing, differences, rechecks, shallower, solve_recheck
from pipeline.kinematics.incremental import StablePose
from pipeline.kinematics.sweep import Found, Place
from pipeline.kinematics.table import Grid, Status
from tests.kinematics.hollow_joint import PLACE_MM, REST_MM, incremental

GRID = Grid(np.arange(10.0), np.arange(4.0))
CENTRE = Pose(0.0, 0.0, 0.0, 0.0)


def stable(x: float, z: float = 0.0, theta: float = 0.0, status: Status = Status.OK) -> StablePose:
    return StablePose(Pose(x, 0.0, z, theta), status, 1, 0)


TABLE: dict[Place, Found] = {(r, c): Found(Pose(0.0, 0.0, -1.0, 0.0), stable(0.0)) for r in range(10) for c in range(4)}


@pytest.mark.parametrize(("fraction", "count"), [(0.0, 0), (0.05, 2), (0.5, 20), (1.0, 40)])
def test_a_fraction_of_the_cells_is_taken_evenly(fraction: float, count: int) -> None:
    asked = rechecks(GRID, TABLE, fraction, CENTRE)
    assert len(asked) == count
    if count > 1:
        assert (asked[0].at, asked[-1].at) == ((0, 0), (9, 3))
        assert asked[0].start.z == -1.0


def test_failed_cells_are_not_asked() -> None:
    failed = {at: Found(CENTRE, stable(0.0, status=Status.SLID_OFF)) for at in TABLE}
    assert rechecks(GRID, failed, 1.0, CENTRE) == []


def test_differences_and_what_they_count_as() -> None:
    asked = rechecks(GRID, TABLE, 0.1, CENTRE)
    answers = [stable(0.05), stable(0.3, z=0.02), stable(0.0, z=-0.5, theta=0.1), stable(0.0, status=Status.NO_CONTACT)]
    found = differences(TABLE, asked, answers)
    np.testing.assert_allclose(found.shift_mm, [0.05, 0.3, 0.0])
    np.testing.assert_allclose(found.deeper_mm, [0.0, -0.02, 0.5])
    assert agreeing(found, 0.1, 0.1) == 1
    assert shallower(found) == 1
    assert found.unsolved == 1


def test_the_other_solver_finds_the_pose_of_a_known_joint() -> None:
    (asked, *_) = rechecks(
        GRID, {(0, 0): Found(Pose(0.5, 0.0, 0.0, 0.0), stable(0.0))}, 1.0, Pose(0.0, 0.0, REST_MM, 0.0)
    )
    answer = solve_recheck(incremental(), asked)
    assert answer.status is Status.OK
    assert np.hypot(answer.pose.x, answer.pose.y) < PLACE_MM
