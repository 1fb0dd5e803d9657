"""Where the phantom stands: the pose of its tibia, the sides, and the patient space.

The pose is written out here anew, so that the phantom is a reference of its own for the joint coordinates elsewhere.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.records import Side, Vector

Float = NDArray[np.float64]


class KneePose(NamedTuple):
    """Tibia against femur after Grood & Suntay (1983): flexion +, varus +, internal rotation +.

    ``shift_mm`` is lateral, anterior, proximal in the attitude frame.
    """

    flexion_deg: float
    varus_deg: float
    internal_rotation_deg: float
    shift_mm: Vector


def reference_from_moving(pose: KneePose) -> Float:
    """(4, 4) motion of tibial points into the femoral frame: Rx(-flexion) Ry(varus) (Rz(rotation) p + shift)."""
    attitude = Rotation.from_euler("XY", [-pose.flexion_deg, pose.varus_deg], degrees=True)
    rotation = attitude * Rotation.from_euler("Z", pose.internal_rotation_deg, degrees=True)
    return affine(rotation.as_matrix(), attitude.apply(pose.shift_mm))


def moving_from_attitude(pose: KneePose) -> Float:
    """(3, 3) rotation from the attitude frame into the tibia's."""
    return np.asarray(Rotation.from_euler("Z", -pose.internal_rotation_deg, degrees=True).as_matrix())


def body_from_reference(side: Side) -> Float:
    """(4, 4) upright body axes (left, posterior, superior) from the femoral frame; a mirror for a left knee."""
    return np.diag([-1.0 if side == "right" else 1.0, -1.0, 1.0, 1.0])


def lps_from_body(spec: PhantomSpec) -> Float:
    """(4, 4) placement of the upright body axes in the patient space."""
    return affine(turned(spec.placement_deg), np.asarray(spec.placement_mm, dtype=np.float64))


def turned(angles_deg: Vector) -> Float:
    """(3, 3) rotation about x, then y, then z, which stay fixed; exactly the identity for zeros."""
    return np.asarray(Rotation.from_euler("xyz", angles_deg, degrees=True).as_matrix())


def affine(matrix: Float, shift: Float) -> Float:
    """(4, 4) transform of a matrix (3, 3) and a shift (3,)."""
    out = np.eye(4)
    out[:3, :3] = matrix
    out[:3, 3] = shift
    return out


def moved(transform: Float, points: Float) -> Float:
    """Points (3, N) after a (4, 4) transform.

    Written out, because a matrix product may round a point differently by its place in the array.
    """
    x, y, z = points
    return np.stack([row[0] * x + row[1] * y + row[2] * z + row[3] for row in transform[:3]])
