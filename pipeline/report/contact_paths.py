"""Where the middle of contact wanders on the moving body's joint surface as the joint bends, on either side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.contact_area import FacetPlanes, Facets, Middle, facets, middle_of_contact
from pipeline.kinematics.body_frames import in_frame
from pipeline.kinematics.interpolation import usable_entries
from pipeline.report.evidence import Cell, Evidence, cell, cell_motion, neutral_varus

Float = NDArray[np.float64]
SideName = Literal["medial", "lateral"]

#: What is at most so much farther than the nearest point counts as touching, mm; a side open by more does not touch.
BAND_MM = 0.2
#: A side that is open farther than this has no contact to speak of, mm.
REACH_MM = 2.0
#: Half width of the strip between the sides, mm: the default of the setting ``eminence_mm``.
EMINENCE_MM = 5.0
#: Least distance between two poses that are looked at, degrees.
STEP_DEG = 5.0


@dataclass(frozen=True, eq=False)
class ContactPath:
    """The middle of contact of one side at each flexion (K,), in the moving body's frame; NaN where it is wide open.

    ``gap_mm`` is how far the side is open at its nearest point.
    """

    side: SideName
    flexion_deg: Float
    lateral_mm: Float
    anterior_mm: Float
    gap_mm: Float

    @property
    def touching(self) -> NDArray[np.bool_]:
        """(K,) where the side is closed."""
        return self.gap_mm <= BAND_MM


@lru_cache(maxsize=1)
def contact_paths(evidence: Evidence) -> tuple[ContactPath, ...]:
    """The paths of both sides at neutral varus after smoothing, at usable flexions about 5 deg apart.

    A side on which the moving body has no surface that faces along delta has no path. Found once for the
    numbers and for the picture.
    """
    cells = _cells(evidence)
    if not cells:
        return ()
    planes, found = FacetPlanes(facets(evidence.reference)), []
    for side, patch in _patches(evidence).items():
        middles = [_middle(evidence, planes, patch, shown) for shown in cells]
        found.append(_path(side, cells, middles))
    return tuple(found)


def _cells(evidence: Evidence) -> list[Cell]:
    column = neutral_varus(evidence.smooth.grid)
    chosen: list[Cell] = []
    for row in np.flatnonzero(usable_entries(evidence.smooth.poses)[:, column]):
        here = cell(evidence.smooth, int(row), column)
        if not chosen or here.flexion_deg >= chosen[-1].flexion_deg + STEP_DEG - 1e-9:
            chosen.append(here)
    return chosen


def _patches(evidence: Evidence) -> dict[SideName, Facets]:
    """What faces along delta on either side of the eminence, in the moving body's frame."""
    surface = facets(in_frame(evidence.moving, evidence.scan_from_moving))
    facing, across = surface.normals[:, 2] > 0.0, surface.middles[:, 0]
    sides: dict[SideName, NDArray[np.bool_]] = {
        "medial": facing & (across < -EMINENCE_MM),
        "lateral": facing & (across > EMINENCE_MM),
    }
    return {side: surface.chosen(chosen) for side, chosen in sides.items() if chosen.any()}


def _middle(evidence: Evidence, planes: FacetPlanes, patch: Facets, shown: Cell) -> Middle | None:
    placed = cell_motion(evidence, shown) @ evidence.scan_from_moving
    distances = planes.distances(patch.middles @ placed[:3, :3].T + placed[:3, 3], REACH_MM)
    return middle_of_contact(patch, distances, BAND_MM)


def _path(side: SideName, cells: Sequence[Cell], middles: Sequence[Middle | None]) -> ContactPath:
    nowhere = (np.nan, np.nan, np.nan)
    rows = np.array([nowhere if one is None else (*one.place[:2], one.gap_mm) for one in middles])
    return ContactPath(side, np.array([one.flexion_deg for one in cells]), *rows.T)


def excursion_mm(path: ContactPath) -> float:
    """How far the middle of contact wanders forwards and backwards where the side touches; NaN where it never does."""
    touched = path.anterior_mm[path.touching]
    return float(np.ptp(touched)) if touched.size else float("nan")
