"""Knees and bone ends of known anatomy, shared by the tests of the anatomy."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np
import trimesh

from pipeline.adapters.mask_surface import SurfaceSettings, mask_to_mesh
from pipeline.geometry.mesh import Float, TriangleMesh, merged, transformed
from pipeline.geometry.phantom import PHANTOM_LABELS, PhantomTruth, phantom_labels, phantom_truth
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.geometry.validation_objects import revolved
from pipeline.kinematics.joint_coordinates import rotation_x, rotation_y, rotation_z
from tests.kinematics.shapes import shifted

SPEC = PhantomSpec(
    spacing_mm=(1.4, 1.4, 1.4),
    shaft_length_mm=45.0,
    varus_deg=2.0,
    placement_deg=(5.0, -10.0, 20.0),
    placement_mm=(30.0, -20.0, 100.0),
)
MESHED = ("femur", "tibia", "patella", "fibula", "medial_meniscus", "lateral_meniscus")
#: Patient's left to patient's right.
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


@cache
def phantom_knee() -> tuple[Mapping[str, TriangleMesh], PhantomTruth]:
    """Structures of a coarse right phantom knee, meshed as the pipeline does it, and what is true of it."""
    volume = phantom_labels(SPEC)
    settings = SurfaceSettings(triangles=4000)
    meshes = {
        name: mask_to_mesh(volume.values == PHANTOM_LABELS[name], volume.lps_from_index, settings).mesh
        for name in MESHED
    }
    return meshes, phantom_truth(SPEC)


def moved(structures: Mapping[str, TriangleMesh], new_from_old: Float) -> dict[str, TriangleMesh]:
    return {name: transformed(mesh, new_from_old) for name, mesh in structures.items()}


def sphere(radius_mm: float, centre_mm: tuple[float, float, float] = (0.0, 0.0, 0.0), fine: int = 4) -> TriangleMesh:
    """A geodesic sphere: its vertices lie on the sphere exactly."""
    made = trimesh.creation.icosphere(subdivisions=fine, radius=radius_mm)
    points = np.asarray(made.vertices, dtype=np.float64) + centre_mm
    return TriangleMesh(points, np.asarray(made.faces, dtype=np.int32))


def sphere_femur(
    medial_mm: tuple[float, float, float], lateral_mm: tuple[float, float, float], stretch: float = 1.0
) -> TriangleMesh:
    """Two condyles of 21 and 19 mm under a shaft in front of them; x lateral, y anterior, z proximal.

    With a stretch other than 1 the condyles are ellipsoids, longer across the flexion axis on the medial side only.
    """
    medial = sphere(21.0)
    medial = TriangleMesh(medial.points * [1.0, stretch, 1.0] + medial_mm, medial.triangles)
    shaft = shifted(revolved(np.array([[0.0, 30.0], [14.0, 30.0], [14.0, 110.0], [0.0, 110.0]]), 24), y=8.0)
    return merged([medial, sphere(19.0, lateral_mm), shaft])


def about(x_deg: float, y_deg: float, z_deg: float) -> Float:
    """(3, 3) rotation about x, then y, then z."""
    x, y, z = np.radians([x_deg, y_deg, z_deg])
    return np.asarray(rotation_z(z) @ rotation_y(y) @ rotation_x(x))
