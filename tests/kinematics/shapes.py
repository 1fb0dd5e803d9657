"""Bodies with a known answer, in kinematic frames: z is delta, the reference lies where z is large."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from pipeline.adapters.fcl_contact import FclBodies
from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.validation_objects import ValidationPair
from pipeline.kinematics.contact import AttitudeContact

Float = NDArray[np.float64]


def convex(points: Sequence[Sequence[float]] | Float) -> TriangleMesh:
    """The convex hull of points, outward normals."""
    corners = np.asarray(points, dtype=np.float64)
    triangles = ConvexHull(corners).simplices.copy()
    a, b, c = np.moveaxis(corners[triangles], 1, 0)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a - corners.mean(axis=0)) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return TriangleMesh(corners, triangles.astype(np.int32))


def joined(*meshes: TriangleMesh) -> TriangleMesh:
    """Several closed pieces as one body."""
    starts = np.cumsum([0, *(len(mesh.points) for mesh in meshes[:-1])])
    triangles = [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=True)]
    return TriangleMesh(np.vstack([mesh.points for mesh in meshes]), np.vstack(triangles).astype(np.int32))


def shifted(mesh: TriangleMesh, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> TriangleMesh:
    return TriangleMesh(mesh.points + np.array([x, y, z]), mesh.triangles)


def turned_down(mesh: TriangleMesh) -> TriangleMesh:
    """A mesh made with z up, with z down (half a turn about x)."""
    return TriangleMesh(mesh.points * [1.0, -1.0, -1.0], mesh.triangles)


def scaled(mesh: TriangleMesh, factors: Sequence[float]) -> TriangleMesh:
    return TriangleMesh(mesh.points * np.asarray(factors), mesh.triangles)


def at_attitude(
    reference: TriangleMesh, moving: TriangleMesh, flexion_rad: float = 0.0, varus_rad: float = 0.0
) -> AttitudeContact:
    return AttitudeContact(FclBodies(reference, moving), flexion_rad, varus_rad)


def falling(pair: ValidationPair) -> AttitudeContact:
    """A test object of the paper at attitude 0/0."""
    return at_attitude(pair.reference_body, pair.moving_body)


def groove(half_length: float = 10.0) -> TriangleMesh:
    """A solid with a V-shaped groove along y, walls at 45 degrees, its bottom line through the origin."""
    size = half_length
    outline = np.array([(0.0, 0.0), (size, -size), (size, 5.0), (-size, 5.0), (-size, -size)])
    points = np.array([(x, y, z) for y in (-size, size) for x, z in outline])
    caps = [(0, k, k + 1) for k in (1, 2, 3)] + [(5, 6 + k, 5 + k) for k in (1, 2, 3)]
    around = [(k, (k + 1) % 5) for k in range(5)]
    sides = [corner for a, b in around for corner in ((a, a + 5, b), (b, a + 5, b + 5))]
    return TriangleMesh(points, np.array(caps + sides, dtype=np.int32))


def ellipsoid(semi_axes: Sequence[float], count: int = 400) -> TriangleMesh:
    """A convex polyhedron with its corners on an ellipsoid, evenly spread (Fibonacci lattice)."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    across = np.sqrt(1.0 - z * z)
    return convex(np.column_stack([across * np.cos(turn), across * np.sin(turn), z]) * np.asarray(semi_axes))
