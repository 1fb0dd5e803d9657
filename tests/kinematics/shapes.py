"""Bodies with a known answer, in kinematic frames: z is delta, the reference lies where z is large."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from pipeline.adapters.fcl_contact import FclBodies
from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.validation_objects import ValidationPair
from pipeline.kinematics.contact import AttitudeContact, Pose

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


@dataclass(frozen=True)
class HelicalGroove:
    """A runner on two tips in a groove on the inside of a hollow cylinder about the flexion axis.

    The groove's bottom runs along x = bend s^2 / 2 at the angle s around the cylinder, so that flexion dictates place
    and rotation of the runner: its tips lie on the bottom at the same height, half a span before and behind.
    """

    radius_mm: float = 20.0
    bend_mm: float = 8.0
    reach_mm: float = 6.0

    def reference_body(self) -> TriangleMesh:
        """Three points across the groove, three outside, swept around the cylinder from -60 to 60 degrees."""
        width, depth, wall = 5.0, 5.0, 5.0
        across = np.array([-width, 0.0, width, width, 0.0, -width])
        rho = self.radius_mm + np.array([-depth, 0.0, -depth, wall, wall, wall])
        s = np.radians(np.linspace(-60.0, 60.0, 481))[:, None]
        x = 0.5 * self.bend_mm * s**2 + across
        points = np.stack([x, rho * np.sin(s), rho * np.cos(s)], axis=-1).reshape(-1, 3)
        caps = np.array([(0, 4, 1), (0, 5, 4), (1, 3, 2), (1, 4, 3)])
        ring = [(k, (k + 1) % 6) for k in range(6)]
        strip = np.array([corner for a, b in ring for corner in ((a, b, a + 6), (b, b + 6, a + 6))])
        sides = (strip + 6 * np.arange(480)[:, None, None]).reshape(-1, 3)
        return TriangleMesh(points, np.vstack([caps[:, ::-1], sides[:, ::-1], caps + 6 * 480]).astype(np.int32))

    def moving_body(self) -> TriangleMesh:
        """Two slender pyramids, their tips at ``reach_mm`` before and behind the origin."""
        tip = convex([(0.0, 0.0, 0.0), *((x, y, -8.0) for x in (-1.0, 1.0) for y in (-1.0, 1.0))])
        return joined(shifted(tip, y=-self.reach_mm), shifted(tip, y=self.reach_mm))

    def rest(self, flexion_rad: float) -> Pose:
        """Closed form, apart from the half span, which a fixed-point iteration finds."""
        half = np.arcsin(self.reach_mm / self.radius_mm)
        for _ in range(50):
            turn = np.arctan2(-self.bend_mm * flexion_rad * half, self.radius_mm * np.sin(half))
            half = np.arcsin(self.reach_mm * np.cos(turn) / self.radius_mm)
        x = 0.5 * self.bend_mm * (flexion_rad**2 + half**2)
        return Pose(float(x), 0.0, float(self.radius_mm * np.cos(half)), float(turn))
