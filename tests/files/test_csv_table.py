"""``lut.csv`` reads back the same numbers."""

from __future__ import annotations

import io

import numpy as np

from pipeline.files.csv_table import encode_csv
from pipeline.kinematics.table import Grid, Status
from tests.files.lut_sample import GRID, poses

BAD = ((3, 1), (4, 1))


def test_numbers_read_back_exactly() -> None:
    table = poses(GRID, BAD)
    text = encode_csv(GRID, table, "left").decode()
    read = np.genfromtxt(
        io.StringIO("\n".join(line for line in text.splitlines() if not line.startswith("#"))),
        delimiter=",",
        names=True,
        dtype=None,
        encoding="utf-8",
    )
    flexion, varus = np.meshgrid(GRID.flexion_deg, GRID.varus_deg, indexing="ij")
    np.testing.assert_array_equal(read["flexion_deg"], flexion.ravel())
    np.testing.assert_array_equal(read["varus_deg"], varus.ravel())
    for name in ("lateral_mm", "anterior_mm", "proximal_mm", "internal_rotation_deg", "lateral_gap_mm"):
        np.testing.assert_array_equal(read[name], getattr(table, name).ravel())
    assert list(read["status"]) == [Status(int(value)).name.lower() for value in table.status.ravel()]


def test_the_comment_lines_settle_use_side_units_and_signs() -> None:
    text = encode_csv(GRID, poses(GRID), "left").decode()
    comment = "\n".join(line for line in text.splitlines() if line.startswith("#"))
    for words in ("Research use - not for diagnosis", "Side: left", "millimetres", "internal rotation +", "lateral +"):
        assert words in comment


def test_an_unusable_row_is_empty_and_zero_has_no_sign() -> None:
    grid = Grid(np.array([-0.0]), np.array([0.0, 1.0]))
    *_, first, second = encode_csv(grid, poses(grid, ((0, 1),)), "right").decode().splitlines()
    assert first.startswith("0.0,0.0,0.0,1.0,0.5,0.0,ok,0.02,")
    assert second == "0.0,1.0,,,,,slid_off,,,"
