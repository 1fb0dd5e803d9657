"""Neutral varus on two balls in two dishes, where it is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.validation_objects import ball, dish
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.direct.prepare import prepare
from pipeline.kinematics.direct.solver import DirectSolver
from pipeline.kinematics.neutral import NOT_FOUND, Bracket, Compartments, brackets, neutral_curve, neutral_pose
from pipeline.kinematics.table import Grid, PoseTable, RawTable, Status
from tests.kinematics.shapes import joined, shifted, turned_down

HALF_MM = 20.0
CENTRE = Pose(0.0, 0.0, -4.0, 0.0)


def joint(raised_mm: float) -> Compartments:
    """Two balls under two dishes; the lateral ball stands this much higher than the medial one."""
    hollow, sphere = turned_down(dish(8.0, sectors=16)), turned_down(ball(4.0, sectors=16))
    above = joined(shifted(hollow, -HALF_MM), shifted(hollow, HALF_MM))
    medial, lateral = shifted(sphere, -HALF_MM), shifted(sphere, HALF_MM, z=raised_mm)

    def solver(moving: TriangleMesh) -> DirectSolver:
        return DirectSolver(prepare(above, moving))

    return Compartments(solver(joined(medial, lateral)), solver(medial), solver(lateral))


@pytest.mark.parametrize("raised_mm", [0.0, 0.7, -0.7])
def test_varus_levels_both_compartments(raised_mm: float) -> None:
    """Both balls sit in their dishes when the line through them is level with that of the dishes.

    The tilt that brings a ball raised by d to the level of another 2 a away is that slope; positive varus lowers the
    lateral side of the moving body.
    """
    whole = joint(raised_mm)
    start = whole.whole.at((0.0, 0.0)).solve(CENTRE, CENTRE).pose
    found = neutral_pose(whole, Bracket(0.0, (-4.0, 4.0), (start, start), CENTRE))
    assert found.status is Status.OK
    assert abs(found.uneven_mm) <= 0.01
    assert abs(found.varus_deg) == pytest.approx(np.degrees(np.arctan2(abs(raised_mm), 2.0 * HALF_MM)), abs=0.1)
    assert np.sign(np.round(found.varus_deg, 1)) == np.sign(raised_mm)


def test_without_a_change_of_sides_there_is_none() -> None:
    assert neutral_pose(joint(0.0), None) == NOT_FOUND


def raw(medial: list[float], lateral: list[float]) -> RawTable:
    grid = Grid(np.array([0.0]), np.array([-2.0, 0.0, 2.0]))
    zeros = np.zeros(grid.shape)
    poses = PoseTable(*5 * (zeros,), zeros, np.array([medial]), np.array([lateral]), zeros)  # type: ignore[arg-type]
    poses = replace(poses, status=np.zeros(grid.shape, dtype=np.uint8), equilibrium_residual=zeros)
    return RawTable(grid, poses, zeros.astype(np.int32), *7 * (zeros,))


def test_brackets_are_where_the_open_side_changes() -> None:
    (bracket,) = brackets(raw([2.0, 1.0, 0.0], [0.0, 0.0, 1.0]), 0.0, CENTRE)
    assert bracket is not None
    assert bracket.varus_deg == (0.0, 2.0)
    assert brackets(raw([0.0, 0.0, 0.0], [1.0, 2.0, 3.0]), 0.0, CENTRE) == (None,)


def test_a_curve_holds_what_was_found_and_nan_elsewhere() -> None:
    curve = neutral_curve(np.array([0.0, 5.0]), (NOT_FOUND, NOT_FOUND._replace(varus_deg=1.5, status=Status.OK)))
    assert np.isnan(curve.varus_deg[0])
    assert curve.varus_deg[1] == 1.5
    np.testing.assert_array_equal(curve.status, [Status.NO_CONTACT, Status.OK])
