"""The centres of a plateau made of two dished halves with an eminence between them."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.directions import angle_deg, unit
from pipeline.geometry.mesh import TriangleMesh, check_closed, transformed
from pipeline.geometry.plateau import EMINENCE_SHARE, plateau_centres
from pipeline.geometry.validation_objects import box, revolved
from tests.geometry.knees import MIRROR, about

SQUARE = np.eye(3)
HALF_WIDTH_MM, HALF_DEPTH_MM = 36.0, 22.0
X = np.array([1.0, 0.0, 0.0])


def slab() -> TriangleMesh:
    """A block that narrows downwards; its top has a shallow dish in each half and a ridge along y in the middle."""
    x = np.linspace(-HALF_WIDTH_MM, HALF_WIDTH_MM, 73)
    y = np.linspace(-HALF_DEPTH_MM, HALF_DEPTH_MM, 45)
    u, v = (part.ravel() for part in np.meshgrid(x, y, indexing="ij"))
    dished = 0.002 * ((np.abs(u) - 18.0) ** 2 + v**2) + np.maximum(0.0, 6.0 - 2.0 * np.abs(u))
    top = np.column_stack([u, v, dished])
    bottom = np.column_stack([0.7 * u, 0.7 * v, np.full(len(u), -50.0)])
    return TriangleMesh(np.vstack([top, bottom]), _block_triangles(len(x), len(y)))


def _block_triangles(rows: int, columns: int) -> np.ndarray[tuple[int, int], np.dtype[np.int32]]:
    """Top, bottom and walls over a grid of vertices and its copy below."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    top = np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    below = rows * columns
    rim = np.concatenate([index[:, 0], index[-1, 1:], index[-2::-1, -1], index[0, -2::-1]])
    here, there = rim[:-1], rim[1:]
    walls = np.vstack(
        [np.column_stack([here, here + below, there + below]), np.column_stack([here, there + below, there])]
    )
    return np.vstack([top, top[:, ::-1] + below, walls]).astype(np.int32)


@pytest.fixture(scope="module")
def tibia() -> TriangleMesh:
    made = slab()
    check_closed(made, "the slab")
    return made


def test_the_centres_are_those_of_the_halves_beside_the_eminence(tibia: TriangleMesh) -> None:
    found = plateau_centres(tibia, SQUARE)
    middle = 0.5 * (HALF_WIDTH_MM + EMINENCE_SHARE * 2.0 * HALF_WIDTH_MM)
    for centre, x in ((found.medial, -middle), (found.lateral, middle)):
        np.testing.assert_allclose(centre[:2], [x, 0.0], rtol=0, atol=0.4)
        assert 0.0 < centre[2] < 0.6
    # the diagonals of the facets all run one way
    np.testing.assert_allclose((found.medial + found.lateral)[:2], 0.0, atol=0.01)
    assert angle_deg(unit(found.lateral - found.medial), X) < 0.02
    assert (found.uncertainty_mm, found.uncertainty_deg) == (0.3, 0.5)


@pytest.mark.parametrize("off_deg", [-20.0, -7.0, 7.0, 20.0])
def test_the_line_does_not_depend_on_the_start(tibia: TriangleMesh, off_deg: float) -> None:
    found = plateau_centres(tibia, about(0.0, 0.0, off_deg))
    assert angle_deg(unit(found.lateral - found.medial), X) < 0.1
    np.testing.assert_allclose(found.lateral, plateau_centres(tibia, SQUARE).lateral, rtol=0, atol=0.05)


def test_a_mirrored_tibia_has_the_mirrored_centres(tibia: TriangleMesh) -> None:
    right = plateau_centres(tibia, about(0.0, 0.0, 11.0))
    left = plateau_centres(transformed(tibia, MIRROR), about(0.0, 0.0, 11.0) * [-1.0, 1.0, 1.0])
    np.testing.assert_allclose(left.medial, right.medial * [-1.0, 1.0, 1.0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(left.lateral, right.lateral * [-1.0, 1.0, 1.0], rtol=0, atol=1e-9)


def test_what_has_no_plateau_is_refused() -> None:
    spike = revolved(np.array([[0.0, 0.0], [10.0, 5.0], [0.0, 60.0]]), 16)
    with pytest.raises(ValueError, match="no surface of the tibia faces proximally"):
        plateau_centres(spike, SQUARE)
    with pytest.raises(ValueError, match="the tibia is too short"):
        plateau_centres(box((-30.0, 30.0), (-20.0, 20.0), (0.0, 1.0)), SQUARE)


def test_a_plateau_with_one_half_is_refused() -> None:
    """The medial half ends in a single peak: everything that faces proximally lies within one strip."""
    roof = TriangleMesh(
        np.array([[-36, -22, 0], [36, -22, 0], [36, 22, 0], [-36, 22, 0], [0, 0, 40], [0, 0, -40]], dtype=float),
        np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [1, 0, 5], [2, 1, 5], [3, 2, 5], [0, 3, 5]], np.int32),
    )
    with pytest.raises(ValueError, match="no surface of the tibia faces proximally"):
        plateau_centres(roof, SQUARE)
