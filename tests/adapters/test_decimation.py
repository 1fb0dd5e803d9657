"""Quick decimation: the wanted number of triangles, bad meshes refused before the library sees them."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.adapters.decimation import decimate_quadric
from pipeline.geometry.deviation import deviation
from pipeline.geometry.mesh import TriangleMesh, check_closed, volume_mm3
from tests.geometry.meshes import octahedron, torus


@pytest.mark.parametrize("triangles", [400, 1000, 3000])
def test_the_wanted_number_of_triangles_stays_on_the_surface(triangles: int) -> None:
    mesh = torus(10.0, 3.0, 60, 40)
    light = decimate_quadric(mesh, triangles)
    check_closed(light, "light")
    assert abs(len(light.triangles) - triangles) <= 2
    assert deviation(light, mesh).max_mm < 100.0 / triangles
    assert volume_mm3(light) == pytest.approx(volume_mm3(mesh), rel=30.0 / triangles)


def test_equal_input_gives_equal_bits() -> None:
    first, second = (decimate_quadric(torus(10.0, 3.0, 60, 40), 900) for _ in range(2))
    assert first.points.tobytes() == second.points.tobytes()
    assert first.triangles.tobytes() == second.triangles.tobytes()


@pytest.mark.parametrize(
    ("points", "triangles", "message"),
    [
        (np.full((6, 3), np.nan), octahedron().triangles, "not finite"),
        (octahedron().points, np.full((8, 3), 1_000_000, dtype=np.int32), "outside"),
        (octahedron().points, np.zeros((0, 3), dtype=np.int32), "no triangles"),
    ],
)
def test_a_bad_mesh_is_refused(
    points: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    triangles: np.ndarray[tuple[int, int], np.dtype[np.int32]],
    message: str,
) -> None:
    with pytest.raises(ValueError, match=message):
        decimate_quadric(TriangleMesh(points, triangles), 4)
