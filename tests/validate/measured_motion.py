"""A real knee's measured passive motion (dynamic MR) against poses solved at its own flexion and varus.

The bodies and the 60 measured frames are in ../shared/data/knee_jam; nothing is fitted to them. Only the constant push
along the tibia's own axis is modelled: no cruciates.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from pipeline.adapters.contact_pool import ContactPair
from pipeline.files.meshes import read_mesh
from pipeline.geometry.mesh import TriangleMesh, merged, transformed
from pipeline.kinematics.contact import AttitudeContact, Bodies, Pose
from pipeline.kinematics.incremental import IncrementalSettings, solve_incremental
from pipeline.kinematics.joint_coordinates import Float, JointCoordinates, joint_coordinates
from pipeline.kinematics.table import Status
from tests.validate import Measurement, Row

KNEE = Path(__file__).resolve().parents[3] / "shared" / "data" / "knee_jam"
REFERENCE = ("femur_frame/femur", "femur_frame/femoral_cartilage")
MOVING = (
    "tibia_frame/tibia",
    "tibia_frame/tibial_cartilage",
    "tibia_frame/meniscus_lateral",
    "tibia_frame/meniscus_medial",
)

#: From the data's axes (x anterior, y superior, z lateral) to ours (x lateral, y anterior, z proximal).
OURS_FROM_DATA = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def _body(names: tuple[str, ...]) -> TriangleMesh:
    meshes = [read_mesh((KNEE / f"{name}.ply").read_bytes(), f"{name}.ply").mesh for name in names]
    return transformed(merged(meshes), OURS_FROM_DATA)


def measured_frames() -> list[JointCoordinates]:
    """The six coordinates of each measured frame."""
    rows = np.genfromtxt(KNEE / "passive_motion.csv", delimiter=",", skip_header=1)[:, 1:].reshape(-1, 4, 4)
    return [joint_coordinates(OURS_FROM_DATA @ frame @ OURS_FROM_DATA.T) for frame in rows]


def _solved(bodies: Bodies, frames: list[JointCoordinates]) -> list[Pose | None]:
    """Stable pose of every frame's attitude, each started from the frame before it; the first from the measurement."""
    start, found = _measured(frames[0]), list[Pose | None]()
    for frame in frames:
        contact = AttitudeContact(bodies, frame.flexion_rad, frame.varus_rad)
        answer = solve_incremental(contact, start, IncrementalSettings(), _measured(frame))
        found.append(answer.pose if answer.status is Status.OK else None)
        start = answer.pose if answer.status is Status.OK else start
    return found


def _measured(frame: JointCoordinates) -> Pose:
    return Pose(frame.lateral_mm, frame.anterior_mm, frame.proximal_mm, frame.internal_rotation_rad)


@cache
def differences() -> Float:
    """(N, 4) solved minus measured: rotation (deg), lateral, anterior, proximal (mm); NaN where no pose was found."""
    frames = measured_frames()
    solved = _solved(ContactPair(_body(REFERENCE), _body(MOVING), 5.0).bodies(), frames)
    rows = []
    for frame, pose in zip(frames, solved, strict=True):
        off = np.full(4, np.nan) if pose is None else np.subtract(pose, _measured(frame))
        rows.append([np.degrees(off[3]), *off[:3]])
    return np.array(rows)


def _rms(column: int) -> float:
    return float(np.sqrt(np.mean(differences()[:, column] ** 2)))


def rotation() -> Row:
    """Internal rotation, RMS over the frames."""
    return Row("knee_jam, measured motion: rotation", _rms(0), "deg", 4.0)


def lateral() -> Row:
    """Mediolateral position, RMS over the frames."""
    return Row("knee_jam, measured motion: mediolateral", _rms(1), "mm", 1.0)


def anterior() -> Row:
    """Anteroposterior position, RMS over the frames."""
    return Row("knee_jam, measured motion: anteroposterior", _rms(2), "mm", 2.5)


def proximal() -> Row:
    """Proximodistal position, RMS over the frames."""
    return Row("knee_jam, measured motion: proximodistal", _rms(3), "mm", 0.6)


ROWS: tuple[Measurement, ...] = (rotation, lateral, anterior, proximal) if KNEE.exists() else ()
