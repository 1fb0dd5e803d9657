"""Medial or lateral: what the anatomy itself says, sign by sign, against the side that was declared."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cross_sections import volume_centroid
from pipeline.geometry.mesh import TriangleMesh

Float = NDArray[np.float64]

#: Pairs of which the first lies lateral of the second.
LATERAL_OF = (
    ("fibula", "tibia", 8.0),
    ("lateral_meniscus", "medial_meniscus", 10.0),
    ("lateral_tibial_cartilage", "medial_tibial_cartilage", 10.0),
)


class SideSign(NamedTuple):
    """One anatomical sign: what was compared, how far lateral it lies (mm, negative is medial), whether it agrees."""

    sentence: str
    lateral_mm: float
    agrees: bool


def side_signs(structures: Mapping[str, TriangleMesh], lateral: Float) -> tuple[SideSign, ...]:
    """Every sign that the labelled structures give.

    Parameters
    ----------
    structures : mapping of str to TriangleMesh
    lateral : (3,) float64
        Unit vector that would be lateral if the declared side were right, from bones alone (proximal and anterior).

    Notes
    -----
    A pair closer than its least distance along the axis says nothing and is left out.
    """
    signs = []
    for first, second, least_mm in LATERAL_OF:
        if first in structures and second in structures:
            way = float((volume_centroid(structures[first]) - volume_centroid(structures[second])) @ lateral)
            if abs(way) >= least_mm:
                signs.append(SideSign(_sentence(first, second, way), way, way > 0))
    return tuple(signs)


def _sentence(first: str, second: str, way_mm: float) -> str:
    where = "lateral" if way_mm > 0 else "medial"
    return f"the {_words(first)} lies {abs(way_mm):.0f} mm {where} of the {_words(second)}"


def _words(name: str) -> str:
    return name.replace("_", " ")
