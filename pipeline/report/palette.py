"""Colours that people with any colour vision can tell apart.

Structures: Okabe & Ito (2008). Scales: anchors of viridis (Smith & van der Walt, 2015), dark to pale, so they also
survive a black-and-white printer.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Color = tuple[int, int, int]

BONE: Color = (233, 225, 204)
REFERENCE: Color = (233, 225, 204)
MOVING: Color = (186, 205, 224)
OVERLAP: Color = (213, 94, 0)
AXIS: Color = (0, 90, 160)
DELTA: Color = (200, 60, 0)

#: Lines of charts.
BLUE, VERMILION, PINK, GREEN, AMBER, GREY = "#0072b2", "#d55e00", "#cc79a7", "#009e73", "#e69f00", "#6e6e6e"

_STRUCTURES: dict[str, Color] = {
    "femur": BONE,
    "tibia": MOVING,
    "fibula": (205, 205, 205),
    "patella": (240, 228, 66),
    "femoral_cartilage": (86, 180, 233),
    "medial_tibial_cartilage": (0, 158, 115),
    "lateral_tibial_cartilage": (0, 158, 115),
    "patellar_cartilage": (120, 190, 235),
    "medial_meniscus": (230, 159, 0),
    "lateral_meniscus": (230, 159, 0),
}
_OTHERS: tuple[Color, ...] = (BONE, MOVING, (0, 158, 115), (230, 159, 0), (86, 180, 233), (204, 121, 167))

_VIRIDIS = np.array(
    [
        (68, 1, 84),
        (71, 44, 122),
        (59, 81, 139),
        (44, 113, 142),
        (33, 144, 141),
        (39, 173, 129),
        (92, 200, 99),
        (170, 220, 50),
        (253, 231, 37),
    ],
    dtype=np.float64,
)


def structure_color(name: str) -> Color:
    """The colour of a structure; one of a fixed set for a name that is not of the knee."""
    return _STRUCTURES.get(name) or _OTHERS[sum(name.encode()) % len(_OTHERS)]


def scale(share: Float) -> NDArray[np.uint8]:
    """Colours (N, 3) of numbers (N,) between 0, dark, and 1, pale; beyond them the end colours."""
    at = np.clip(np.asarray(share, dtype=np.float64), 0.0, 1.0) * (len(_VIRIDIS) - 1)
    channels = [np.interp(at, np.arange(len(_VIRIDIS)), channel) for channel in _VIRIDIS.T]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


def hexadecimal(color: Color) -> str:
    """``#rrggbb``."""
    return "#{:02x}{:02x}{:02x}".format(*color)
