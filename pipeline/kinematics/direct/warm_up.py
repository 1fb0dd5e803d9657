"""Compile every kernel once, on a joint of a few triangles, so that no patient has to wait for it."""

from __future__ import annotations

import time

from pipeline.geometry.validation_objects import BarOnPyramids
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.direct.prepare import prepare
from pipeline.kinematics.direct.solver import DirectSolver


def warm_up() -> float:
    """Seconds that it took: about half a minute, or two where the machine code was there already."""
    begun = time.perf_counter()
    pair = BarOnPyramids().pair()
    attitude = DirectSolver(prepare(pair.reference_body, pair.moving_body)).at((0.0, 0.0))
    found = attitude.solve(Pose(0.5, 0.0, -20.0, 0.1))
    attitude.certify(found.pose)
    attitude.margin(found.pose)
    attitude.depth(found.pose)
    return time.perf_counter() - begun
