"""Our own DICOM series: the same bytes each time, what pydicom and SimpleITK read from it, and no name in it."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import SimpleITK
from pydicom import dcmread

from pipeline.files.dicom_writer import SYNTHETIC, TRANSFER_SYNTAXES, SeriesSpec, encode_series
from pipeline.geometry.volume import CtVolume
from tests.files.dicom_samples import leg, series

each_syntax = pytest.mark.parametrize("syntax", TRANSFER_SYNTAXES)


@each_syntax
def test_equal_volumes_give_equal_bytes(syntax: str) -> None:
    spec = SeriesSpec(syntax=syntax)
    assert series(spec) == series(spec)
    for data in series(spec).values():
        assert dcmread(io.BytesIO(data)).file_meta.TransferSyntaxUID == TRANSFER_SYNTAXES[syntax]


@each_syntax
def test_pydicom_reads_what_was_written(syntax: str) -> None:
    ct = leg()
    for k, data in enumerate(encode_series(ct, SeriesSpec(syntax=syntax)).values()):
        dataset = dcmread(io.BytesIO(data))
        stored = dataset.pixel_array.astype(np.int32) * int(dataset.RescaleSlope) + int(dataset.RescaleIntercept)
        np.testing.assert_array_equal(stored, ct.values[:, :, k].T)


def test_simpleitk_puts_it_at_the_same_place(tmp_path: Path) -> None:
    """An independent reader agrees on voxels, place and direction."""
    ct = leg(oblique=True)
    for name, data in encode_series(ct).items():
        (tmp_path / name).write_bytes(data)
    image = SimpleITK.ReadImage([str(path) for path in sorted(tmp_path.iterdir())])
    np.testing.assert_array_equal(SimpleITK.GetArrayFromImage(image), np.transpose(ct.values, (2, 1, 0)))
    for index in ((0, 0, 0), (23, 19, 11), (5, 0, 11)):
        expected = ct.lps_from_index[:3, :3] @ index + ct.lps_from_index[:3, 3]
        np.testing.assert_allclose(image.TransformIndexToPhysicalPoint(index), expected, atol=1e-6)


def test_another_seed_is_another_series_of_the_same_volume() -> None:
    one, other = (dcmread(io.BytesIO(series(SeriesSpec(seed=seed))["IM0001.dcm"])) for seed in ("a", "b"))
    assert one.SeriesInstanceUID != other.SeriesInstanceUID
    assert one.SOPInstanceUID != other.SOPInstanceUID
    assert one.PixelData == other.PixelData


def test_it_says_that_it_is_synthetic() -> None:
    dataset = dcmread(io.BytesIO(series()["IM0001.dcm"]))
    assert str(dataset.PatientName) == dataset.PatientID == SYNTHETIC
    assert dataset.SeriesDescription == "synthetic"
    assert "StudyDate" not in dataset


def test_values_that_do_not_fit() -> None:
    ct = leg()
    with pytest.raises(ValueError, match="do not fit into uint16"):
        encode_series(ct, SeriesSpec(signed=False, intercept=0))
    with pytest.raises(ValueError, match="do not fit into int16"):
        encode_series(CtVolume(np.full((2, 2, 2), 32767, np.int16), np.eye(4)), SeriesSpec())


def test_the_syntax_does_not_change_who_it_is() -> None:
    spec = SeriesSpec(syntax="RLE")
    one, other = (
        dcmread(io.BytesIO(series(s)["IM0003.dcm"])) for s in (spec, replace(spec, syntax="explicit big endian"))
    )
    assert one.SOPInstanceUID == other.SOPInstanceUID
