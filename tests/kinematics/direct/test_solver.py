"""The direct solver on bodies whose stable pose is known, and against the incremental one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.adapters.fcl_contact import FclBodies
from pipeline.adapters.threads import map_threads
from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.validation_objects import BallInDish, BarOnPyramids, ball, box, dish
from pipeline.kinematics.contact import AttitudeContact, Pose
from pipeline.kinematics.direct.kernels import Kernels
from pipeline.kinematics.direct.plain import PLAIN
from pipeline.kinematics.direct.prepare import prepare
from pipeline.kinematics.direct.settings import DirectSettings
from pipeline.kinematics.direct.solver import COMPILED, DirectSolver
from pipeline.kinematics.incremental import StablePose, solve_incremental
from pipeline.kinematics.joint_coordinates import rotation_x
from pipeline.kinematics.table import Status
from tests.kinematics.settings import BALL_STARTS, BAR_STARTS, PAPER
from tests.kinematics.shapes import HelicalGroove, ellipsoid, groove, joined, shifted, turned_down

LEVEL = (0.0, 0.0)


each_kernel = pytest.mark.parametrize("kernels", [COMPILED, PLAIN], ids=["compiled", "plain"])


def solver(reference: TriangleMesh, moving: TriangleMesh, **bounds: float) -> DirectSolver:
    return DirectSolver(prepare(reference, moving), DirectSettings(**bounds))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def bowl() -> DirectSolver:
    pair = BallInDish().pair()
    return solver(pair.reference_body, pair.moving_body)


@pytest.fixture(scope="module")
def pyramids() -> DirectSolver:
    pair = BarOnPyramids().pair()
    return solver(pair.reference_body, pair.moving_body)


@pytest.fixture(scope="module")
def runner() -> DirectSolver:
    return solver(HelicalGroove().reference_body(), HelicalGroove().moving_body())


@pytest.mark.parametrize("start", BALL_STARTS)
def test_ball_comes_to_rest_in_the_middle(bowl: DirectSolver, start: Pose) -> None:
    found = bowl.at(LEVEL).solve(start)
    assert found.status is Status.OK
    assert np.hypot(found.pose.x, found.pose.y) < 0.02
    assert found.pose.z == pytest.approx(-6.0, abs=1e-3)


@each_kernel
@pytest.mark.parametrize("start", BAR_STARTS)
def test_bar_turns_onto_both_pyramids(pyramids: DirectSolver, start: Pose, kernels: Kernels) -> None:
    found = replace(pyramids, kernels=kernels).at(LEVEL).solve(start)
    assert found.status is Status.OK
    assert abs(found.pose.x) < 0.02
    assert abs(np.degrees(found.pose.theta)) < 0.05
    assert found.pose.z == pytest.approx(-BarOnPyramids().rest_height_mm, abs=1e-3)


@pytest.mark.parametrize("start", [BAR_STARTS[0], BAR_STARTS[4]])
def test_a_pose_is_certified_and_proven_by_the_other_library(pyramids: DirectSolver, start: Pose) -> None:
    attitude = pyramids.at(LEVEL)
    found = attitude.solve(start).pose
    assert attitude.certify(found).residual < 1e-6
    pair = BarOnPyramids().pair()
    contact = AttitudeContact(FclBodies(pair.reference_body, pair.moving_body), *LEVEL)
    assert not contact.touches(found)
    assert contact.touches(found._replace(z=found.z + 2e-4))


def test_two_balls_in_two_dishes() -> None:
    hollow, sphere = turned_down(dish(8.0, sectors=16)), turned_down(ball(4.0, sectors=12))
    pair = [joined(shifted(one, -14.0), shifted(one, 14.0)) for one in (hollow, sphere)]
    found = solver(*pair).at(LEVEL).solve(Pose(1.0, 0.5, -20.0, 0.1))
    assert found.status is Status.OK
    np.testing.assert_allclose(found.pose[:3], [0.0, 0.0, -4.0], atol=0.02)
    assert abs(np.degrees(found.pose.theta)) < 0.05


@pytest.mark.parametrize("flexion", [0.5, -0.8])
def test_turned_reference_gives_the_turned_answer(flexion: float) -> None:
    pair = BallInDish().pair()
    tilted = TriangleMesh(pair.reference_body.points @ rotation_x(-flexion).T, pair.reference_body.triangles)
    found = solver(tilted, pair.moving_body).at((flexion, 0.0)).solve(BALL_STARTS[-1])
    assert found.status is Status.OK
    np.testing.assert_allclose(found.pose[:3], [0.0, 0.0, -6.0], atol=0.02)


@pytest.mark.parametrize("flexion_deg", [-35.0, 0.0, 10.0, 30.0])
def test_a_helical_groove_dictates_place_and_rotation(runner: DirectSolver, flexion_deg: float) -> None:
    flexion = float(np.radians(flexion_deg))
    wanted = HelicalGroove().rest(flexion)
    start = Pose(wanted.x + 0.6, 1.0, wanted.z - 8.0, wanted.theta + 0.05)
    found = runner.at((flexion, 0.0)).solve(start)
    assert found.status is Status.OK
    np.testing.assert_allclose(found.pose[:3], wanted[:3], atol=0.02)
    assert np.degrees(found.pose.theta) == pytest.approx(np.degrees(wanted.theta), abs=0.05)


@each_kernel
def test_convex_on_convex_slides_off(kernels: Kernels) -> None:
    convex = solver(ellipsoid((10, 8, 6)), ellipsoid((9, 12, 5)), slide_bound_mm=12.0)
    assert replace(convex, kernels=kernels).at(LEVEL).solve(Pose(1.0, 0.5, -30.0, 0.0)).status is Status.SLID_OFF


def test_turning_past_the_bound_is_told() -> None:
    pair = BarOnPyramids().pair()
    bounded = solver(pair.reference_body, pair.moving_body, rotation_bound_rad=0.1)
    assert bounded.at(LEVEL).solve(BAR_STARTS[0]).status is Status.ROTATION_BOUND


def test_nothing_above_is_no_contact(pyramids: DirectSolver) -> None:
    start = Pose(100.0, 0.0, -20.0, 0.0)
    assert pyramids.at(LEVEL).solve(start) == StablePose(start, Status.NO_CONTACT, 0, 0)
    assert pyramids.at(LEVEL).depth(start) is None


@pytest.mark.parametrize("start", [*BAR_STARTS[:3], Pose(0.5, 0.0, -3.0, 0.1)])
def test_never_shallower_than_the_incremental_solver(pyramids: DirectSolver, start: Pose) -> None:
    pair = BarOnPyramids().pair()
    slow = solve_incremental(AttitudeContact(FclBodies(pair.reference_body, pair.moving_body), *LEVEL), start, PAPER)
    quick = pyramids.at(LEVEL).solve(start)
    assert slow.status is quick.status is Status.OK
    assert quick.pose.z >= slow.pose.z - 1e-3
    assert abs(quick.pose.x - slow.pose.x) < 0.1
    assert abs(np.degrees(quick.pose.theta - slow.pose.theta)) < 0.2


def test_the_same_bits_for_any_number_of_threads(bowl: DirectSolver) -> None:
    def work(start: Pose) -> StablePose:
        return bowl.at(LEVEL).solve(start)

    assert map_threads(work, BALL_STARTS * 2, 1) == map_threads(work, BALL_STARTS * 2, 2)


def test_margin_of_a_ball_in_its_dish_reaches_the_most_that_is_tried(bowl: DirectSolver) -> None:
    """The dish rises to every side; a turn of the ball about delta changes nothing."""
    attitude = bowl.at(LEVEL)
    margin = attitude.margin(attitude.solve(BALL_STARTS[0]).pose)
    assert (margin.lateral_mm, margin.anterior_mm) == (5.0, 5.0)
    assert margin.rotation_deg == pytest.approx(10.0)


@each_kernel
@pytest.mark.parametrize("held", [False, True], ids=["moving body inside", "reference inside"])
def test_a_body_inside_the_other_meets_nothing(kernels: Kernels, held: bool) -> None:  # noqa: FBT001 - which is inside
    bodies = [ellipsoid((20, 18, 15)), ellipsoid((4, 3, 2))]
    nested = solver(*(bodies[::-1] if held else bodies))
    start = Pose(0.5, -0.3, 0.2, 0.1)
    assert replace(nested, kernels=kernels).at(LEVEL).solve(start).status is Status.NO_CONTACT


@pytest.mark.parametrize("post_mm", [4.0, 9.0, 13.0])
def test_a_body_that_slides_stops_where_a_post_hangs_down(post_mm: float) -> None:
    """The post is lower than all that lies near contact where the body starts: it must be seen on the way."""
    post = box((-1.0, 1.0), (post_mm, post_mm + 1.0), (-40.0, 0.0))
    reference, moving = joined(groove(20.0), post), shifted(turned_down(ball(3.0)), z=-3.0)
    slope, start = (0.2, 0.0), Pose(0.0, -6.0, -30.0, 0.0)
    contact = AttitudeContact(FclBodies(reference, moving), *slope)
    quick = solver(reference, moving).at(slope).solve(start)
    slow = solve_incremental(contact, start, PAPER)
    assert quick.status is slow.status
    assert quick.pose.z >= slow.pose.z - 1e-3
    assert not contact.touches(quick.pose)
    assert contact.touches(quick.pose._replace(z=quick.pose.z + 5e-3))


@pytest.mark.parametrize("across_mm", [0.05, 0.3, 1.0])
def test_a_needle_thinner_than_the_map_comes_to_rest_in_the_middle_of_a_dish(across_mm: float) -> None:
    """Nodes and samples lie at multiples of 0.6 mm at most, the needle between them."""
    half = 0.5 * across_mm
    needle = box((0.29 - half, 0.29 + half), (0.31 - half, 0.31 + half), (0.0, 20.0))
    bowl_up = dish(6.0, sectors=32)
    contact = AttitudeContact(FclBodies(needle, bowl_up), *LEVEL)
    found = solver(needle, bowl_up).at(LEVEL).solve(Pose(1.0, -0.8, -30.0, 0.0))
    assert found.status is Status.OK
    assert not contact.touches(found.pose)
    assert contact.touches(found.pose._replace(z=found.pose.z + 2e-3))
    np.testing.assert_allclose(found.pose[:2], [0.29, 0.31], atol=0.05 + half)
