"""Meshes and masks of known shape, shared by the tests of surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mesh import Float, TriangleMesh

OCTAHEDRON = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float64)
FACES = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]], dtype=np.int32
)


def octahedron(scale_mm: float = 1.0) -> TriangleMesh:
    """Volume 4/3 s3, area 4 sqrt(3) s2."""
    return TriangleMesh(scale_mm * OCTAHEDRON, FACES)


def torus(major_mm: float, minor_mm: float, around: int, across: int) -> TriangleMesh:
    """Closed, genus 1, outward."""
    u, v = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.arange(across) * 2 * np.pi / across, indexing="ij")
    ring = major_mm + minor_mm * np.cos(v)
    points = np.stack([ring * np.cos(u), ring * np.sin(u), minor_mm * np.sin(v)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    a, b = i * across + j, (i + 1) % around * across + j
    c, d = (i + 1) % around * across + (j + 1) % across, i * across + (j + 1) % across
    quads = np.stack([a, b, c, a, c, d], axis=-1)
    return TriangleMesh(points, quads.reshape(-1, 3).astype(np.int32))


def grid(shape: tuple[int, int, int], spacing_mm: tuple[float, float, float]) -> tuple[Float, Float, Float]:
    """Coordinates of voxel centres, mm, with the origin in the middle of the array."""
    axes = [(np.arange(n) - (n - 1) / 2) * s for n, s in zip(shape, spacing_mm, strict=True)]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    return x, y, z


def ball(radius_mm: float, spacing_mm: tuple[float, float, float]) -> NDArray[np.bool_]:
    """Voxels whose centres lie in a ball, touching no border."""
    i, j, k = (int(2 * radius_mm / s) + 6 for s in spacing_mm)
    x, y, z = grid((i, j, k), spacing_mm)
    return np.asarray(x**2 + y**2 + z**2 < radius_mm**2)


def centred(shape: tuple[int, ...], spacing_mm: tuple[float, float, float]) -> Float:
    """(4, 4) from index to millimetres with the origin in the middle of the array."""
    matrix = np.diag([*spacing_mm, 1.0])
    matrix[:3, 3] = -0.5 * (np.array(shape) - 1) * spacing_mm
    return matrix


def turned(axis: tuple[float, float, float], angle_rad: float, shift_mm: tuple[float, float, float]) -> Float:
    """(4, 4) rigid motion (Rodrigues' formula)."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix = np.eye(4)
    matrix[:3, :3] += np.sin(angle_rad) * cross + (1.0 - np.cos(angle_rad)) * cross @ cross
    matrix[:3, 3] = shift_mm
    return matrix
