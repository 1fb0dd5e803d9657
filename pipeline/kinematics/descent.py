"""Exact motions against the reference: drop along delta, or move until contact; each ends clear, just short of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.kinematics.contact import AttitudeContact, Pose


@dataclass(frozen=True)
class MotionSettings:
    """How motions are swept and how exact contact is.

    Attributes
    ----------
    tolerance_mm : float
        Width of the last bracket around contact: clear on one side, intersecting on the other.
    substep_mm : float
        Longest way between two collision tests, not above the thinnest feature.
    travel_mm : float
        Farthest drop along delta, and farthest way back out of an intersection.
    radius_mm : float
        Lever that turns an angle into a way.
    """

    tolerance_mm: float = 2e-4
    substep_mm: float = 0.5
    travel_mm: float = 60.0
    radius_mm: float = 30.0


def drop(contact: AttitudeContact, pose: Pose, settings: MotionSettings) -> Pose | None:
    """Push along delta to contact, from where the body is, or back out first if it intersects; None without contact.

    The pose returned is clear; ``tolerance_mm`` farther along delta it intersects.
    """
    inward = not contact.touches(pose)
    bracket = _bracket(contact, pose, settings, 1.0 if inward else -1.0)
    if bracket is None:
        return None
    clear, hit = bracket
    return _bisect(contact.touches, clear, hit, settings.tolerance_mm)


def _bracket(
    contact: AttitudeContact, pose: Pose, settings: MotionSettings, direction: float
) -> tuple[Pose, Pose] | None:
    """(clear, touching) poses next to one another along delta, searching with growing substeps."""
    way, step, before = 0.0, 0.1 * settings.substep_mm, pose
    while way < settings.travel_mm:
        way += step
        here = pose._replace(z=pose.z + direction * way)
        touching = contact.touches(here)
        if touching and direction > 0:
            return before, here
        if not touching and direction < 0:
            return here, before
        before, step = here, min(2.0 * step, settings.substep_mm)
    return None


def move_until_contact(
    contact: AttitudeContact, start: Pose, motion: tuple[float, float, float], settings: MotionSettings
) -> tuple[Pose, bool]:
    """Move by (dx, dy, dtheta), testing on the way; stop at exact contact along the motion.

    Returns
    -------
    pose : Pose
        The end of the motion, or the last clear pose before contact.
    collided : bool
    """
    dx, dy, dtheta = motion
    way = float(np.hypot(dx, dy)) + abs(dtheta) * settings.radius_mm
    count = max(1, int(np.ceil(way / settings.substep_mm)))

    def at(part: float) -> Pose:
        return Pose(start.x + part * dx, start.y + part * dy, start.z, start.theta + part * dtheta)

    for k in range(1, count + 1):
        if contact.touches(at(k / count)):
            clear = _bisect(contact.touches, at((k - 1) / count), at(k / count), settings.tolerance_mm)
            return clear, True
    return at(1.0), False


def _bisect(touches: Callable[[Pose], bool], clear: Pose, hit: Pose, tolerance_mm: float) -> Pose:
    """The clear end of a bracket shrunk below the tolerance (its larger coordinate change, 30 mm lever for angles)."""
    size = np.abs(np.subtract(hit, clear)) * [1.0, 1.0, 1.0, 30.0]
    for _ in range(max(0, int(np.ceil(np.log2(max(size.max(), 1e-300) / tolerance_mm))))):
        middle = Pose(*(0.5 * np.add(clear, hit)))
        if touches(middle):
            hit = middle
        else:
            clear = middle
    return clear
