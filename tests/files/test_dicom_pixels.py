"""Pixels of DICOM slices: CT numbers, padding, compressed frames that are cut or lie about their size."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from pydicom import dcmread
from pydicom.encaps import encapsulate
from pydicom.uid import UID, JPEGLSNearLossless

from pipeline.errors import CaseRejected
from pipeline.files.dicom_pixels import stored_pixels
from pipeline.files.dicom_writer import SeriesSpec, encode_series
from pipeline.geometry.volume import CtVolume
from tests.files.dicom_samples import (
    assert_same,
    codes,
    headers_of,
    leg,
    read,
    refused,
    series,
    short,
    with_edited,
    written,
)

LEG = leg()
FILES = series()
MIDDLE, LAST = "IM0006.dcm", "IM0012.dcm"


@pytest.mark.fault("D15")
def test_padding_becomes_air() -> None:
    rim = LEG.values.copy()
    rim[0] = -3024
    expected = LEG.values.copy()
    expected[0] = -1024
    files = encode_series(CtVolume(rim, LEG.lps_from_index))
    found = read(with_edited(files, {"PixelPaddingValue": short(-2000)}))
    np.testing.assert_array_equal(found.volume.values, expected)
    assert codes(found) == ["N-DCM-02"]


@pytest.mark.fault("D15")
def test_padding_far_outside_of_the_scale() -> None:
    rim = LEG.values.copy()
    rim[0] = -30_000
    files = encode_series(CtVolume(rim, LEG.lps_from_index))
    with refused("E-CT-02", "-30000"):
        read(files)
    found = read(with_edited(files, {"PixelPaddingValue": short(-30_000 + 1024)}))
    assert set(found.volume.values[0].ravel()) == {-1024}


def test_padding_that_is_tissue_is_left() -> None:
    found = read(with_edited(FILES, {"PixelPaddingValue": short(int(LEG.values[10, 8, 5]) + 1024)}))
    assert_same(found, LEG)
    assert codes(found) == ["N-DCM-03"]


def test_spare_bits_are_removed() -> None:
    """Twelve bits stored, overlays in the upper four."""
    header = headers_of({MIDDLE: FILES[MIDDLE]})[0]
    begin, end = header.pixels
    stored = np.frombuffer(FILES[MIDDLE][begin:end], "<u2")
    dirty = FILES[MIDDLE][:begin] + (stored | 0xA000).astype("<u2").tobytes() + FILES[MIDDLE][end:]
    for signed in (True, False):
        found = stored_pixels(dirty, replace(header, bits_stored=12, high_bit=11, signed=signed))
        expected = (stored.astype(np.int32) & 0xFFF) - 4096 * (signed & (stored >> 11 & 1).astype(np.int32))
        np.testing.assert_array_equal(found, expected.reshape(20, 24))


def test_a_slope_with_fractions() -> None:
    found = read(with_edited(FILES, {"RescaleSlope": b"0.75"}))
    stored = LEG.values.astype(np.float64) + 1024.0
    np.testing.assert_array_equal(found.volume.values, np.rint(stored * 0.75 - 1024.0))
    assert codes(found) == ["N-CT-01"]


@pytest.mark.fault("D16")
def test_near_lossless_pixels_are_looked_at() -> None:
    files = {}
    for name, data in FILES.items():
        dataset = dcmread(io.BytesIO(data))
        dataset.compress(JPEGLSNearLossless, jls_error=2, encoding_plugin="pyjpegls", generate_instance_uid=False)
        files[name] = written(dataset)
    found = read(files)
    assert 0 < np.abs(found.volume.values.astype(int) - LEG.values).max() <= 2
    assert codes(found) == ["W-DCM-01"]


@pytest.mark.fault("D16")
def test_lossy_pixels_are_looked_at() -> None:
    found = read(with_edited(FILES, {"LossyImageCompression": b"01"}))
    assert_same(found, LEG)
    assert codes(found) == ["W-DCM-01"]
    assert found.facts.lossy


@pytest.mark.fault("D16")
@pytest.mark.parametrize("rate", [2.0, 5.0])
def test_lossy_jpeg_2000_is_read_and_looked_at(rate: float) -> None:
    """Pictures that another library wrote with loss: what it reads itself, not the truth, and said to be lossy."""
    files, shown = {}, []
    for name, data in series(SeriesSpec(signed=False)).items():
        files[name], stored = lossy(data, rate)
        shown.append(stored.T.astype(np.int64) - 1024)
    found = read(files)
    assert np.abs(found.volume.values - np.stack(shown, axis=-1)).max() <= 1
    assert np.abs(found.volume.values.astype(np.int64) - LEG.values).max() > 5
    assert codes(found) == ["W-DCM-01"]
    assert found.facts.lossy


def lossy(data: bytes, rate: float) -> tuple[bytes, NDArray[np.uint16]]:
    """A slice in JPEG 2000 with loss, compressed so many times; and (rows, columns) as stored in it."""
    dataset = dcmread(io.BytesIO(data))
    stored = np.frombuffer(dataset.PixelData, "<u2").reshape(dataset.Rows, dataset.Columns)
    out = io.BytesIO()
    Image.fromarray(stored).save(out, "JPEG2000", irreversible=True, quality_layers=[rate], no_jp2=True)
    dataset.PixelData = encapsulate([out.getvalue()])
    dataset["PixelData"].VR = "OB"
    dataset.file_meta.TransferSyntaxUID = UID("1.2.840.10008.1.2.4.91")
    return written(dataset), np.asarray(Image.open(out), dtype=np.uint16)


@pytest.mark.fault("D19")
def test_one_voxel_too_bright() -> None:
    values = LEG.values.copy()
    values[10, 8, 5] = 31_000
    assert codes(read(encode_series(CtVolume(values, LEG.lps_from_index)))) == ["W-CT-02"]


@pytest.mark.parametrize("syntax", ["JPEG lossless", "JPEG-LS lossless", "JPEG 2000 lossless", "RLE"])
def test_cut_inside_the_frame(syntax: str) -> None:
    """The file is whole, its compressed picture is not: refused or, at the worst, the size is right."""
    files = series(SeriesSpec(syntax=syntax))
    header = headers_of({LAST: files[LAST]})[0]
    begin, end = header.pixels
    item = files[LAST][begin : end - 8]
    frame = item[20:]
    refusals = 0
    for part in range(1, 8):
        kept = frame[: len(frame) * part // 8 // 2 * 2]
        items = item[:16] + len(kept).to_bytes(4, "little") + kept + b"\xfe\xff\xdd\xe0\0\0\0\0"
        data = files[LAST][:begin] + items
        cut = headers_of({LAST: data})[0]
        try:
            assert stored_pixels(data, cut).shape == (20, 24)
        except CaseRejected as error:
            assert error.code == "E-IO-11"  # noqa: PT017 - some cuts decode, to the right size
            refusals += 1
    assert refusals


@pytest.mark.fault("D21")
def test_a_compressed_frame_of_another_size() -> None:
    for syntax in ("JPEG lossless", "JPEG-LS lossless", "JPEG 2000 lossless", "RLE"):
        with refused("E-IO-11", "cannot be decoded to 24 x 40"):
            read(with_edited(series(SeriesSpec(syntax=syntax)), {"Rows": short(40)}))


@pytest.mark.parametrize("syntax", ["explicit little endian", "RLE"])
def test_pixels_of_another_size_than_the_header_never_come_out(syntax: str) -> None:
    data = series(SeriesSpec(syntax=syntax))[MIDDLE]
    header = headers_of({MIDDLE: data})[0]
    with refused("E-IO-11", "cannot be decoded to 24 x 21"):
        stored_pixels(data, replace(header, rows=21))


@pytest.mark.parametrize("syntax", ["JPEG lossless", "JPEG-LS lossless", "JPEG 2000 lossless"])
def test_no_decoder_sees_a_cut_frame_or_one_of_another_size(syntax: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """GDCM aborts the process on the one, pyjpegls works for seconds on the other."""
    data = series(SeriesSpec(syntax=syntax))[MIDDLE]
    header = headers_of({MIDDLE: data})[0]
    end = header.pixels[1]

    def reached(_: object) -> None:
        raise AssertionError("the decoder was reached")

    monkeypatch.setattr("pydicom.pixels.decoders.base.get_decoder", reached)
    with refused("E-IO-11", "cannot be decoded"):
        stored_pixels(data, replace(header, rows=40))
    without_its_end = data[: end - 16] + bytes(8) + data[end - 8 :]
    with refused("E-IO-11", "cannot be decoded"):
        stored_pixels(without_its_end, header)
    with pytest.raises(AssertionError, match="reached"):
        stored_pixels(data, header)
