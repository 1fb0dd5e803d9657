"""What others measured, for comparison in pictures; never a target, and nothing is fitted to it.

Only changes of angles since extension: shifts depend on the frames that each author chose. All of them are other
people's knees, moved in other ways and under other loads than a table without muscles and ligaments.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

#: Joints to which the numbers apply.
JOINT = "knee"
#: A table that begins at more flexion than this has no pose of extension to count changes from, degrees.
EXTENSION_DEG = 5.0


@dataclass(frozen=True)
class PublishedChange:
    """How an angle changes from extension to some flexion, or over a span of it, degrees.

    Attributes
    ----------
    coordinate : str
        Internal rotation, or varus (valgus is negative).
    flexion_deg : (first, last)
    change_deg : (lowest, highest)
    knees, source : str
        Whose knees and how they were measured; authors and year.
    """

    coordinate: Literal["internal_rotation_deg", "varus_deg"]
    flexion_deg: tuple[float, float]
    change_deg: tuple[float, float]
    knees: str
    source: str

    @property
    def at_one_flexion(self) -> bool:
        """Whether the number stands for one flexion, not for a span."""
        return self.flexion_deg[0] == self.flexion_deg[1]


CHANGES = (
    # PMC4237875: 11.6 +- 3.2 deg from 0 to 40 deg, mean and standard deviation
    PublishedChange(
        "internal_rotation_deg", (40.0, 40.0), (8.4, 14.8), "30 healthy knees, MRI, mean ± SD", "Chen 2014"
    ),
    # couplings over 4 deg of extension to 61 deg of flexion: internal rotation up to 15 deg, abduction up to 10 deg
    PublishedChange(
        "internal_rotation_deg", (0.0, 61.0), (0.0, 15.0), "most that is reported, bearing weight", "Gasparutto 2017"
    ),
    PublishedChange("varus_deg", (0.0, 61.0), (-10.0, 0.0), "most that is reported, bearing weight", "Gasparutto 2017"),
)

#: Bending against straightening in 15 unloaded cadaver knees, deg of rotation: every one stayed below (Wilson 2000).
HYSTERESIS_BELOW_DEG = 2.0
HYSTERESIS_SOURCE = "15 cadaver knees stay below 2 deg (Wilson 2000)"
#: The average curve of pipeline/kinematics/baselines.py.
WALKER_SOURCE = "Walker 1988"
