"""A real knee's measured passive motion against poses solved at its own flexion and varus; nothing is fitted to it.

Without ligaments, the method of the paper: a constant push along the tibia's own axis. With them, the fibres of the
published model pull beside a push of 10 N.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.adapters.fcl_contact import FclBodies
from pipeline.adapters.plotting import Chart, Curve, charts_png
from pipeline.adapters.threads import map_threads
from pipeline.kinematics.contact import AttitudeContact, Pose
from pipeline.kinematics.direct.solver import DirectSolver
from pipeline.kinematics.incremental import IncrementalSettings, solve_incremental
from pipeline.kinematics.joint_coordinates import Float
from pipeline.kinematics.table import Status
from tests.validate import Measurement, Row, Table
from tests.validate.jam_knee import KNEE, bodies, fibres, frames, measured_pose, meshes, off_by

PICTURE = Path("build/validate/measured_motion.png")
#: Every so many frames are solved by the incremental solver too.
CHECKED_EVERY = 12


class Condition(NamedTuple):
    """One way to solve the frames, and the most that its RMS may be: rotation (deg), ML, AP, PD (mm)."""

    key: str
    name: str
    smoothed: bool
    pulling: bool
    targets: tuple[float, float, float, float]


CONDITIONS = (
    Condition("jam", "ligaments, smoothed frames", True, True, (1.5, 1.2, 0.7, 0.2)),
    Condition("jam_raw", "ligaments, raw frames", False, True, (2.0, 1.2, 1.3, 0.45)),
    Condition("jam_bare", "no ligaments, smoothed frames", True, False, (5.0, 1.2, 2.5, 0.2)),
    Condition("jam_raw_bare", "no ligaments, raw frames", False, False, (5.5, 1.2, 3.0, 0.45)),
)
COORDINATES = (("theta", "rotation", "deg"), ("ml", "ML", "mm"), ("ap", "AP", "mm"), ("pd", "PD", "mm"))


class Solved(NamedTuple):
    """All frames of one condition, in the order of flexion; NaN where no stable pose was found.

    Attributes
    ----------
    off : (N, 4) float64
        Solved minus measured: rotation (deg), lateral, anterior, proximal (mm).
    residual : (N,) float64
        Of the equilibrium certificate.
    """

    off: Float
    residual: Float


@cache
def solved() -> dict[str, Solved]:
    """Every condition, by its key."""
    bodies()  # once, not once a thread
    return dict(zip([one.key for one in CONDITIONS], map_threads(_solve, CONDITIONS, 2), strict=True))


def _solve(condition: Condition) -> Solved:
    """Each frame started from the pose of the frame before it; the first from the measurement."""
    solver = DirectSolver(bodies(), fibres=fibres(pulling=condition.pulling))
    start, rows = Pose(0.0, 0.0, 0.0, 0.0), list[tuple[float, ...]]()
    for count, frame in enumerate(frames(smoothed=condition.smoothed)):
        measured = measured_pose(frame)
        held = solver.at((frame.flexion_rad, frame.varus_rad))
        found = held.solve(start if count else measured, measured)
        if found.status is not Status.OK:
            rows.append(5 * (np.nan,))
            continue
        start = found.pose
        rows.append((*off_by(start, frame), held.certify(start).residual))
    table = np.array(rows)
    return Solved(table[:, :4], table[:, 4])


def errors() -> Iterator[Row | Table]:
    """RMS of each condition against its bound; then all of RMS, mean and worst."""
    lines = dict[str, list[float]]()
    for condition in CONDITIONS:
        off = solved()[condition.key].off
        rms = np.sqrt(np.mean(off**2, axis=0))
        for k, (short, name, unit) in enumerate(COORDINATES):
            title = f"knee_jam, {condition.name}: {name}"
            yield Row(f"{condition.key}_{short}_{unit}", title, float(rms[k]), unit, condition.targets[k])
        for word, values in (("RMS", rms), ("mean", off.mean(axis=0)), ("worst", np.abs(off).max(axis=0))):
            lines[f"{condition.name}, {word}"] = values.tolist()
    columns = [f"{name} ({unit})" for _, name, unit in COORDINATES]
    yield Table("jam_table", "knee_jam: solved minus measured, 60 frames", columns, lines)


def certificates() -> Iterator[Row]:
    """What the contacts do not balance of a unit push, with the pull of the fibres."""
    for key, name in (("jam", "certificate_median_jam"), ("jam_bare", "certificate_median_jam_bare")):
        condition = next(one for one in CONDITIONS if one.key == key)
        residual = float(np.median(solved()[key].residual))
        yield Row(name, f"knee_jam, {condition.name}: median certificate", residual, "", 0.01)


def other_solver() -> Iterator[Row]:
    """The paper's solver at some frames from the same starts: never deeper than the direct one."""
    for condition in CONDITIONS[::2]:
        pairs = np.array(_both_solvers(condition))
        shallower = float(np.max(pairs[:, 0]))
        name = f"knee_jam, {condition.name}: incremental solver"
        yield Row(f"{condition.key}_shallower_mm", f"{name} deeper by", shallower, "mm", 0.02)
        yield Row(f"{condition.key}_solvers_deg", f"{name} elsewhere, median", float(np.median(pairs[:, 1])), "deg")


def _both_solvers(condition: Condition) -> list[tuple[float, float]]:
    """For some frames, how much more merit (mm) the incremental solver finds, and the difference of rotation (deg)."""
    shape, pull, rows = FclBodies(*meshes()), fibres(pulling=condition.pulling), []
    solver = DirectSolver(bodies(), fibres=pull)
    for frame in frames(smoothed=condition.smoothed)[CHECKED_EVERY // 2 :: CHECKED_EVERY]:
        measured, angles = measured_pose(frame), (frame.flexion_rad, frame.varus_rad)
        contact = AttitudeContact(shape, *angles, pull)
        slow = solve_incremental(contact, measured, IncrementalSettings(), measured)
        quick = solver.at(angles).solve(measured, measured)
        more = contact.merit(slow.pose) - contact.merit(quick.pose)
        rows.append((more, float(np.degrees(abs(slow.pose.theta - quick.pose.theta)))))
    return rows


def picture() -> Iterator[Row]:
    """Draw measured and solved coordinates over flexion; no figure."""
    raw, smooth = np.array(frames(smoothed=False)), np.array(frames(smoothed=True))
    charts = []
    for k, (title, column, unit) in enumerate(
        (("Internal rotation", 2, "deg"), ("Lateral", 3, "mm"), ("Anterior", 4, "mm"), ("Proximal", 5, "mm"))
    ):
        shown = np.degrees if unit == "deg" else np.asarray
        flexion, truth = np.degrees(smooth[:, 0]), shown(smooth[:, column])
        curves = [
            Curve(flexion, shown(raw[:, column]), "#555555", "dots", "measured"),
            Curve(flexion, truth, "#555555", "dashed", "measured, smoothed"),
            Curve(flexion, truth + solved()["jam_bare"].off[:, k], "#d55e00", "line", "solved without ligaments"),
            Curve(flexion, truth + solved()["jam"].off[:, k], "#0072b2", "line", "solved with ligaments"),
        ]
        charts.append(Chart(f"{title} ({unit})", "Flexion (deg)", unit, curves))
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    PICTURE.write_bytes(charts_png("knee_jam: passive motion, measured and solved", str(PICTURE.name), charts))
    yield from ()


MEASUREMENTS: tuple[Measurement, ...] = (errors, certificates, other_solver, picture) if KNEE.exists() else ()
