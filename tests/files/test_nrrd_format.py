"""Our own NRRD: deterministic, exact, and read alike by others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import SimpleITK

from pipeline.files.nrrd_format import encode_nrrd, read_nrrd
from pipeline.geometry.volume import LabelVolume
from tests.files.label_samples import knee_like

KNEE = knee_like()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_round_trip_is_exact(dtype: type) -> None:
    volume = LabelVolume(np.asarray(KNEE.values).astype(dtype), KNEE.lps_from_index)
    found = read_nrrd(encode_nrrd(volume), "labels.nrrd")
    assert found.values.dtype == dtype
    np.testing.assert_array_equal(found.values, volume.values)
    np.testing.assert_array_equal(found.lps_from_index, volume.lps_from_index)


def test_equal_volumes_give_equal_bytes() -> None:
    in_fortran_order = LabelVolume(np.asfortranarray(KNEE.values), KNEE.lps_from_index * 1.0)
    minus_zero = np.where(KNEE.lps_from_index == 0.0, -0.0, KNEE.lps_from_index)
    assert encode_nrrd(in_fortran_order) == encode_nrrd(KNEE) == encode_nrrd(LabelVolume(KNEE.values, minus_zero))


def test_simpleitk_reads_the_same(tmp_path: Path) -> None:
    path = tmp_path / "labels.nrrd"
    path.write_bytes(encode_nrrd(KNEE))
    image = SimpleITK.ReadImage(str(path))
    np.testing.assert_array_equal(SimpleITK.GetArrayFromImage(image).transpose(2, 1, 0), KNEE.values)
    there = image.TransformContinuousIndexToPhysicalPoint((3.0, 4.0, 5.0))
    np.testing.assert_allclose(there, (KNEE.lps_from_index @ (3.0, 4.0, 5.0, 1.0))[:3], atol=1e-9)


@pytest.mark.parametrize("values", [np.zeros((2, 2, 2), np.int32), np.zeros((2, 2), np.uint8)])
def test_only_label_volumes_are_written(values: np.ndarray[tuple[int, ...], np.dtype[np.generic]]) -> None:
    with pytest.raises(ValueError, match="expected a uint8, uint16 or int16 volume"):
        encode_nrrd(LabelVolume(values, np.eye(4)))
