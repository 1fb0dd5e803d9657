"""Long axes of femur and tibia from what of the shafts is in the scan.

The centroids of the cross-sections beyond the flare of the metaphysis lie on the shaft's axis. In a knee scan little of
the shaft is left, so the direction strays; how far was measured on five full-length legs cut shorter and shorter (the
line through 25, 45 and 65 mm of sections was off by 6, 2 and 1 deg in the sagittal plane).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cross_sections import Sections, cross_sections
from pipeline.geometry.directions import unit
from pipeline.geometry.mesh import TriangleMesh, vertex_normals

Float = NDArray[np.float64]

#: Sections below this share of the widest one belong to the shaft rather than to the flare.
SHAFT_AREA_SHARE = 0.6
SPACING_MM = 2.0
#: Where a scan shows less shaft than this many sections, the last ones it has of the flare must do: 10 mm, which makes
#: the direction uncertain by 14 deg and asks for review.
LEAST_SECTIONS = 6
#: How far the centroid line of a metaphysis strays sideways over the part that is used, mm (see above).
STRAY_MM = 2.5
LEAST_UNCERTAINTY_DEG = 0.5
#: Each round leaves about a third of the error of the one before: rounds from 30 deg away to below 0.1 deg.
SETTLING_ROUNDS = 6


class LongAxis(NamedTuple):
    """Direction (3,) towards the far end, centroid of the last section (3,), length used (mm), spread (deg)."""

    direction: Float
    far_centre: Float
    length_mm: float
    uncertainty_deg: float


def long_axis(bone: TriangleMesh, rough_away: Float) -> LongAxis:
    """Axis of a bone's shaft.

    Parameters
    ----------
    bone : TriangleMesh
        An end of a long bone with some of its shaft.
    rough_away : (3,) float64
        Unit vector from the joint along the shaft, to within about 30 deg.

    Raises
    ------
    ValueError
        When too few sections lie beyond the joint.
    """
    direction = rough_away
    for _ in range(SETTLING_ROUNDS):
        sections = _shaft_sections(bone, direction)
        direction = _line(sections.centroids, direction)
    length = float(np.ptp(sections.heights))
    spread = LEAST_UNCERTAINTY_DEG + float(np.degrees(np.arctan(STRAY_MM / length)))
    return LongAxis(direction, sections.centroids[-1], length, spread)


def _shaft_sections(bone: TriangleMesh, away: Float) -> Sections:
    heights = bone.points @ away
    planes = np.arange(heights.min() + SPACING_MM, _complete_below(bone, away), SPACING_MM)
    sections = cross_sections(bone, away, planes)
    if len(sections.areas) < 3:
        raise ValueError("the bone is too short for cross-sections")
    widest = int(np.argmax(sections.areas))
    order = np.arange(len(sections.areas))
    shaft = (order > widest) & (sections.areas < SHAFT_AREA_SHARE * sections.areas[widest])
    if shaft.sum() < LEAST_SECTIONS:
        shaft = (order > widest) & (order >= len(order) - LEAST_SECTIONS)
    if shaft.sum() < LEAST_SECTIONS:
        raise ValueError(f"fewer than {LEAST_SECTIONS} cross-sections beyond the joint are in the scan")
    return Sections(*(part[shaft] for part in sections))


def _complete_below(bone: TriangleMesh, away: Float) -> float:
    """Height below which sections are whole: the scan's border cuts the shaft with a flat cap, often obliquely."""
    heights = bone.points @ away
    low, high = heights.min(), heights.max()
    cap = (vertex_normals(bone) @ away > 0.8) & (heights > high - 0.3 * (high - low))
    return float(heights[cap].min() if cap.any() else high) - SPACING_MM / 2.0


def _line(centroids: Float, towards: Float) -> Float:
    centred = centroids - centroids.mean(axis=0)
    direction = unit(np.linalg.svd(centred, full_matrices=False)[2][0])
    return direction if direction @ towards > 0 else -direction
