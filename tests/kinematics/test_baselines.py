"""The hinge and Walker's curves: the published numbers, and contact against closed forms."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.kinematics.baselines import (
    WALKER_RANGE_DEG,
    Baseline,
    hinge,
    probes,
    walker,
    walker_motion,
)
from pipeline.kinematics.joint_coordinates import JointCoordinates, reference_from_moving, rigid, rotation_x
from pipeline.kinematics.smoothing import Probe, way_to_contact
from pipeline.kinematics.solvers import ExactSolver
from pipeline.kinematics.sweep import angles_rad
from pipeline.kinematics.table import Float
from tests.kinematics.hollow_joint import FACETS_MM, REST_MM, direct

PUBLISHED = Path(__file__).resolve().parents[3] / "shared" / "data" / "kinematics_reference"
SCAN = (12.0, 0.6, -2.0, 1.5, -3.0, -30.0)
FLEXION = np.arange(-5.0, 126.0, 5.0)


def ways_to_contact(solver: ExactSolver, baseline: Baseline) -> Float:
    """(F,) signed way along delta from each pose to first contact, mm; NaN where the curve is not published."""
    ways = np.full(len(baseline.flexion_deg), np.nan)
    ways[np.isfinite(baseline.internal_rotation_deg)] = [way_to_contact(solver, one) for one in probes(baseline)]
    return ways


@pytest.fixture(scope="module")
def bowl() -> ExactSolver:
    """A ball in a bowl about the middle of the flexion axis."""
    return direct()


@pytest.mark.parametrize(
    ("flexion", "rotation", "varus", "femur_up", "femur_forward"),
    [
        (10, 3.4, 0.7, -0.6, -1.2),
        (20, 6.3, 1.3, -1.0, -2.4),
        (30, 8.6, 1.7, -1.4, -3.4),
        (60, 13.2, 1.8, -1.7, -6.0),
        (90, 14.9, 0.65, -1.75, -7.7),
        (120, 15.0, -0.1, -2.0, -8.5),
    ],
)
def test_walker_as_tabulated(
    flexion: float, rotation: float, varus: float, femur_up: float, femur_forward: float
) -> None:
    found = walker_motion(np.array(flexion))
    assert found == pytest.approx((varus, rotation, -femur_forward, -femur_up), abs=0.051)


def columns(name: str) -> dict[str, Float]:
    path = PUBLISHED / name
    if not path.is_file():
        pytest.skip("published knee curves are not beside the checkout")
    table = np.genfromtxt(path, delimiter=",", names=True)
    return {column: table[column] for column in table.dtype.names or ()}


def test_walker_polynomials_are_those_published() -> None:
    table = columns("walker1988_polynomials.csv")
    found = walker_motion(table["flexion_deg"])
    for ours, theirs in (
        (found.varus_deg, "adduction_deg"),
        (found.internal_rotation_deg, "internal_rotation_deg"),
        (found.anterior_mm, "anterior_mm_tibia_rel_femur"),
        (found.proximal_mm, "superior_mm_tibia_rel_femur"),
    ):
        np.testing.assert_allclose(ours, table[theirs], rtol=0, atol=5.1e-5)


def test_angles_agree_with_a_model_that_uses_them() -> None:
    table = columns("rajagopal2016_walker_knee_r.csv")
    found = walker_motion(table["flexion_deg"])
    np.testing.assert_allclose(found.varus_deg, table["adduction_deg"], rtol=0, atol=2e-4)
    np.testing.assert_allclose(found.internal_rotation_deg, table["internal_rotation_deg"], rtol=0, atol=2e-4)


def test_walker_is_not_extrapolated() -> None:
    low, high = WALKER_RANGE_DEG
    found = np.stack(walker_motion(np.array([low - 1e-9, low, high, high + 1e-9])))
    assert np.isnan(found[:, [0, 3]]).all()
    assert np.isfinite(found[:, [1, 2]]).all()
    assert not found[:, 1].any()


def motion(at: Probe) -> Float:
    """The pose of the moving frame in the reference's, by the formula of the table."""
    flexion, varus = angles_rad((at.flexion_deg, at.varus_deg))
    return reference_from_moving(JointCoordinates(flexion, varus, at.pose.theta, at.pose.x, at.pose.y, at.pose.z))


def test_a_hinge_turns_about_the_flexion_axis_alone() -> None:
    (at_scan,) = probes(hinge(np.array([SCAN[0]]), SCAN))
    scan = motion(at_scan)
    for at in probes(hinge(FLEXION, SCAN)):
        turned = rigid(rotation_x(-np.radians(at.flexion_deg - SCAN[0])), np.zeros(3)) @ scan
        np.testing.assert_allclose(motion(at), turned, rtol=0, atol=1e-12)


@pytest.mark.parametrize("curve", [hinge, walker])
def test_baselines_pass_through_the_scan(curve: Callable[[Float, tuple[float, ...]], Baseline]) -> None:
    (at_scan,) = probes(curve(np.array([SCAN[0]]), SCAN))
    assert (at_scan.flexion_deg, at_scan.varus_deg) == pytest.approx(SCAN[:2])
    assert at_scan.pose == pytest.approx((*SCAN[3:], np.radians(SCAN[2])))


def test_walker_moves_as_published_from_the_scan_on() -> None:
    found, change = walker(FLEXION, SCAN), walker_motion(FLEXION)
    for field in change._fields:
        step = np.diff(getattr(found, field))
        np.testing.assert_allclose(step, np.diff(getattr(change, field)), rtol=0, atol=1e-12)
    assert np.isnan(found.proximal_mm[FLEXION < 0.0]).all()


def test_a_scan_beyond_the_published_range_counts_as_its_end() -> None:
    beyond = walker(FLEXION, (-4.0, *SCAN[1:]))
    np.testing.assert_array_equal(beyond.varus_deg, walker(FLEXION, (0.0, *SCAN[1:])).varus_deg)


@pytest.mark.parametrize("raised_mm", [0.0, -1.0, 0.5])
def test_a_hinge_in_a_round_bowl_keeps_its_way_to_contact(bowl: ExactSolver, raised_mm: float) -> None:
    flexion = np.arange(0.0, 61.0, 20.0)
    ways = ways_to_contact(bowl, hinge(flexion, (0.0, 0.0, 0.0, 0.0, 0.0, REST_MM + raised_mm)))
    np.testing.assert_allclose(ways, -raised_mm, rtol=0, atol=FACETS_MM)


def test_walker_overlaps_a_round_bowl_by_what_it_moves(bowl: ExactSolver) -> None:
    """Contact along delta at an anterior shift a is at the height sqrt(rest^2 - a^2)."""
    flexion = np.array([-10.0, 0.0, 10.0, 20.0, 30.0])
    ways = ways_to_contact(bowl, walker(flexion, (0.0, 0.0, 0.0, 0.0, 0.0, REST_MM)))
    moved = walker_motion(flexion)
    expected = np.sqrt(REST_MM**2 - moved.anterior_mm**2) - (REST_MM + moved.proximal_mm)
    np.testing.assert_allclose(ways, expected, rtol=0, atol=2.0 * FACETS_MM)
    assert np.isnan(ways[0])
    assert ways[-1] < -2.0


def test_where_nothing_is_met_there_is_no_way(bowl: ExactSolver) -> None:
    assert np.isnan(ways_to_contact(bowl, hinge(np.zeros(1), (0.0, 0.0, 0.0, 500.0, 0.0, 0.0)))).all()
