"""Fields of heights: sampled surfaces, the highest of each cell, blurring that knows where nothing is."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.height_field import Raster, eased, highest, smoothed, surface_samples
from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.validation_objects import ball

RASTER = Raster((-10.0, -10.0), (0.5, 0.5), (41, 41))


def test_samples_lie_on_the_triangles_and_no_farther_apart_than_asked() -> None:
    mesh = TriangleMesh(np.array([[0.0, 0, 0], [9.0, 0, 3.0], [0, 6.0, 0]]), np.array([[0, 1, 2]], dtype=np.int32))
    points = surface_samples(mesh, 0.5)
    np.testing.assert_allclose(points[:, 2], points[:, 0] / 3.0, atol=1e-12)
    edge = np.sort(points[points[:, 1] < 1e-9][:, 0])
    assert edge[0] == 0.0
    assert edge[-1] == 9.0
    assert np.diff(edge).max() <= 0.5 / np.sqrt(10.0) * 3.0 + 1e-9


def test_the_highest_of_each_cell_of_a_ball_is_its_upper_half() -> None:
    points = surface_samples(ball(8.0, sectors=96), 0.2)
    field = highest((points[:, 0], points[:, 1]), points[:, 2], RASTER)
    x, y = np.meshgrid(*RASTER.axes(), indexing="ij")
    inside = np.hypot(x, y) < 6.0
    expected = np.sqrt(64.0 - x[inside] ** 2 - y[inside] ** 2)
    # within a cell the height varies by its slope
    np.testing.assert_allclose(field[inside], expected, atol=0.45)
    assert np.isnan(field[np.hypot(x, y) > 9.0]).all()


def test_blurring_keeps_planes_and_unknown_cells() -> None:
    x, y = np.meshgrid(*RASTER.axes(), indexing="ij")
    field = np.where(x > 7.0, np.nan, 3.0)
    out = smoothed(field, 2.0)
    np.testing.assert_allclose(out[np.isfinite(field)], 3.0)
    np.testing.assert_array_equal(np.isnan(out), np.isnan(field))
    slope = smoothed(0.2 * x + 0.1 * y, 2.0)[10:-10, 10:-10]
    np.testing.assert_allclose(slope, (0.2 * x + 0.1 * y)[10:-10, 10:-10], atol=1e-3)


@pytest.mark.parametrize(("value", "expected"), [(1.0, 0.0), (2.0, 0.0), (3.0, 0.5), (4.0, 1.0), (9.0, 1.0)])
def test_an_eased_step(value: float, expected: float) -> None:
    assert eased(np.array(value), 2.0, 4.0) == pytest.approx(expected)
