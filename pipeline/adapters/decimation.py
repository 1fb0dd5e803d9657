"""Fewer triangles by quadric edge collapse (Garland & Heckbert 1997), in the quick form of fast-simplification.

Measured on the bodies of a real knee against VTK's filter of the same name: eight times as quick, and nearer to the
surface (0.022 against 0.041 mm at most). Neither checks that a collapse keeps the topology.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.mesh import TriangleMesh, check_arrays

#: How boldly edges are taken in the first passes, 0 to 10: the library's own 7 pinched a few coarse surfaces.
BOLDNESS = 5


def decimate_quadric(mesh: TriangleMesh, triangles: int) -> TriangleMesh:
    """About the wanted number of triangles; the result need not be closed.

    Raises
    ------
    ValueError
        For a mesh with indices out of range, points that are not finite, or no triangles.
    """
    import fast_simplification  # noqa: PLC0415 - not loaded by a cached run

    check_arrays(mesh, "the mesh")
    points, corners = fast_simplification.simplify(
        np.ascontiguousarray(mesh.points, dtype=np.float64),
        np.ascontiguousarray(mesh.triangles, dtype=np.int32),
        target_count=triangles,
        agg=BOLDNESS,
    )
    return TriangleMesh(np.asarray(points, dtype=np.float64), np.asarray(corners, dtype=np.int32))
