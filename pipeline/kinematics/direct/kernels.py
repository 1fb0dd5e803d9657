"""The kernels that a direct solver runs on, by signature."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from pipeline.kinematics.direct.settings import SearchLimits
from pipeline.kinematics.direct.surfaces import Attitude, Float

Climber = Callable[[Attitude, Float, SearchLimits, Float], int]


class Kernels(NamedTuple):
    """Three kernels: compiled, or :data:`pipeline.kinematics.direct.plain.PLAIN`.

    Attributes
    ----------
    search, polish : callable
        Climb over the height map; over the exact triangles.
    depth_at : callable
        Exact depth at a pose.
    """

    search: Climber
    polish: Climber
    depth_at: Callable[[Attitude, Float], float]
