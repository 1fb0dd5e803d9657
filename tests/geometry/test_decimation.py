"""Decimation that keeps topology."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.decimation import decimate
from pipeline.geometry.mesh import TriangleMesh, check_closed, components, genus, merged, volume_mm3
from tests.geometry.meshes import octahedron, torus


def _rough(mesh: TriangleMesh, size_mm: float) -> TriangleMesh:
    noise = np.random.default_rng(3).normal(0.0, size_mm, mesh.points.shape)
    return TriangleMesh(mesh.points + noise, mesh.triangles)


@pytest.mark.parametrize("triangles", [4000, 1000, 300])
def test_topology_is_kept_and_the_number_reached(triangles: int) -> None:
    light = decimate(torus(10.0, 3.0, 90, 60), triangles)
    check_closed(light, "light")
    assert genus(light) == 1
    assert triangles - 2 <= len(light.triangles) <= triangles


def test_volume_error_falls_with_the_number_of_triangles() -> None:
    mesh = torus(10.0, 3.0, 90, 60)
    errors = [abs(volume_mm3(decimate(mesh, n)) / volume_mm3(mesh) - 1.0) for n in (300, 1200, 4800)]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 2e-3


def test_a_thin_rough_ring_stays_closed() -> None:
    light = decimate(_rough(torus(10.0, 0.3, 200, 12), 0.02), 600)
    check_closed(light, "light")
    assert genus(light) == 1


def test_it_stops_where_topology_forbids_more() -> None:
    light = decimate(merged([octahedron(), torus(5.0, 1.0, 12, 8)]), 4)
    check_closed(light, "light")
    assert len(components(light)) == 2
    assert genus(light) == 1


def test_equal_input_gives_equal_bits_and_is_not_changed() -> None:
    mesh = _rough(torus(10.0, 3.0, 40, 30), 0.05)
    before = mesh.points.copy()
    first, second = decimate(mesh, 500), decimate(mesh, 500)
    assert np.array_equal(first.points, second.points)
    assert np.array_equal(first.triangles, second.triangles)
    assert np.array_equal(mesh.points, before)


def test_enough_is_left_alone() -> None:
    mesh = octahedron()
    assert np.array_equal(decimate(mesh, 8).triangles, mesh.triangles)
