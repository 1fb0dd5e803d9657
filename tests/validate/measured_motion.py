"""A real knee's measured passive motion (dynamic MR) against poses solved at its own flexion and varus.

The bodies, the 60 measured frames and 55 ligament fibres are in ../shared/data/knee_jam; nothing is fitted to them.
Solved without ligaments (the method's constant push along the tibia's own axis) and with the fibres as springs against
a push of 10 N; at the raw attitudes of the frames, and at attitudes smoothed by a quadratic in flexion, for the frames
themselves carry noise of about 1 deg and 0.5 mm (the truth is then smoothed the same way).
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from pipeline.files.meshes import read_mesh
from pipeline.geometry.mesh import TriangleMesh, merged, transformed
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.direct.prepare import prepare
from pipeline.kinematics.direct.solver import DirectSolver
from pipeline.kinematics.joint_coordinates import Float, joint_coordinates
from pipeline.kinematics.ligaments import NO_FIBRES, Fibres, Ligaments
from tests.validate import Measurement, Row

KNEE = Path(__file__).resolve().parents[3] / "shared" / "data" / "knee_jam"
REFERENCE = ("femur_frame/femur", "femur_frame/femoral_cartilage")
MOVING = (
    "tibia_frame/tibia",
    "tibia_frame/tibial_cartilage",
    "tibia_frame/meniscus_lateral",
    "tibia_frame/meniscus_medial",
)
PUSH_N = 10.0
PICTURE = Path("build/validate/measured_motion.png")

#: From the data's axes (x anterior, y superior, z lateral) to ours (x lateral, y anterior, z proximal).
OURS_FROM_DATA = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


class Variant(NamedTuple):
    """How the motion is solved."""

    ligaments: bool
    smoothed: bool


def given_mesh(name: str) -> TriangleMesh:
    """A mesh of the folder as it is given, in the axes of the data."""
    return read_mesh((KNEE / f"{name}.ply").read_bytes(), f"{name}.ply").mesh


def frame_matrices() -> Float:
    """(N, 4, 4) ``femur_from_tibia`` of each frame, mm, in the axes of the data."""
    rows = np.genfromtxt(KNEE / "passive_motion.csv", delimiter=",", skip_header=1)
    return np.asarray(rows[:, 1:].reshape(-1, 4, 4))


def body_of(names: tuple[str, ...]) -> TriangleMesh:
    """Several meshes as one body, in our axes."""
    return transformed(merged([given_mesh(name) for name in names]), OURS_FROM_DATA)


@cache
def measured_frames() -> Float:
    """(N, 6) flexion, varus, internal rotation (rad), lateral, anterior, proximal (mm) of each frame."""
    return np.array([joint_coordinates(OURS_FROM_DATA @ frame @ OURS_FROM_DATA.T) for frame in frame_matrices()])


def smoothed_frames() -> Float:
    """The frames with every coordinate but flexion replaced by its quadratic in flexion."""
    frames = measured_frames().copy()
    for column in range(1, 6):
        frames[:, column] = np.polyval(np.polyfit(frames[:, 0], frames[:, column], 2), frames[:, 0])
    return frames


def fibres() -> Fibres:
    """The 55 fibres of the published model, slack lengths and stiffnesses as published."""
    rows = np.genfromtxt(KNEE / "ligaments.csv", delimiter=",", skip_header=1)[:, 1:]
    axes = OURS_FROM_DATA[:3, :3]
    names = tuple(f"fibre {k}" for k in range(len(rows)))
    return Ligaments(names, rows[:, :3] @ axes.T, rows[:, 3:6] @ axes.T, rows[:, 6], rows[:, 7]).fibres(PUSH_N)


@cache
def differences(variant: Variant) -> Float:
    """(N, 4) solved minus measured: rotation (deg), lateral, anterior, proximal (mm); NaN where no pose was found."""
    frames = smoothed_frames() if variant.smoothed else measured_frames()
    bodies = prepare(body_of(REFERENCE), body_of(MOVING))
    solver = DirectSolver(bodies, fibres=fibres() if variant.ligaments else NO_FIBRES)
    start, rows = pose_of(frames[0]), []
    for frame in frames:
        found = solver.at((float(frame[0]), float(frame[1]))).solve(start, pose_of(frame))
        if found.status.usable:
            start = found.pose
            x, y, z, turn = np.subtract(found.pose, pose_of(frame))
            rows.append([np.degrees(turn), x, y, z])
        else:
            rows.append([np.nan] * 4)
    return np.array(rows)


def pose_of(frame: Float) -> Pose:
    """The found coordinates of a frame."""
    _, _, turn, x, y, z = (float(value) for value in frame)
    return Pose(x, y, z, turn)


def _rows(variant: Variant, key: str, limits: tuple[float, ...]) -> tuple[Measurement, ...]:
    """RMS over the frames of each coordinate; the limits are what earlier throw-away trials reached, with some room."""
    where = f"{'with' if variant.ligaments else 'no'} ligaments, {'smoothed' if variant.smoothed else 'raw'}"

    def measure(column: int, part: str, name: str, unit: str) -> Measurement:
        def row() -> Row:
            rms = float(np.sqrt(np.mean(differences(variant)[:, column] ** 2)))
            return Row(f"{key}_{part}", f"knee_jam, {where}: {name}", rms, unit, limits[column])

        return row

    return (
        measure(0, "theta_deg", "rotation", "deg"),
        measure(1, "ml_mm", "mediolateral", "mm"),
        measure(2, "ap_mm", "anteroposterior", "mm"),
        measure(3, "pd_mm", "proximodistal", "mm"),
    )


def picture() -> Row:
    """Draw measured and solved motion over flexion; the row counts frames without a stable pose."""
    frames, size = np.degrees(measured_frames()[:, 0]), (11.0, 6.5)
    missing = 0
    figure = Figure(figsize=size, layout="constrained")
    for axes, column, title in zip(
        figure.subplots(2, 2).ravel(),
        range(4),
        ("Internal rotation (deg)", "Lateral (mm)", "Anterior (mm)", "Proximal (mm)"),
        strict=True,
    ):
        truth = smoothed_frames()
        wanted = np.column_stack([np.degrees(truth[:, 2]), truth[:, 3:]])[:, column]
        raw = np.column_stack([np.degrees(measured_frames()[:, 2]), measured_frames()[:, 3:]])[:, column]
        axes.plot(frames, raw, ".", color="0.6", label="measured, raw")
        axes.plot(frames, wanted, color="0.2", label="measured, smoothed")
        for ligaments, colour in ((False, "#d55e00"), (True, "#0072b2")):
            off = differences(Variant(ligaments, smoothed=True))[:, column]
            missing = max(missing, int(np.isnan(off).sum()))
            axes.plot(
                frames,
                wanted + off,
                ".-",
                color=colour,
                label="solved, 55 fibres" if ligaments else "solved, push only",
            )
        axes.set(title=title, xlabel="Flexion (deg)")
    figure.axes[0].legend(fontsize=8)
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(PICTURE, dpi=100)
    return Row("jam_without_pose", "knee_jam: frames without a stable pose", float(missing), "", 0.0)


ROWS: tuple[Measurement, ...] = (
    (
        *_rows(Variant(ligaments=False, smoothed=False), "jam_bare_raw", (5.0, 1.0, 2.6, 0.6)),
        *_rows(Variant(ligaments=False, smoothed=True), "jam_bare", (5.0, 1.0, 2.6, 0.2)),
        *_rows(Variant(ligaments=True, smoothed=False), "jam_raw", (2.0, 1.2, 1.4, 0.6)),
        *_rows(Variant(ligaments=True, smoothed=True), "jam", (1.5, 1.2, 0.7, 0.2)),
        picture,
    )
    if KNEE.exists()
    else ()
)
