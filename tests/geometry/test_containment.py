"""Inside and outside of closed meshes."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.containment import contains, nested, winding_number
from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.validation_objects import BarOnPyramids, ball, box, dish
from tests.kinematics.shapes import joined, shifted

CUBE = box((-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0))


def test_box_against_its_inequalities() -> None:
    points = np.random.default_rng(1).uniform(-2, 2, (400, 3))
    np.testing.assert_array_equal(contains(CUBE, points), np.all(np.abs(points) < 1.0, axis=1))


def test_dish_against_its_equations() -> None:
    points = np.random.default_rng(2).uniform([-14, -14, -4], [14, 14, 8], (60, 3))
    solid, radius, rim = dish(12.0), 12.0, 12.0 * np.sin(0.9)
    across, z = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
    top = 12.0 * (1.0 - np.cos(0.9))
    outside_hollow = np.hypot(across, z - radius) > radius
    expected = (across < rim + 3.0) & (z > -3.0) & (z < top) & (outside_hollow | (across > rim))
    clear = np.abs(np.hypot(across, z - radius) - radius) > 0.1
    np.testing.assert_array_equal(contains(solid, points)[clear], expected[clear])


def test_winding_number_is_whole_and_turns_with_the_surface() -> None:
    points = np.array([[0.1, 0.2, 0.3], [5.0, 0.0, 0.0]])
    np.testing.assert_allclose(winding_number(points, CUBE), [1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(
        winding_number(points, TriangleMesh(CUBE.points, CUBE.triangles[:, ::-1])), [-1.0, 0.0], atol=1e-12
    )
    np.testing.assert_allclose(winding_number(points, joined(CUBE, CUBE)), [2.0, 0.0], atol=1e-12)


def test_many_points_are_taken_in_blocks() -> None:
    points = np.random.default_rng(3).uniform(-2, 2, (120, 3))
    whole = contains(ball(1.5), points)
    np.testing.assert_array_equal(whole, np.concatenate([contains(ball(1.5), point[None]) for point in points]))
    assert contains(CUBE, np.empty((0, 3))).shape == (0,)


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        (ball(2.0), box((-9.0, 9.0), (-9.0, 9.0), (-9.0, 9.0)), True),
        (CUBE, shifted(CUBE, 5.0), False),
        (joined(shifted(CUBE, 30.0), shifted(CUBE, 0.0)), ball(4.0), True),
        (ball(4.0), joined(shifted(CUBE, -30.0), shifted(CUBE, 9.0)), False),
    ],
)
def test_nested_bodies_either_way_round(first: TriangleMesh, second: TriangleMesh, *, expected: bool) -> None:
    assert nested(first, second) is expected
    assert nested(second, first) is expected


def test_unused_vertices_do_not_count() -> None:
    stray = TriangleMesh(np.vstack([[0.0, 0.0, 0.0], CUBE.points + 9.0]), CUBE.triangles + 1)
    assert not nested(stray, CUBE)


def test_a_body_in_a_hollow_is_not_inside() -> None:
    assert not nested(dish(12.0), shifted(ball(6.0), z=6.5))
    scan = BarOnPyramids().pair()
    assert not nested(joined(*scan.reference.values()), scan.moving["bar"])
