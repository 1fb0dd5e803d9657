"""The measured passive motion with flexion alone given: varus, too, is where the knee comes to rest.

Rest is then a maximum over varus of what a stable pose is a maximum of: depth along delta less the fibres' energy.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from pipeline.adapters.threads import map_threads
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.direct.solver import DirectSolver
from pipeline.kinematics.joint_coordinates import Float, JointCoordinates, attitude_rotation
from pipeline.kinematics.ligaments import fibre_load
from pipeline.kinematics.table import Status
from tests.validate import Measurement, Row, Table
from tests.validate.jam_knee import KNEE, bodies, fibres, frames, measured_pose, off_by

#: Varus looked at first, deg; then the best of them is refined between its neighbours.
TRIED_DEG = np.arange(-4.0, 6.5, 1.0)
REFINED_RAD = 1e-4
#: Every so many frames.
EVERY = 2
COLUMNS = ("varus (deg)", "rotation (deg)", "ML (mm)", "AP (mm)", "PD (mm)")
NO_MERIT = -1e6
#: Key, name, whether the fibres pull, and the most that the RMS of varus may be.
MODES = (("jam_free", "ligaments", True, 1.5), ("jam_free_bare", "no ligaments", False, 2.6))


class Rest(NamedTuple):
    """Where the knee rests at one flexion."""

    varus_rad: float
    pose: Pose
    merit: float


class Floating:
    """The knee at one flexion, its varus free."""

    def __init__(self, solver: DirectSolver, frame: JointCoordinates, start: Pose) -> None:
        self.solver, self.frame, self.start = solver, frame, start

    def at(self, varus_rad: float) -> Rest:
        """The stable pose at a varus."""
        angles = (self.frame.flexion_rad, varus_rad)
        found = self.solver.at(angles).solve(self.start, measured_pose(self.frame))
        if found.status is not Status.OK:
            return Rest(varus_rad, found.pose, NO_MERIT)
        pull = self.solver.fibres
        turned = pull._replace(on_reference=pull.on_reference @ attitude_rotation(*angles))
        x, y, z, theta = found.pose
        return Rest(varus_rad, found.pose, z - fibre_load(turned, (x, y, theta, z)).energy_mm)

    def rest(self) -> Rest:
        """The best of all varus angles."""
        tried = [self.at(varus) for varus in np.radians(TRIED_DEG).tolist()]
        best = int(np.argmax([one.merit for one in tried]))
        sides = [tried[max(best - 1, 0)].varus_rad, tried[min(best + 1, len(tried) - 1)].varus_rad]
        answer = minimize_scalar(
            lambda varus: -self.at(float(varus)).merit, bounds=sides, method="bounded", options={"xatol": REFINED_RAD}
        )
        return max(self.at(float(answer.x)), tried[best], key=lambda one: one.merit)


def _off(*, pulling: bool) -> Float:
    """(N, 5) solved minus measured (smoothed): varus, rotation (deg), lateral, anterior, proximal (mm)."""
    solver, rows = DirectSolver(bodies(), fibres=fibres(pulling=pulling)), []
    start: Pose | None = None
    for frame in frames(smoothed=True)[::EVERY]:
        rest = Floating(solver, frame, start or measured_pose(frame)).rest()
        start = rest.pose
        rows.append((np.degrees(rest.varus_rad - frame.varus_rad), *off_by(rest.pose, frame)))
    return np.array(rows)


def errors() -> Iterator[Row | Table]:
    """RMS and mean of each coordinate; varus against its bound."""
    bodies()  # once, not once a thread
    lines = dict[str, list[float]]()
    found = map_threads(lambda mode: _off(pulling=mode[2]), MODES, len(MODES))
    for (key, name, _, most), off in zip(MODES, found, strict=True):
        rms = np.sqrt(np.mean(off**2, axis=0))
        yield Row(f"{key}_varus_deg", f"knee_jam, varus free, {name}: varus", float(rms[0]), "deg", most)
        lines |= {f"{name}, RMS": rms.tolist(), f"{name}, mean": off.mean(axis=0).tolist()}
    yield Table("jam_free_table", "knee_jam, flexion alone given: solved minus measured", COLUMNS, lines)


MEASUREMENTS: tuple[Measurement, ...] = (errors,) if KNEE.exists() else ()
