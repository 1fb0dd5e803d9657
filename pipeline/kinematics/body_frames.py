"""From scan space to the kinematic frames in which the bodies are solved."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.mesh import TriangleMesh, transformed
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.joint_coordinates import Float


def in_frame(mesh: TriangleMesh, scan_from_frame: Float) -> TriangleMesh:
    """A mesh of scan space in a kinematic frame; outward also where the frame is left-handed."""
    frame_from_scan: Float = np.linalg.inv(scan_from_frame).astype(np.float64)
    return transformed(mesh, frame_from_scan)


def scan_pose(scan_attitude: tuple[float, ...]) -> Pose:
    """Found coordinates of the scan from its six (flexion, varus, rotation in deg; lateral, anterior, proximal)."""
    _, _, rotation, lateral, anterior, proximal = scan_attitude
    return Pose(lateral, anterior, proximal, float(np.radians(rotation)))
