"""The knee of ../shared/data/knee_jam: its bodies, its ligaments and its passive motion as measured by dynamic MR."""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.files.meshes import read_mesh
from pipeline.geometry.mesh import TriangleMesh, merged, transformed
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.direct.prepare import DirectBodies, prepare
from pipeline.kinematics.joint_coordinates import Float, JointCoordinates, joint_coordinates
from pipeline.kinematics.ligaments import NO_FIBRES, Fibres, Ligaments

KNEE = Path(__file__).resolve().parents[3] / "shared" / "data" / "knee_jam"
_REFERENCE = ("femur_frame/femur", "femur_frame/femoral_cartilage")
_MOVING = (
    "tibia_frame/tibia",
    "tibia_frame/tibial_cartilage",
    "tibia_frame/meniscus_lateral",
    "tibia_frame/meniscus_medial",
)

#: From the data's axes (x anterior, y superior, z lateral) to ours (x lateral, y anterior, z proximal).
_OURS_FROM_DATA = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
#: Push along delta while the ligaments pull, newtons: given with the data, not chosen by its motion.
PUSH_N = 10.0
#: Degree in flexion of the polynomials that smooth the frames.
SMOOTH_DEGREE = 2


class Meshes(NamedTuple):
    """The two bodies, each in its frame."""

    reference: TriangleMesh
    moving: TriangleMesh


@cache
def meshes() -> Meshes:
    """Femur with its cartilage; tibia with cartilage and menisci."""
    return Meshes(_body(_REFERENCE), _body(_MOVING))


@cache
def bodies() -> DirectBodies:
    """The same, ready for the direct solver."""
    return prepare(*meshes())


def _body(names: tuple[str, ...]) -> TriangleMesh:
    parts = [read_mesh((KNEE / f"{name}.ply").read_bytes(), f"{name}.ply").mesh for name in names]
    return transformed(merged(parts), _OURS_FROM_DATA)


def fibres(*, pulling: bool) -> Fibres:
    """All fibres of the published model as straight springs; none where they do not pull."""
    return _ligaments().fibres(PUSH_N) if pulling else NO_FIBRES


@cache
def _ligaments() -> Ligaments:
    with (KNEE / "ligaments.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))

    def column(name: str) -> Float:
        return np.array([float(row[name]) for row in rows])

    def points(bone: str) -> Float:
        return np.column_stack([column(f"{bone}_{axis}") for axis in "xyz"]) @ _OURS_FROM_DATA[:3, :3].T

    names = tuple(row["fibre"] for row in rows)
    return Ligaments(
        names, points("femur"), points("tibia"), column("slack_length_mm"), column("stiffness_n_per_strain")
    )


@cache
def frames(*, smoothed: bool) -> tuple[JointCoordinates, ...]:
    """The six coordinates of each measured frame, in the order of flexion.

    Smoothed, every coordinate but flexion is replaced by its least-squares parabola in flexion: the attitude that is
    driven and the pose that is compared with, alike.
    """
    rows = np.genfromtxt(KNEE / "passive_motion.csv", delimiter=",", skip_header=1)[:, 1:].reshape(-1, 4, 4)
    raw = np.array([joint_coordinates(_OURS_FROM_DATA @ frame @ _OURS_FROM_DATA.T) for frame in rows])
    raw = raw[np.argsort(raw[:, 0], kind="stable")]
    return tuple(JointCoordinates(*row) for row in (_parabolas(raw) if smoothed else raw).tolist())


def _parabolas(raw: Float) -> Float:
    flexion = raw[:, 0]
    fits = [np.polyval(np.polyfit(flexion, column, SMOOTH_DEGREE), flexion) for column in raw.T[1:]]
    return np.column_stack([flexion, *fits])


def measured_pose(frame: JointCoordinates) -> Pose:
    """What a solver would have to find at the frame's flexion and varus."""
    return Pose(frame.lateral_mm, frame.anterior_mm, frame.proximal_mm, frame.internal_rotation_rad)


def off_by(pose: Pose, frame: JointCoordinates) -> tuple[float, float, float, float]:
    """Solved minus measured: rotation (deg), lateral, anterior, proximal (mm)."""
    x, y, z, turn = (float(value) for value in np.subtract(pose, measured_pose(frame)))
    return float(np.degrees(turn)), x, y, z
