"""The kernels of the direct solver against independent answers: FCL, a general LP, finite differences, brute force."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import linprog

from pipeline.adapters.fcl_contact import FclBodies
from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.validation_objects import BallInDish, BarOnPyramids
from pipeline.kinematics.contact import AttitudeContact, Pose
from pipeline.kinematics.descent import MotionSettings, drop
from pipeline.kinematics.direct import plain
from pipeline.kinematics.direct.features import near_pairs, rows_of, triangles_over
from pipeline.kinematics.direct.height_map import depth_over, gaps_at, rasterise
from pipeline.kinematics.direct.polish import depth_at
from pipeline.kinematics.direct.prepare import prepare
from pipeline.kinematics.direct.programme import best_motion
from pipeline.kinematics.direct.search import fibre_load, new_rows
from pipeline.kinematics.direct.surfaces import FAR_MM, NOTHING_MM, HeightMap, Rows
from pipeline.kinematics.ligaments import Fibres
from pipeline.kinematics.ligaments import fibre_load as plain_fibre_load
from tests.kinematics.shapes import convex, ellipsoid, groove, joined, shifted

Float = NDArray[np.float64]
EXACT = MotionSettings(tolerance_mm=1e-6)


def bumps(seed: int, below: bool) -> TriangleMesh:  # noqa: FBT001 - which of the two bodies
    """Five overlapping ellipsoids side by side: many faces, edges and valleys."""
    noise = np.random.default_rng(seed)
    pieces = []
    for k in range(5):
        x, y, z = noise.uniform([-8, -8, -1], [8, 8, 1])
        pieces.append(shifted(ellipsoid(list(noise.uniform(2.0, 6.0, 3)), 60 + 20 * k), x, y, z))
    return shifted(joined(*pieces), z=-12.0 if below else 0.0)


PAIRS = {
    "facets": (bumps(1, below=False), bumps(2, below=True)),
    "few large triangles": (BarOnPyramids().pair().reference_body, BarOnPyramids().pair().moving_body),
    "ball and dish": (BallInDish().pair().reference_body, BallInDish().pair().moving_body),
    "needle and groove": (groove(20.0), convex([(0, 0, 0), (-3, -4, -20), (4, -4, -20), (0.5, 4, -20)])),
}
each_pair = pytest.mark.parametrize("name", PAIRS)


def places(seed: int, count: int) -> list[tuple[tuple[float, float], Pose]]:
    """Attitudes (rad) and poses at random, the bodies far apart along delta."""
    noise = np.random.default_rng(seed)
    rows = noise.uniform([-0.3, -0.2, -4, -4, -0.6], [0.3, 0.2, 4, 4, 0.6], (count, 5))
    return [((float(f), float(v)), Pose(float(x), float(y), -40.0, float(t))) for f, v, x, y, t in rows]


@each_pair
def test_exact_depth_is_where_the_collision_test_says_contact_is(name: str) -> None:
    reference, moving = PAIRS[name]
    bodies, prepared, tested = FclBodies(reference, moving), prepare(reference, moving), 0
    for angles, start in places(3, 25):
        fallen = drop(AttitudeContact(bodies, *angles), start, EXACT)
        depth = depth_at(prepared.turned(angles), np.array([start.x, start.y, start.theta, start.z]))
        assert (fallen is None) == (depth > FAR_MM)
        if fallen is not None:
            assert depth == pytest.approx(fallen.z, abs=1e-5)
            tested += 1
    assert tested > 5


@each_pair
def test_compiled_kernels_are_the_plain_ones(name: str) -> None:
    """Depth, map and gaps; a climb may take other ways among equals, so its end is compared by its depth."""
    prepared = prepare(*PAIRS[name])
    for angles, start in places(6, 6):
        attitude, pose = (
            prepared.at(angles, start._replace(z=np.inf)),
            np.array([start.x, start.y, start.theta, start.z]),
        )
        assert depth_at(attitude, pose) == pytest.approx(plain.depth_at(attitude, pose), abs=1e-9)
        heights = attitude.heights._replace(z=np.full_like(attitude.heights.z, NOTHING_MM))
        plain.rasterise(attitude.reference.points, attitude.reference.triangles, heights)
        np.testing.assert_allclose(attitude.heights.z, heights.z, atol=1e-9)
        rows = new_rows(len(attitude.samples))
        gaps_at(attitude.heights, attitude.samples, pose, rows)
        wanted = plain.map_rows(attitude, pose)
        np.testing.assert_allclose(rows.gaps, wanted.gaps, atol=1e-9)
        known = rows.gaps < FAR_MM
        np.testing.assert_allclose(rows.rates[known], wanted.rates[known], atol=1e-9)
        gaps = np.empty(len(attitude.samples))
        assert depth_over(attitude.heights, attitude.samples, pose, gaps) == rows.gaps.min()
        np.testing.assert_array_equal(gaps, rows.gaps)


@each_pair
def test_every_feature_is_found_once(name: str) -> None:
    """Against all corners, all faces, all edges of the plain kernels: clearances, slopes and places."""
    prepared, held = prepare(*PAIRS[name]), 0
    every = np.ones(prepared.bins.cover.shape[:2], dtype=np.bool_)
    for angles, start in places(4, 8):
        attitude = prepared.turned(angles)
        pose = np.array([start.x, start.y, start.theta, start.z])
        wanted = plain.exact_rows(attitude, pose)
        if not len(wanted.gaps):
            continue
        ceiling = wanted.gaps.min() + 0.3
        among = triangles_over(attitude, every, pose, ceiling, 0.0)
        found = rows_of(attitude, near_pairs(attitude, every, among, pose, ceiling), pose, ceiling)
        assert found.gaps.max() <= ceiling
        held += len(found.gaps)
        np.testing.assert_allclose(
            _sorted(found), _sorted(Rows(*(of[wanted.gaps <= ceiling] for of in wanted))), atol=1e-7
        )
    assert held > 5


def _sorted(rows: Rows) -> Float:
    """Rows in a lasting order, each once: plain corners above a shared edge lie under two faces."""
    flat = np.column_stack([rows.gaps, rows.rates, rows.arms])
    return np.unique(flat.round(6), axis=0)


@each_pair
def test_triangles_that_are_not_looked_at_hold_no_feature_within_reach(name: str) -> None:
    """Chosen for a neighbourhood of a pose, they are enough anywhere in it."""
    prepared, noise = prepare(*PAIRS[name]), np.random.default_rng(9)
    every = np.ones(prepared.bins.cover.shape[:2], dtype=np.bool_)
    for angles, start in places(4, 8):
        attitude = prepared.turned(angles)
        pose = np.array([start.x, start.y, start.theta, start.z])
        near = triangles_over(attitude, every, pose, FAR_MM, 0.5)
        for moved in pose + noise.uniform(-0.3, 0.3, (4, 4)) * [1.0, 1.0, 0.0, 0.0]:
            ceiling = plain.depth_at(attitude, moved) + 0.1
            if ceiling < FAR_MM:
                some = rows_of(attitude, near_pairs(attitude, every, near, moved, ceiling), moved, ceiling)
                everything = np.arange(len(attitude.reference.triangles), dtype=np.int32)
                whole = rows_of(attitude, near_pairs(attitude, every, everything, moved, ceiling), moved, ceiling)
                np.testing.assert_array_equal(np.sort(some.gaps), np.sort(whole.gaps))


@each_pair
def test_slopes_of_the_depth_are_its_differences(name: str) -> None:
    prepared, tested = prepare(*PAIRS[name]), 0
    for angles, start in places(5, 6):
        attitude = prepared.turned(angles)
        pose = np.array([start.x, start.y, start.theta, start.z])
        rows = plain.exact_rows(attitude, pose)
        if not len(rows.gaps):
            continue
        first, *others = np.sort(rows.gaps)
        if others and others[0] - first < 1e-3:
            continue
        slope = rows.rates[np.argmin(rows.gaps)]
        for axis in range(3):
            step = np.zeros(4)
            step[axis] = 1e-6
            change = depth_at(attitude, pose + step) - depth_at(attitude, pose - step)
            assert change / 2e-6 == pytest.approx(slope[axis], rel=1e-3, abs=1e-3)
            tested += 1
    assert tested > 3


def test_a_height_map_of_a_plane_is_the_plane_and_slopes_are_its_own() -> None:
    points = np.array([(-10.0, -10.0, 0.0), (10.0, -10.0, 0.0), (10.0, 10.0, 0.0), (-10.0, 10.0, 0.0)])
    points[:, 2] = 3.0 + 0.4 * points[:, 0] - 0.2 * points[:, 1]
    heights = HeightMap(np.full((41, 41), NOTHING_MM), -10.0, -10.0, 0.5)
    rasterise(points, np.array([(0, 2, 1), (0, 3, 2)], dtype=np.int32), heights)
    i, j = np.meshgrid(np.arange(41), np.arange(41))
    np.testing.assert_allclose(heights.z, 3.0 + 0.4 * (0.5 * i - 10.0) - 0.2 * (0.5 * j - 10.0), atol=1e-9)
    samples, rows = np.array([(1.0, 2.0, 0.5), (-3.0, 1.0, 0.0)]), new_rows(2)
    pose = np.array([0.3, -0.7, 0.5])
    least = gaps_at(heights, samples, pose, rows)
    c, s = np.cos(0.5), np.sin(0.5)
    arm = samples[:, :2] @ np.array([[c, s], [-s, c]])
    expected = 3.0 + 0.4 * (arm[:, 0] + 0.3) - 0.2 * (arm[:, 1] - 0.7) - samples[:, 2]
    np.testing.assert_allclose(rows.gaps, expected, atol=1e-9)
    np.testing.assert_allclose(
        rows.rates, np.column_stack([[0.4, 0.4], [-0.2, -0.2], -0.2 * arm[:, 0] - 0.4 * arm[:, 1]])
    )
    assert least == pytest.approx(expected.min())


def test_triangles_that_face_along_delta_do_not_count() -> None:
    points = np.array([(0.0, 0.0, 1.0), (5.0, 0.0, 1.0), (0.0, 5.0, 1.0)])
    heights = HeightMap(np.full((5, 5), NOTHING_MM), 0.0, 0.0, 1.0)
    rasterise(points, np.array([(0, 1, 2)], dtype=np.int32), heights)
    assert heights.z.min() == NOTHING_MM


@pytest.mark.parametrize("seed", range(20))
def test_best_motion_is_that_of_a_general_linear_programme(seed: int) -> None:
    noise = np.random.default_rng(seed)
    count = int(noise.integers(1, 60))
    rates, slack, box = noise.normal(size=(count, 3)), noise.uniform(0.0, 0.5, count), noise.uniform(0.05, 1.0, 3)
    motion = np.zeros(3)
    gain = best_motion(rates, slack, np.arange(count), box, motion)
    answer = linprog(
        [0.0, 0.0, 0.0, -1.0],
        A_ub=np.column_stack([-rates, np.ones(count)]),
        b_ub=slack,
        bounds=[(-b, b) for b in box] + [(None, None)],
    )
    assert answer.x is not None
    assert gain == pytest.approx(answer.x[3], abs=1e-9)
    assert np.all(np.abs(motion) <= box + 1e-9)
    assert (slack + rates @ motion).min() == pytest.approx(gain, abs=1e-9)


def test_compiled_fibres_pull_as_the_plain_ones() -> None:
    noise = np.random.default_rng(7)
    fibres = Fibres(
        noise.normal(size=(9, 3)) * 10.0 + [0.0, 0.0, 20.0],
        noise.normal(size=(9, 3)) * 10.0,
        np.full(9, 20.0),
        np.ones(9),
    )
    pose, slope = np.array([1.0, -2.0, 0.3, 4.0]), np.zeros(4)
    energy = fibre_load(fibres, pose, slope)
    plain = plain_fibre_load(fibres, (1.0, -2.0, 0.3, 4.0))
    assert energy == pytest.approx(plain.energy_mm)
    np.testing.assert_allclose(slope, plain.slope)
