"""Whether given landmarks can belong to these bones, and whether a mixed-up coordinate system explains it if not."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mesh import TriangleMesh

Float = NDArray[np.float64]

#: A landmark of the knee lies in or on its bone; the far ends of the leg may be outside the scan.
FAR_LANDMARKS = frozenset({"femoral_head_centre", "ankle_centre"})
#: Farthest a landmark may be from the nearest point of its bone: a condyle centre lies about 20 mm deep.
FARTHEST_MM = 30.0
RAS_FROM_LPS = np.array([-1.0, -1.0, 1.0])


def misplaced(landmarks: Mapping[str, Float], bones: Mapping[str, TriangleMesh]) -> str | None:
    """One sentence on the first landmark (LPS mm) that is far from its bone, or None when all are near."""
    for name, position in sorted(landmarks.items()):
        if name in FAR_LANDMARKS:
            continue
        bone = "tibia" if "plateau" in name or name.startswith("tibia") else "femur"
        away = _distance(position, bones[bone])
        if away > FARTHEST_MM:
            fits = _distance(position * RAS_FROM_LPS, bones[bone]) <= FARTHEST_MM
            hint = "; read the other way (RAS as LPS) it would fit" if fits else ""
            return f"Landmark {name} lies {away:.0f} mm from the {bone}{hint}."
    return None


def _distance(position: Float, mesh: TriangleMesh) -> float:
    return float(np.linalg.norm(mesh.points - position, axis=1).min())
