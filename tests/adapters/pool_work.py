"""Work for worker processes; a module of its own, because a worker imports it by name."""

from __future__ import annotations

import os

from pipeline.kinematics.contact import AttitudeContact, Bodies, Pose
from pipeline.kinematics.descent import MotionSettings, drop


def depth_at(bodies: Bodies, x_mm: float) -> tuple[float, int, int]:
    """Where contact lies along delta, and which process and which pair of bodies said so."""
    pose = drop(AttitudeContact(bodies, 0.2, -0.1), Pose(x_mm, 0.0, 0.0, 0.0), MotionSettings())
    return (float("nan") if pose is None else pose.z), os.getpid(), id(bodies)


def refuse(bodies: Bodies, task: int) -> int:
    """Fail at one of the tasks."""
    if task == 2:
        raise ValueError(f"task {task} cannot be done with {len(bodies.moving.points)} points")
    return task


def die(_bodies: Bodies, _task: int) -> int:
    """End the worker as a machine short of memory does."""
    os._exit(9)
