"""The flexion axis of femurs whose condyles are known spheres."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.condyles import CondyleAxis, condyle_axis, fit_sphere
from pipeline.geometry.directions import angle_deg, unit
from pipeline.geometry.mesh import Float, TriangleMesh, merged, transformed, vertex_normals
from pipeline.geometry.validation_objects import box
from tests.geometry.knees import MIRROR, about, sphere, sphere_femur

MEDIAL, LATERAL = (-23.0, 0.0, -0.5), (23.0, 1.5, 1.0)
TRUE_AXIS = unit(np.subtract(LATERAL, MEDIAL))
SQUARE = np.eye(3)


@pytest.fixture(scope="module")
def femur() -> TriangleMesh:
    return sphere_femur(MEDIAL, LATERAL)


def test_the_spheres_of_both_condyles_are_found(femur: TriangleMesh) -> None:
    found = condyle_axis(femur, SQUARE)
    np.testing.assert_allclose(found.medial.centre, MEDIAL, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.lateral.centre, LATERAL, rtol=0, atol=1e-6)
    assert (found.medial.radius, found.lateral.radius) == pytest.approx((21.0, 19.0), abs=1e-6)
    assert angle_deg(found.direction, TRUE_AXIS) < 1e-4
    assert found.medial.rms < 1e-6
    assert 0.0 <= found.uncertainty_deg < 1e-4


@pytest.mark.parametrize("off", [(20.0, 0, 0), (-20.0, 0, 0), (0, 20.0, 0), (0, -20.0, 0), (0, 0, 20.0), (0, 0, -20.0)])
def test_rough_axes_off_by_20_degrees_give_the_same(femur: TriangleMesh, off: tuple[float, float, float]) -> None:
    found = condyle_axis(femur, about(*off))
    np.testing.assert_allclose(found.medial.centre, MEDIAL, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.lateral.centre, LATERAL, rtol=0, atol=1e-6)


@pytest.mark.parametrize("off_deg", [20.0, -20.0])
def test_on_condyles_that_are_no_spheres_the_patches_settle_on_the_axis(off_deg: float) -> None:
    oblong = sphere_femur(MEDIAL, LATERAL, 1.15)
    straight, turned = condyle_axis(oblong, SQUARE), condyle_axis(oblong, about(0.0, 0.0, off_deg))
    assert angle_deg(straight.direction, turned.direction) < 0.01


def test_a_mirrored_femur_has_the_mirrored_axis(femur: TriangleMesh) -> None:
    right = condyle_axis(femur, SQUARE)
    left = condyle_axis(transformed(femur, MIRROR), SQUARE * [-1.0, 1.0, 1.0])
    for here, there in ((right.medial.centre, left.medial.centre), (right.direction, left.direction)):
        np.testing.assert_allclose(there, here * [-1.0, 1.0, 1.0], rtol=0, atol=1e-10)


def test_a_moved_femur_has_the_moved_axis(femur: TriangleMesh) -> None:
    turn, shift = about(30.0, -50.0, 110.0), np.array([100.0, -200.0, 300.0])
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, shift
    found = condyle_axis(transformed(femur, motion), SQUARE @ turn.T)
    np.testing.assert_allclose(found.medial.centre, turn @ np.array(MEDIAL) + shift, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.direction, turn @ TRUE_AXIS, rtol=0, atol=1e-8)


def test_the_spread_grows_as_a_condyle_departs_from_a_sphere() -> None:
    spread = [condyle_axis(sphere_femur(MEDIAL, LATERAL, stretch), SQUARE).uncertainty_deg for stretch in (1.05, 1.15)]
    assert 0.02 < spread[0] < spread[1]


def test_a_tenth_of_a_millimetre_of_unevenness_costs_half_a_degree(femur: TriangleMesh) -> None:
    off = np.array([_errors(condyle_axis(_uneven(femur, seed), SQUARE)) for seed in range(8)])
    medial_mm, lateral_mm, axis_deg = np.median(off, axis=0)
    assert max(medial_mm, lateral_mm) < 0.7
    assert 0.2 < axis_deg < 0.9


def _uneven(mesh: TriangleMesh, seed: int) -> TriangleMesh:
    """Waves of 10 mm and more, 0.15 mm RMS, along the normals."""
    waves_per_mm = np.random.default_rng(seed).normal(scale=0.4, size=(3, 8))
    heights = 0.15 * np.sqrt(2.0 / 8.0) * np.cos(mesh.points @ waves_per_mm + np.arange(8.0)).sum(axis=1)
    return TriangleMesh(mesh.points + heights[:, None] * vertex_normals(mesh), mesh.triangles)


def _errors(found: CondyleAxis) -> tuple[float, float, float]:
    medial, lateral = np.subtract(found.medial.centre, MEDIAL), np.subtract(found.lateral.centre, LATERAL)
    return float(np.linalg.norm(medial)), float(np.linalg.norm(lateral)), angle_deg(found.direction, TRUE_AXIS)


def test_a_femur_with_one_condyle_is_refused() -> None:
    one = merged([sphere(21.0, MEDIAL), box((10.0, 40.0), (-15.0, 15.0), (-10.0, 20.0))])
    with pytest.raises(ValueError, match="no posterior condyle was found on one side"):
        condyle_axis(one, SQUARE)


def test_a_slice_of_a_femur_is_refused() -> None:
    with pytest.raises(ValueError, match="too short to show its condyles"):
        condyle_axis(box((-40.0, 40.0), (-20.0, 20.0), (0.0, 5.0)), SQUARE)


def cap(count: int) -> Float:
    """Points on a quarter of the sphere of 20 mm about (5, -3, 2)."""
    random = np.random.default_rng(0)
    z, turn = random.uniform(0.0, 1.0, count), random.uniform(0.0, np.pi, count)
    across = np.sqrt(1.0 - z**2)
    return np.column_stack([across * np.cos(turn), across * np.sin(turn), z]) * 20.0 + [5.0, -3.0, 2.0]


def test_a_sphere_is_fitted_exactly_from_a_part_of_it() -> None:
    found = fit_sphere(cap(50))
    np.testing.assert_allclose(found.centre, [5.0, -3.0, 2.0], rtol=0, atol=1e-10)
    assert found.radius == pytest.approx(20.0)
    assert found.rms < 1e-10


def test_an_osteophyte_does_not_pull_the_sphere() -> None:
    points = cap(200)
    points[:20] += [0.0, 0.0, 6.0]
    found = fit_sphere(points)
    np.testing.assert_allclose(found.centre, [5.0, -3.0, 2.0], rtol=0, atol=1e-3)


def test_seven_points_are_too_few_for_a_sphere() -> None:
    with pytest.raises(ValueError, match="at least 8 points, got 7"):
        fit_sphere(cap(7))
