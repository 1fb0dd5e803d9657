"""Settings of the direct solver; nothing here needs the compiler."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


class SearchLimits(NamedTuple):
    """When the search goes on and when it ends.

    Attributes
    ----------
    first_mm, largest_mm, last_mm : float
        Trust region at the start, at most, and where the search ends: half width of a box in x, y and
        ``radius_mm * theta``.
    radius_mm : float
        Lever that turns an angle into a way.
    gain_mm : float
        A promise below this is none.
    steepest : float
        Samples matter whose gap exceeds the least by less than this times the trust region.
    steps : int
        At most so many linear programmes.
    slack_mm : float
        On the exact triangles, only where the height map shows a gap smaller than this are features looked for.
    """

    first_mm: float
    largest_mm: float
    last_mm: float
    radius_mm: float
    gain_mm: float
    steepest: float
    steps: int
    slack_mm: float = 0.2


#: Steps over the height map.
SEARCH = SearchLimits(first_mm=0.5, largest_mm=1.0, last_mm=0.1, radius_mm=30.0, gain_mm=1e-6, steepest=2.0, steps=200)
#: Steps over the exact features.
POLISH = SearchLimits(
    first_mm=0.06, largest_mm=0.5, last_mm=2e-3, radius_mm=30.0, gain_mm=1e-6, steepest=2.0, steps=200
)


@dataclass(frozen=True)
class DirectSettings:
    """Bounds and trust regions.

    Attributes
    ----------
    slide_bound_mm, rotation_bound_rad : float
        A body farther than this from the centre of the bounds has slid off, or turned past its bound.
    search, polish : SearchLimits
        Steps over the height map; steps over the exact features.
    """

    slide_bound_mm: float = 25.0
    rotation_bound_rad: float = float(np.radians(45.0))
    search: SearchLimits = SEARCH
    polish: SearchLimits = POLISH


@dataclass(frozen=True)
class MapSettings:
    """What the height map shows.

    Attributes
    ----------
    spacing_mm : float
        Between nodes of the map, and between samples of the moving body.
    window_mm : float
        How far sideways a body may get from where a map was made before another is made.
    headroom_mm : float
        What lies higher than this above the body is left out, until a body gets that far.
    """

    spacing_mm: float = 0.6
    window_mm: float = 20.0
    headroom_mm: float = 3.0
