"""Vectors: lengths, angles, and the smallest turn between two of them."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.directions import angle_deg, orthogonal_part, smallest_turn, unit
from pipeline.geometry.mesh import Float


def directions(count: int) -> list[Float]:
    made = np.random.default_rng(7).normal(size=(count, 3))
    return [unit(one) for one in made]


def test_a_unit_vector_keeps_its_direction() -> None:
    np.testing.assert_allclose(unit(np.array([3.0, 0.0, -4.0])), [0.6, 0.0, -0.8], rtol=0, atol=1e-15)
    with pytest.raises(ValueError, match="without length"):
        unit(np.zeros(3))


def test_the_orthogonal_part_is_orthogonal_and_in_the_plane_of_both() -> None:
    vector, axis = directions(2)
    part = orthogonal_part(vector, axis)
    assert part @ axis == pytest.approx(0.0, abs=1e-15)
    assert np.linalg.norm(part) == pytest.approx(1.0)
    assert part @ np.cross(vector, axis) == pytest.approx(0.0, abs=1e-15)
    assert part @ vector > 0.0
    with pytest.raises(ValueError, match="without length"):
        orthogonal_part(2.0 * axis, axis)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 45.0, 90.0, 179.9999, 180.0])
def test_angles_are_exact_near_both_ends_where_the_arc_cosine_is_not(angle: float) -> None:
    first = np.array([1.0, 0.0, 0.0])
    second = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0])
    assert angle_deg(first, second) == pytest.approx(angle, rel=1e-9, abs=1e-14)


@pytest.mark.parametrize("pair", range(0, 8, 2))
def test_the_smallest_turn_is_the_rotation_about_the_common_normal(pair: int) -> None:
    start, end = directions(8)[pair : pair + 2]
    turn = smallest_turn(start, end)
    np.testing.assert_allclose(turn @ start, end, rtol=0, atol=1e-14)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), rtol=0, atol=1e-14)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    normal = np.cross(start, end)
    np.testing.assert_allclose(turn @ normal, normal, rtol=0, atol=1e-14)
    # a rotation by an angle has the trace 1 + 2 cos(angle)
    assert (np.trace(turn) - 1.0) / 2.0 == pytest.approx(float(start @ end))


def test_no_turn_is_the_identity_and_a_half_turn_is_refused() -> None:
    start = directions(1)[0]
    np.testing.assert_allclose(smallest_turn(start, start), np.eye(3), rtol=0, atol=1e-15)
    with pytest.raises(ValueError, match="opposite directions"):
        smallest_turn(start, -start)
