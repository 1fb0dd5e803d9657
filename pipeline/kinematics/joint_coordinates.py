"""Joint coordinates of Grood & Suntay (1983), with the frames and signs of the whole project.

Frames: x lateral, y anterior, z proximal; the moving frame's z is delta. In these coordinates a left joint is a right
one (its frames in scan space are left-handed). Flexion +, varus +, internal rotation +; translations of the moving
body: lateral +, anterior +, proximal +.

    p_reference = A(flexion, varus) . ( Rz(rotation) . p_moving + d ),    A = Rx(-flexion) . Ry(varus)

The frame between A and Rz is the *attitude frame*: the reference is turned into it once, and the moving body turns
about its z and shifts by d = (lateral, anterior, proximal).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


class JointCoordinates(NamedTuple):
    """The six coordinates of a pose; angles in radians, lengths in millimetres."""

    flexion_rad: float
    varus_rad: float
    internal_rotation_rad: float
    lateral_mm: float
    anterior_mm: float
    proximal_mm: float


def rotation_x(angle_rad: float) -> Float:
    """(3, 3) rotation about x."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_y(angle_rad: float) -> Float:
    """(3, 3) rotation about y."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rotation_z(angle_rad: float) -> Float:
    """(3, 3) rotation about z."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def attitude_rotation(flexion_rad: float, varus_rad: float) -> Float:
    """A = Rx(-flexion) . Ry(varus): (3, 3), takes the attitude frame to the reference frame."""
    return rotation_x(-flexion_rad) @ rotation_y(varus_rad)


def rigid(rotation: Float, shift: Float) -> Float:
    """(4, 4) transform of a rotation (3, 3) and a shift (3,)."""
    out = np.eye(4)
    out[:3, :3] = rotation
    out[:3, 3] = shift
    return out


def reference_from_moving(pose: JointCoordinates) -> Float:
    """(4, 4) transform of moving-frame points to the reference frame, from the six coordinates."""
    attitude = attitude_rotation(pose.flexion_rad, pose.varus_rad)
    return rigid(attitude @ rotation_z(pose.internal_rotation_rad), attitude @ np.asarray(pose[3:], dtype=np.float64))


def joint_coordinates(reference_from_moving: Float) -> JointCoordinates:
    """The six coordinates of a (4, 4) proper motion; the inverse of :func:`reference_from_moving`.

    Varus lies in [-90, 90] deg; at exactly +-90 deg flexion and rotation are not separable.
    """
    r = reference_from_moving[:3, :3]
    flexion = np.arctan2(r[1, 2], r[2, 2])
    varus = np.arcsin(np.clip(r[0, 2], -1.0, 1.0))
    rotation = np.arctan2(-r[0, 1], r[0, 0])
    shift = attitude_rotation(flexion, varus).T @ reference_from_moving[:3, 3]
    return JointCoordinates(float(flexion), float(varus), float(rotation), *map(float, shift))


def moved_from_scan(scan_from_reference: Float, scan_from_moving: Float, pose: JointCoordinates) -> Float:
    """(4, 4) motion of the moving body's points, as scanned, to their place at ``pose``; scan space.

    A proper motion for either side: both frames are left-handed for a left joint.
    """
    return scan_from_reference @ reference_from_moving(pose) @ np.linalg.inv(scan_from_moving)
