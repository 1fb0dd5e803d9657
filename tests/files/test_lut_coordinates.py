"""``lut.h5`` in CF readers: every dimension named, its coordinates found in each group, numbers with names."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from pipeline.files.lut_file import encode_lut
from pipeline.files.lut_schema import DATASETS, SCALES, arrays_of
from pipeline.kinematics.table import Grid
from tests.files.lut_sample import content


@pytest.fixture(scope="module")
def good() -> bytes:
    return encode_lut(content())


@pytest.fixture
def xarray() -> Any:
    pytest.importorskip("h5netcdf")
    return pytest.importorskip("xarray")


@pytest.mark.parametrize("grid", [content().smooth.grid, Grid(np.zeros(1), np.zeros(1))], ids=["grid", "one attitude"])
@pytest.mark.parametrize("group", sorted({spec.group for spec in DATASETS}))
def test_xarray_names_every_dimension_and_finds_its_coordinates(
    tmp_path: Path, xarray: Any, group: str, grid: Grid
) -> None:
    path, table = tmp_path / "lut.h5", content(grid=grid)
    path.write_bytes(encode_lut(table))
    specs, arrays = [spec for spec in DATASETS if spec.group == group], arrays_of(table)
    with xarray.open_dataset(path, group=group, engine="h5netcdf") as data:
        for spec in specs:
            variable = data[spec.path.rpartition("/")[2]]
            assert variable.dims == spec.dims
            assert (variable.attrs["long_name"], variable.attrs["unit"]) == (spec.title, spec.unit)
            np.testing.assert_array_equal(variable, arrays[spec.path])
            for dim in spec.dims:
                np.testing.assert_array_equal(data.coords[dim], arrays[SCALES[dim]])
        if group == "/lut" and len(grid.varus_deg) > 1:
            assert data.flexion_deg.attrs["units"] == "degree"
            expected = table.smooth.poses.lateral_mm[7, 2]
            assert data.lateral_mm.sel(flexion_deg=35, varus_deg=0).item() == expected


def test_xarray_opens_all_groups_as_one_tree(tmp_path: Path, xarray: Any, good: bytes) -> None:
    path = tmp_path / "lut.h5"
    path.write_bytes(good)
    with xarray.open_datatree(path, engine="h5netcdf") as tree:
        assert tree.attrs["Conventions"] == "CF-1.11"
        assert {node.path for node in tree.subtree} - {"/bodies"} == {spec.group for spec in DATASETS}
        np.testing.assert_array_equal(tree["neutral/neutral_varus_deg"], content().neutral.varus_deg)
        at = tree["neutral"].neutral_varus_deg.sel(flexion_deg=10).item()
        assert at == content().neutral.varus_deg[2]


def test_what_is_numbered_has_names(good: bytes) -> None:
    named = {
        "frames/coordinate": "flexion_deg varus_deg internal_rotation_deg lateral_mm anterior_mm proximal_mm",
        "smoothing/curve": "lateral_mm internal_rotation_deg",
        "smoothing/driven": "flexion_deg varus_deg",
        "smoothing/end": "first last",
        "xyz": "x y z",
    }
    with h5py.File(io.BytesIO(good)) as file:
        for path, names in named.items():
            dataset = file[path]
            assert dataset.attrs["flag_meanings"] == names
            assert dataset.attrs["flag_values"].dtype == dataset.dtype
            np.testing.assert_array_equal(dataset.attrs["flag_values"], dataset)
