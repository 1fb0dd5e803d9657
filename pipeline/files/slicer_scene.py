"""Files for 3D Slicer: poses as ITK transforms (``.tfm``) and landmarks as markups (``.mrk.json``), both LPS mm."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.records import canonical_json
from pipeline.records import Vector

Float = NDArray[np.float64]

_MARKUPS_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)


def encode_tfm(moved_from_scan: Float) -> bytes:
    """A motion as an ITK text transform that 3D Slicer applies as that motion.

    ITK holds the *resampling* direction: the file maps a point of the output to the input it comes from. So what is
    written is the inverse of the motion; 3D Slicer inverts it again when it loads the file.

    Parameters
    ----------
    moved_from_scan : (4, 4) float64
        Rigid, LPS mm.

    Raises
    ------
    ValueError
        For a motion that is not finite.
    """
    if not np.isfinite(moved_from_scan).all():
        raise ValueError("a motion that is not finite has no file")
    turn = moved_from_scan[:3, :3].T
    numbers = np.concatenate([turn.ravel(), -turn @ moved_from_scan[:3, 3]]) + 0.0
    return (
        "#Insight Transform File V1.0\n"
        "#Transform 0\n"
        "Transform: AffineTransform_double_3_3\n"
        f"Parameters: {' '.join(map(repr, numbers.tolist()))}\n"
        "FixedParameters: 0 0 0\n"
    ).encode()


def encode_landmarks(points: Mapping[str, Vector]) -> bytes:
    """Named points (LPS mm) as one markups list, schema 1.0.3, in the order given."""
    return canonical_json(
        {
            "@schema": _MARKUPS_SCHEMA,
            "markups": [
                {
                    "type": "Fiducial",
                    "coordinateSystem": "LPS",
                    "coordinateUnits": "mm",
                    "controlPoints": [
                        {"id": str(number), "label": name, "position": list(point), "positionStatus": "defined"}
                        for number, (name, point) in enumerate(points.items(), start=1)
                    ],
                }
            ],
        }
    )
