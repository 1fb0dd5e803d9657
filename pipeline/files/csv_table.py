"""The table for people: one row an attitude, as comma-separated text."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.kinematics.table import Grid, PoseTable, Status

_HEADER = """\
# Research use - not for diagnosis
# Stable poses of the moving body (tibia in a knee) relative to the reference body (femur), one row an attitude.
# Signs: flexion +, varus +, internal rotation +; translations of the moving body: lateral +, anterior +, proximal +.
# The same signs for a right and for a left joint. Angles in degrees, lengths in millimetres.
# Frame of the translations: the attitude frame, that is the reference frame turned by flexion and varus; z is delta.
# status: ok and smoothed rows may be used; the coordinates of every other row are empty.
"""

_COLUMNS = (
    "flexion_deg",
    "varus_deg",
    "lateral_mm",
    "anterior_mm",
    "proximal_mm",
    "internal_rotation_deg",
    "status",
    "equilibrium_residual",
    "medial_gap_mm",
    "lateral_gap_mm",
)


def encode_csv(grid: Grid, poses: PoseTable, side: str) -> bytes:
    """``lut.csv``: comment lines that begin with ``#``, a line of column names, one line an attitude.

    Flexion changes slowest. A number is the shortest text that reads back the same float64; NaN is an empty cell.
    """
    lines = [f"{_HEADER}# Side: {side}", ",".join(_COLUMNS)]
    lines += [_row(grid, poses, cell) for cell in np.ndindex(grid.shape)]
    return ("\n".join(lines) + "\n").encode()


def _row(grid: Grid, poses: PoseTable, cell: tuple[int, ...]) -> str:
    numbers = [grid.flexion_deg[cell[0]], grid.varus_deg[cell[1]]]
    texts = [_text(number) for number in numbers]
    for name in _COLUMNS[2:]:
        column: NDArray[np.generic] = getattr(poses, name)
        texts.append(Status(int(column[cell])).name.lower() if name == "status" else _text(column[cell]))
    return ",".join(texts)


def _text(number: np.generic) -> str:
    value = float(number) + 0.0  # adding zero turns -0.0 into 0.0
    return "" if np.isnan(value) else repr(value)
