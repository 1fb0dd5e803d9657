"""A CT in one file: the same volume in every format, and the gates of its geometry and its CT numbers."""

from __future__ import annotations

import gzip
import io
from collections.abc import Callable
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
import SimpleITK
from numpy.typing import NDArray

from pipeline.errors import CaseRejected
from pipeline.files.ct_volumes import CtScan, check_hounsfield, hounsfield, read_ct_volume
from pipeline.files.dicom_series import read_dicom_series
from pipeline.files.dicom_writer import encode_series
from pipeline.geometry.volume import CtVolume
from tests.files.dicom_samples import leg
from tests.files.label_samples import FLIP

FOOT = Path(__file__).resolve().parents[3] / "shared/data/foot_ct/foot_ct_crop.nii.gz"
needs_foot = pytest.mark.skipif(not FOOT.is_file(), reason="the foot CT was not found beside the checkout")

LEG = leg(oblique=True)


def nifti(
    values: NDArray[np.generic], matrix: NDArray[np.float64] = LEG.lps_from_index, kind: type = nibabel.Nifti1Image
) -> bytes:
    image = kind(values, FLIP @ matrix)
    image.header.set_xyzt_units("mm")
    image.set_sform(image.affine, 1)
    image.set_qform(image.affine, 1)
    raw: bytes = image.to_bytes()
    return raw


def scaled(slope: float, intercept: float, kind: type = nibabel.Nifti1Image) -> bytes:
    """The leg as dcm2niix leaves it: stored values, and the scanner's rescale in the header."""
    stored = np.rint((LEG.values - intercept) / slope).astype(np.int16)
    raw = nifti(stored, kind=kind)
    header_kind = kind.header_class  # type: ignore[attr-defined]  # nibabel has no types
    header = header_kind.from_fileobj(io.BytesIO(raw), check=False)
    header["scl_slope"], header["scl_inter"] = slope, intercept
    return bytes(header.binaryblock) + raw[len(header.binaryblock) :]


def made_by_nrrd(values: NDArray[np.generic], folder: Path, matrix: NDArray[np.float64] = LEG.lps_from_index) -> bytes:
    header = {
        "space": "left-posterior-superior",
        "space directions": matrix[:3, :3].T,
        "space origin": matrix[:3, 3],
        "encoding": "gzip",
    }
    nrrd.write(str(folder / "ct.nrrd"), values, header)
    return (folder / "ct.nrrd").read_bytes()


def made_by_itk(values: NDArray[np.generic], folder: Path) -> bytes:
    image = SimpleITK.GetImageFromArray(np.transpose(values, (2, 1, 0)))
    spacing = LEG.spacing_mm
    image.SetSpacing([float(x) for x in spacing])
    image.SetOrigin([float(x) for x in LEG.lps_from_index[:3, 3]])
    image.SetDirection([float(x) for x in (LEG.lps_from_index[:3, :3] / spacing).ravel()])
    SimpleITK.WriteImage(image, str(folder / "ct.mha"), useCompression=True)
    return (folder / "ct.mha").read_bytes()


FORMATS: dict[str, Callable[[NDArray[np.generic], Path], bytes]] = {
    "ct.nii": lambda values, _: nifti(values),
    "ct.nii.gz": lambda values, _: gzip.compress(nifti(values), mtime=0),
    "ct.NRRD": made_by_nrrd,
    "ct.mha": made_by_itk,
}
each_format = pytest.mark.parametrize("name", FORMATS)


def refused(code: str, problem: str = "") -> pytest.RaisesExc[CaseRejected]:
    return pytest.raises(CaseRejected, match=f"^{code} .*{problem}")


def codes(found: CtScan) -> list[str]:
    return [finding.code for finding in found.findings]


def assert_same(found: CtScan, expected: CtVolume) -> None:
    np.testing.assert_array_equal(found.volume.values, expected.values)
    np.testing.assert_allclose(found.volume.lps_from_index, expected.lps_from_index, atol=1e-4)
    assert found.volume.values.dtype == np.int16


@each_format
@pytest.mark.parametrize("dtype", ["i2", "i4", "f4", "f8"])
def test_every_format_gives_the_volume_of_the_series(name: str, dtype: str, tmp_path: Path) -> None:
    found = read_ct_volume(FORMATS[name](LEG.values.astype(dtype), tmp_path), name)
    files = encode_series(LEG)
    assert_same(found, read_dicom_series(list(files), files.__getitem__).volume)
    assert (found.findings, found.set_aside, found.laterality) == ((), (), None)


@pytest.mark.parametrize("kind", [nibabel.Nifti1Image, nibabel.Nifti2Image])
@pytest.mark.parametrize("scale", [(1.0, -1024.0), (2.0, 0.0), (1.0, 5.0)])
def test_scaled_nifti(kind: type, scale: tuple[float, float]) -> None:
    raw = scaled(*scale, kind=kind)
    expected = np.rint((LEG.values - scale[1]) / scale[0]) * scale[0] + scale[1]
    for name, data in (("ct.nii", raw), ("ct.nii.gz", gzip.compress(raw, mtime=0))):
        found = read_ct_volume(data, name)
        assert_same(found, CtVolume(expected.astype(np.int16), LEG.lps_from_index))
        assert found.findings == ()


@pytest.mark.parametrize("part", range(1, 16))
def test_scaled_nifti_cut_anywhere(part: int) -> None:
    raw = scaled(1.0, -1024.0)
    for name, data in (("ct.nii", raw), ("ct.nii.gz", gzip.compress(raw, mtime=0))):
        with refused("E-IO-11", name):
            read_ct_volume(data[: len(data) * part // 16], name)


def test_scaling_that_is_no_number() -> None:
    with refused("E-CT-04", "intercept inf"):
        read_ct_volume(scaled_header(1.0, np.inf), "ct.nii")
    with refused("E-CT-02", "expected Hounsfield units"):
        read_ct_volume(scaled_header(1e30, 0.0), "ct.nii")


def scaled_header(slope: float, intercept: float) -> bytes:
    raw = nifti(LEG.values)
    header = nibabel.Nifti1Header.from_fileobj(io.BytesIO(raw), check=False)
    header["scl_slope"], header["scl_inter"] = slope, intercept
    return bytes(header.binaryblock) + raw[348:]


@pytest.mark.fault("V01")
@each_format
def test_cut_anywhere(name: str, tmp_path: Path) -> None:
    data = FORMATS[name](LEG.values, tmp_path)
    for part in range(17):
        with refused("E-IO-11", name) as caught:
            read_ct_volume(data[: min(len(data) * part // 16, len(data) - 1)], name)
        assert "label" not in str(caught.value)


@pytest.mark.fault("V06")
def test_a_mirrored_storage_is_put_right() -> None:
    matrix = LEG.lps_from_index.copy()
    matrix[:3, 3] += matrix[:3, 0] * 23
    matrix[:3, 0] *= -1.0
    found = read_ct_volume(nifti(LEG.values[::-1], matrix), "ct.nii")
    assert_same(found, LEG)
    assert codes(found) == ["N-GEO-01"]


@pytest.mark.fault("V03", "V05", "V07", "V08")
@pytest.mark.parametrize(
    ("axes", "code"),
    [
        (np.diag([1.0, 1.25, 0.01]), "E-GEO-06"),
        (np.diag([0.5, 1.25, 2.0]), "E-GEO-07"),
        (np.array([[1.0, 0.02, 0.0], [0.0, 1.25, 0.0], [0.0, 0.0, 2.0]]), "E-GEO-04"),
        (np.diag([1.0, 1.25, 0.0]), "E-GEO-03"),
    ],
)
def test_geometry_gate(axes: NDArray[np.float64], code: str, tmp_path: Path) -> None:
    matrix = np.eye(4)
    matrix[:3, :3] = axes
    with refused(code, "ct.nrrd"):
        read_ct_volume(made_by_nrrd(LEG.values, tmp_path, matrix), "ct.nrrd")


@pytest.mark.parametrize("name", ["ct.mhd", "ct.nhdr", "ct.img", "ct.hdr", "ct.jpg", "ct"])
def test_formats_that_are_not_read(name: str) -> None:
    detached = name[-4:] in (".mhd", "nhdr", ".img", ".hdr")
    with refused("E-IO-12", "its voxels are in another file" if detached else "expected a file that ends in"):
        read_ct_volume(b"", name)


@pytest.mark.fault("V09")
def test_more_than_one_volume() -> None:
    with refused("E-CT-01", "not one 3-D volume"):
        read_ct_volume(nifti(np.stack([LEG.values] * 2, axis=-1)), "ct.nii")
    with refused("E-CT-01", "not one 3-D volume"):
        read_ct_volume(b"NDims = 2\nElementDataFile = LOCAL\n", "ct.mha")


def test_fractions_are_rounded_with_a_note() -> None:
    found = read_ct_volume(nifti((LEG.values + 0.25).astype(np.float32)), "ct.nii")
    assert_same(found, LEG)
    assert codes(found) == ["N-CT-01"]


@pytest.mark.parametrize("value", [np.nan, np.inf, -4000.0, 40_000.0, 1e30])
def test_values_that_no_ct_has(value: float) -> None:
    values = LEG.values.astype(np.float64)
    values[3, 2, 1] = value
    with refused("E-CT-02", "expected Hounsfield units"):
        read_ct_volume(nifti(values), "ct.nii")


def test_a_picture_without_bone() -> None:
    with refused("E-CT-03", "shows no bone: 0 %"):
        read_ct_volume(nifti(np.minimum(LEG.values, 250)), "ct.nii")


def test_a_lost_scale_has_no_air() -> None:
    found = read_ct_volume(nifti((LEG.values + 1024).astype(np.int16)), "ct.nii")
    assert codes(found) == ["W-CT-01"]


@pytest.mark.fault("V20")
def test_metal() -> None:
    values = LEG.values.copy()
    values[9:13, 7:11, 2:8] = 3071
    assert codes(read_ct_volume(nifti(values), "ct.nii")) == ["N-CT-02"]
    values[9:13, 7:11, 2:8] = 9000
    found = read_ct_volume(nifti(values), "ct.nii")
    assert codes(found) == ["W-CT-02"]
    assert "96 voxels" in found.findings[0].message


def test_the_gate_takes_the_range_of_scanners() -> None:
    values = LEG.values.copy()
    values[0, 0, 0] = -3024
    assert check_hounsfield(values, "ct.nii") == ()
    assert hounsfield(values, (1.0, 0.0), "ct.nii")[1] == ()


@needs_foot
def test_a_real_ct() -> None:
    found = read_ct_volume(FOOT.read_bytes(), "foot.nii.gz")
    assert found.volume.values.min() >= -3100
    assert np.linalg.det(found.volume.lps_from_index[:3, :3]) > 0
    assert not [finding for finding in found.findings if finding.code.startswith("W")]
