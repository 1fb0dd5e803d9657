"""From scan space to the kinematic frames in which the bodies are solved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.geometry.mesh import TriangleMesh, transformed
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.joint_coordinates import Float
from pipeline.kinematics.ligaments import Ligaments, slack_from_scan
from pipeline.records import LigamentFibre, Vector

#: Farthest that a fibre may end from its body: some end below the lower border of a scan, mm.
FARTHEST_MM = 40.0

_NO_TRIANGLES = np.zeros((0, 3), dtype=np.int32)


def in_frame(mesh: TriangleMesh, scan_from_frame: Float) -> TriangleMesh:
    """A mesh of scan space in a kinematic frame; outward also where the frame is left-handed."""
    frame_from_scan: Float = np.linalg.inv(scan_from_frame).astype(np.float64)
    return transformed(mesh, frame_from_scan)


def scan_pose(scan_attitude: tuple[float, ...]) -> Pose:
    """Found coordinates of the scan from its six (flexion, varus, rotation in deg; lateral, anterior, proximal)."""
    _, _, rotation, lateral, anterior, proximal = scan_attitude
    return Pose(lateral, anterior, proximal, float(np.radians(rotation)))


def ligaments_in_frames(
    fibres: Sequence[LigamentFibre],
    scan_from_reference: Float,
    scan_from_moving: Float,
    reference_strain: float = 0.0,
) -> Ligaments:
    """Fibres of scan space with their attachments in the kinematic frames, also where those are left-handed.

    Parameters
    ----------
    fibres : sequence of LigamentFibre
    scan_from_reference, scan_from_moving : (4, 4) float64
    reference_strain : float
        How far springs without a slack length of their own are stretched at the scan pose; above -1.
    """
    reference, moving = ([getattr(fibre, body) for fibre in fibres] for body in ("reference", "moving"))
    stiffness = np.array([np.inf if fibre.stiffness_n is None else fibre.stiffness_n for fibre in fibres], dtype=float)
    given = np.array([np.nan if fibre.slack_mm is None else fibre.slack_mm for fibre in fibres], dtype=float)
    scan_length = np.linalg.norm(_points(reference) - _points(moving), axis=1)
    return Ligaments(
        names=tuple(fibre.name for fibre in fibres),
        on_reference=_points_in_frame(reference, scan_from_reference),
        on_moving=_points_in_frame(moving, scan_from_moving),
        slack_mm=np.where(np.isnan(given), slack_from_scan(scan_length, stiffness, reference_strain), given),
        stiffness_n=stiffness,
    )


def stray_fibre(ligaments: Ligaments, reference: TriangleMesh, moving: TriangleMesh) -> str | None:
    """One sentence on the first fibre that ends far from its body (both in their frames); None when all end near."""
    for name, *ends in zip(ligaments.names, ligaments.on_reference, ligaments.on_moving, strict=True):
        for end, body, title in zip(ends, (reference, moving), ("reference", "moving"), strict=True):
            away = float(np.linalg.norm(body.points - end, axis=1).min())
            if away > FARTHEST_MM:
                return f"Fibre {name} ends {away:.0f} mm from the {title} body, expected at most {FARTHEST_MM:.0f} mm."
    return None


def _points(positions: list[Vector]) -> Float:
    return np.array(positions, dtype=np.float64).reshape(-1, 3)


def _points_in_frame(positions: list[Vector], scan_from_frame: Float) -> Float:
    """(K, 3) moved just as the bodies are, so that a mirrored case gives the same numbers."""
    return in_frame(TriangleMesh(_points(positions), _NO_TRIANGLES), scan_from_frame).points
