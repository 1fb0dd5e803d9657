"""Near features of triangle pairs, against the closest points of convex sets by an independent programme."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import nnls

from pipeline.geometry.triangles import near_features, with_neighbours

Float = NDArray[np.float64]
FLAT = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]])


def closest(first: Float, second: Float) -> tuple[float, Float, Float]:
    """Distance of two triangles and the barycentric weights of the closest points, by non-negative least squares."""
    heavy = 1e4
    sums = np.array([[heavy] * 3 + [0.0] * 3, [0.0] * 3 + [heavy] * 3])
    weights, _ = nnls(np.vstack([np.hstack([first.T, -second.T]), sums]), np.array([0.0, 0.0, 0.0, heavy, heavy]))
    u, v = weights[:3] / weights[:3].sum(), weights[3:] / weights[3:].sum()
    return float(np.linalg.norm(u @ first - v @ second)), u, v


def facing_pairs(count: int, seed: int) -> tuple[Float, Float]:
    """Random disjoint triangle pairs that look at one another across z = 0."""
    random = np.random.default_rng(seed)
    first, second = random.uniform(-1, 1, (2, count, 3, 3))
    first[..., 2] = -0.05 - np.abs(first[..., 2])
    second[..., 2] = 0.05 + np.abs(second[..., 2])
    return oriented(first, 1.0), oriented(second, -1.0)


def oriented(corners: Float, sign: float) -> Float:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.where((normal[:, 2] * sign < 0)[:, None, None], corners[:, ::-1], corners)


def is_feature(u: Float, v: Float) -> bool:
    """Whether weights of closest points are those of a vertex on a face or of two crossing edges, safely inside."""
    zero = [int((weights < 1e-3).sum()) for weights in (u, v)]
    return sorted(zero) in ([0, 2], [1, 1])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_nearest_feature_is_the_distance_of_the_pair(seed: int) -> None:
    seen = 0
    for first, second in zip(*facing_pairs(150, seed), strict=True):
        expected, u, v = closest(first, second)
        found = near_features(first[None], second[None], 10.0)
        assert np.all(found.distance >= expected - 1e-6)
        if is_feature(u, v):
            away = v @ second - u @ first
            normals = [np.cross(t[1] - t[0], t[2] - t[0]) for t in (first, second)]
            if away @ normals[0] > 1e-6 and away @ normals[1] < -1e-6:
                seen += 1
                assert found.distance.min() == pytest.approx(expected, abs=1e-6)
                nearest = int(np.argmin(found.distance))
                np.testing.assert_allclose(found.on_first[nearest], u @ first, atol=1e-5)
                np.testing.assert_allclose(found.on_second[nearest], v @ second, atol=1e-5)
    assert seen > 30


def test_distance_is_that_of_the_points() -> None:
    found = near_features(*facing_pairs(200, 5), 2.0)
    np.testing.assert_allclose(np.linalg.norm(found.on_second - found.on_first, axis=1), found.distance, rtol=1e-12)


def test_vertex_above_a_face() -> None:
    spike = np.array([[1.0, 1.0, 0.25], [2.0, 1.0, 3.0], [1.0, 2.0, 3.0]])[[0, 2, 1]]
    found = near_features(FLAT[None], spike[None], 0.3)
    assert found.distance == pytest.approx([0.25])
    np.testing.assert_allclose(found.on_first, [[1.0, 1.0, 0.0]])


def test_crossing_edges() -> None:
    ridge = np.array([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0], [-2.0, 1.0, -2.0]])
    leaning = np.array([[-1.0, 1.0, 0.5], [1.0, 1.0, 0.5], [0.0, -3.0, 5.0]])
    found = near_features(oriented(ridge[None], 1.0), oriented(leaning[None], -1.0), 0.6)
    assert found.distance == pytest.approx([0.5])
    np.testing.assert_allclose(found.on_first, [[0.0, 1.0, 0.0]], atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_a_corner_above_a_shared_edge_is_seen_by_one_of_the_faces(seed: int) -> None:
    random = np.random.default_rng(seed)
    for _ in range(40):
        a, b = random.normal(size=(2, 3)) * [1.0, 1.0, 0.0]
        across = np.array([a[1] - b[1], b[0] - a[0], 0.0])
        faces = np.array([[a, b, (a + b) / 2 + across], [b, a, (a + b) / 2 - across]])
        tip = a + random.uniform(0.1, 0.9) * (b - a) + [0.0, 0.0, 0.01]
        spike = tip + np.array([[0.0, 0.0, 0.0], [0.0, 0.1, 1.0], [0.1, 0.0, 1.0]])
        assert len(near_features(faces, np.array([spike, spike]), 0.02).distance) > 0


def test_an_upright_wall_touches_with_its_lower_corners() -> None:
    """A box pushed into a slab crosses it with its walls alone: they must tell where its corners stand."""
    wall = np.array([[1.0, 1.0, 0.1], [1.0, 2.0, 0.1], [1.0, 1.5, 3.0]])
    found = near_features(FLAT[None], wall[None], 0.2)
    np.testing.assert_allclose(np.unique(found.on_first.round(9), axis=0), [[1, 1, 0], [1, 2, 0]], atol=1e-9)


@pytest.mark.parametrize("swap", [False, True])
def test_backs_do_not_push(*, swap: bool) -> None:
    spike = np.array([[1.0, 1.0, 0.25], [2.0, 1.0, 3.0], [1.0, 2.0, 3.0]])
    first, second = (FLAT[::-1], spike[[0, 2, 1]]) if swap else (FLAT, spike)
    assert len(near_features(first[None], second[None], 1.0).distance) == 0


def test_band_is_inclusive_and_nothing_is_found_beyond_it() -> None:
    spike = np.array([[1.0, 1.0, 0.25], [1.0, 2.0, 3.0], [2.0, 1.0, 3.0]])
    assert len(near_features(FLAT[None], spike[None], 0.25).distance) == 1
    assert len(near_features(FLAT[None], spike[None], 0.2499).distance) == 0


def test_rigid_motion_changes_nothing() -> None:
    first, second = facing_pairs(100, 9)
    turn, _ = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    there = near_features(first @ turn.T + 7.0, second @ turn.T + 7.0, 1.0)
    here = near_features(first, second, 1.0)
    np.testing.assert_allclose(np.sort(there.distance), np.sort(here.distance), atol=1e-12)


def test_degenerate_triangles_and_no_pairs_are_harmless() -> None:
    line = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    assert len(near_features(line[None], FLAT[None] + 0.1, 1.0).distance) == 0
    assert len(near_features(np.empty((0, 3, 3)), np.empty((0, 3, 3)), 1.0).distance) == 0


def test_neighbours_of_a_tetrahedron_and_of_a_lone_triangle() -> None:
    solid = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]], dtype=np.int32)
    found = with_neighbours(solid)
    np.testing.assert_array_equal(found[:, :3], solid)
    for row in found:
        assert set(row[:3].tolist()) | {int(row[3])} == {0, 1, 2, 3}
    assert found[0].tolist() == [0, 1, 2, 3, 3, 3]
    assert with_neighbours(solid[:1]).tolist() == [[0, 1, 2, 2, 0, 1]]


@pytest.mark.parametrize(
    ("rise", "reacts"), [(-0.5, True), (0.0, False), (0.5, False)], ids=["ridge", "flat", "valley"]
)
def test_an_edge_reacts_on_a_ridge_only(rise: float, *, reacts: bool) -> None:
    """The slanting lower edge of a blade above the line y = 0 that two faces share, nearest to it at (0.2, 0, 0)."""
    points = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, -2.0, rise], [0.0, 2.0, rise]])
    sides = points[with_neighbours(np.array([[1, 0, 2], [0, 1, 3]], dtype=np.int32))]
    blade = oriented(np.array([[[0.1, -0.2, 0.04], [0.3, 0.2, 0.08], [0.5, -0.2, 0.9]]]), -1.0)
    found = [near_features(side[None], blade, 0.1) for side in sides]
    on_edge = [bool(np.any(np.abs(features.on_first[:, 1]) < 1e-9)) for features in found]
    assert any(on_edge) is reacts
