"""Label maps of every format: one canonical volume, and a refusal for each lie a file can tell."""

from __future__ import annotations

import gzip
import itertools
from collections.abc import Callable
from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK

from pipeline.errors import CaseRejected
from pipeline.files.foreign_image import Layout, check_layout
from pipeline.files.geometry_gate import EXTENT_MM
from pipeline.files.volumes import LabelMap, read_label_map
from pipeline.geometry.volume import LabelVolume
from tests.files.label_samples import (
    itk_bytes,
    knee_like,
    nifti_bytes,
    nifti_image,
    nrrd_bytes,
    oblique_matrix,
    restored,
    segment_keys,
    with_header,
)
from tests.files.seg_samples import Described, SegSpec, seg_bytes

DATA = Path(__file__).resolve().parents[3] / "shared/data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="real data not found beside the checkout")

KNEE = knee_like()
AS_LABEL_MAP = SegSpec("LABELMAP", segments=[Described(f"part {n}") for n in range(1, 8)], omit_empty=False)
#: Name of the file -> what writes it; float32 headers (NIfTI) round the matrix to 1e-7 of a metre or so.
WRITERS: dict[str, tuple[str, Callable[[LabelVolume, Path], bytes]]] = {
    "nifti1 gz": ("labels.nii.gz", lambda v, _: nifti_bytes(v)),
    "nifti1": ("labels.nii", lambda v, _: nifti_bytes(v, compressed=False)),
    "nifti2": ("labels.nii", lambda v, _: nifti_bytes(v, compressed=False, kind=nibabel.Nifti2Image)),
    "nifti itk": ("labels.nii", lambda v, folder: itk_bytes(v, folder, "x.nii")),
    "nrrd lps": ("labels.nrrd", lambda v, _: nrrd_bytes(v)),
    "nrrd ras": ("labels.nrrd", lambda v, _: nrrd_bytes(v, space="right-anterior-superior")),
    "nrrd las": ("labels.nrrd", lambda v, _: nrrd_bytes(v, space="left-anterior-superior")),
    "nrrd raw": ("labels.nrrd", lambda v, _: nrrd_bytes(v, {"encoding": "raw"})),
    "nrrd itk": ("labels.nrrd", lambda v, folder: itk_bytes(v, folder, "x.nrrd")),
    "seg.nrrd": ("labels.seg.nrrd", lambda v, _: nrrd_bytes(v, segment_keys({"Femur": 5, "Tibia": 6}))),
    "mha": ("labels.mha", lambda v, folder: itk_bytes(v, folder, "x.mha")),
    "dicom seg": ("labels.dcm", lambda v, _: seg_bytes(v, AS_LABEL_MAP)),
    "mha raw": ("labels.mha", lambda v, folder: itk_bytes(v, folder, "x.mha", compressed=False)),
}


def assert_same(found: LabelMap, expected: LabelVolume) -> None:
    np.testing.assert_array_equal(found.volume.values, expected.values)
    np.testing.assert_allclose(found.volume.lps_from_index, expected.lps_from_index, atol=1e-4)


def refused(code: str, problem: str) -> pytest.RaisesExc[CaseRejected]:
    return pytest.raises(CaseRejected, match=f"^{code} .*{problem}")


@pytest.mark.parametrize("writer", WRITERS)
def test_every_format_gives_the_same_volume(writer: str, tmp_path: Path) -> None:
    name, write = WRITERS[writer]
    found = read_label_map(write(KNEE, tmp_path), name)
    assert_same(found, KNEE)
    assert found.volume.values.dtype == np.uint16
    np.testing.assert_array_equal(np.flatnonzero(found.counts), [0, 1, 5, 6, 7])
    assert found.findings == ()


@pytest.mark.fault("V06")
@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
@pytest.mark.parametrize("flips", list(itertools.product((False, True), repeat=3)))
def test_every_storage_order_gives_the_same_volume(order: tuple[int, int, int], flips: tuple[bool, bool, bool]) -> None:
    stored = restored(KNEE, order, flips)
    found = read_label_map(nrrd_bytes(stored), "labels.nrrd")
    assert_same(found, KNEE)
    assert np.linalg.det(found.volume.lps_from_index[:3, :3]) > 0
    is_left_handed = np.linalg.det(stored.lps_from_index[:3, :3]) < 0
    assert [finding.code for finding in found.findings] == ["N-GEO-01"] * int(is_left_handed)


def test_a_mirrored_matrix_mirrors_the_anatomy() -> None:
    """A left-handed header is honoured, not repaired: the same voxels mean the mirror image."""
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    found = read_label_map(nrrd_bytes(LabelVolume(KNEE.values, mirror @ KNEE.lps_from_index)), "labels.nrrd")
    odd = np.argwhere(np.asarray(found.volume.values) == 7).mean(axis=0)
    original = np.argwhere(np.asarray(KNEE.values) == 7).mean(axis=0)
    place = found.volume.lps_from_index[:3, :3] @ odd + found.volume.lps_from_index[:3, 3]
    expected = KNEE.lps_from_index[:3, :3] @ original + KNEE.lps_from_index[:3, 3]
    np.testing.assert_allclose(place, expected * (-1.0, 1.0, 1.0), atol=1e-9)


@pytest.mark.fault("V10")
@pytest.mark.parametrize("dtype", [np.int16, np.uint16, np.int32, np.int64, np.float32, np.float64, ">i2", ">f4"])
def test_whole_numbers_of_any_type(dtype: str) -> None:
    typed = LabelVolume(np.asarray(KNEE.values).astype(dtype), KNEE.lps_from_index)
    found = read_label_map(nrrd_bytes(typed), "labels.nrrd")
    assert_same(found, KNEE)
    assert [f.code for f in found.findings] == ["N-LBL-02"] * int(np.dtype(dtype).kind == "f")


@pytest.mark.fault("V10")
@pytest.mark.parametrize(
    ("value", "problem"),
    [
        (0.5, "fractions"),
        (1.0000001, "fractions"),
        (np.nan, "values from nan"),
        (-1.0, "values from -1"),
        (7e4, "to 70000"),
    ],
)
def test_values_that_are_no_labels(value: float, problem: str) -> None:
    values = np.asarray(KNEE.values).astype(np.float64)
    values[3, 2, 1] = value
    with refused("E-LBL-02", problem):
        read_label_map(nrrd_bytes(LabelVolume(values, KNEE.lps_from_index)), "labels.nrrd")


def test_an_image_is_no_label_map() -> None:
    values = (np.arange(np.asarray(KNEE.values).size) % 500).astype(np.uint16).reshape(KNEE.values.shape)
    with refused("E-LBL-02", "500 different values"):
        read_label_map(nrrd_bytes(LabelVolume(values, KNEE.lps_from_index)), "labels.nrrd")


@pytest.mark.fault("V01")
@pytest.mark.parametrize("writer", ["nifti1 gz", "nifti1", "nrrd lps", "nrrd raw", "mha", "mha raw"])
def test_truncated_anywhere(writer: str, tmp_path: Path) -> None:
    name, write = WRITERS[writer]
    data = write(KNEE, tmp_path)
    for part in range(17):
        with refused("E-IO-11", "labels"):
            read_label_map(data[: min(len(data) * part // 16, len(data) - 1)], name)


@pytest.mark.fault("V01")
@pytest.mark.parametrize("writer", ["nifti1 gz", "nifti1", "nrrd lps", "nrrd raw", "mha", "mha raw"])
def test_trailing_bytes(writer: str, tmp_path: Path) -> None:
    name, write = WRITERS[writer]
    with refused("E-IO-11", "labels"):
        read_label_map(write(KNEE, tmp_path) + b"rest", name)


@pytest.mark.fault("V01")
@pytest.mark.parametrize("writer", ["nifti1 gz", "nrrd lps", "mha"])
def test_flipped_bits_in_compressed_voxels(writer: str, tmp_path: Path) -> None:
    """Each is refused, or (a flag of the gzip header) harmless: never another volume."""
    name, write = WRITERS[writer]
    data = bytearray(write(KNEE, tmp_path))
    begin = max(data.rfind(b"\x1f\x8b\x08"), data.rfind(b"LOCAL\n") + 6)
    refusals = 0
    for position in range(begin + 10, len(data), 7):
        data[position] ^= 1 << (position % 8)
        try:
            assert_same(read_label_map(bytes(data), name), KNEE)
        except CaseRejected:
            refusals += 1
        data[position] ^= 1 << (position % 8)
    assert refusals > 0.9 * len(range(begin + 10, len(data), 7))


@pytest.mark.fault("V21")
@pytest.mark.parametrize("name", ["labels.nhdr", "labels.mhd", "labels.hdr", "labels.img", "labels.png", "labels"])
def test_other_kinds_of_files(name: str) -> None:
    with refused("E-IO-12", "labels"):
        read_label_map(nrrd_bytes(KNEE), name)


@pytest.mark.fault("V21")
@pytest.mark.parametrize(
    "line", [b"data file: /etc/passwd", b"datafile: x.raw", b"byte skip: -1", b"line skip: 2", b"encoding: hex"]
)
def test_nrrd_that_points_elsewhere(line: bytes) -> None:
    data = nrrd_bytes(KNEE).replace(b"encoding: gzip\n", b"" if line.startswith(b"enc") else b"encoding: gzip\n")
    with refused("E-IO-12", "labels.nrrd"):
        read_label_map(data.replace(b"dimension: 3\n", b"dimension: 3\n" + line + b"\n"), "labels.nrrd")


@pytest.mark.fault("V21")
def test_mha_that_points_elsewhere(tmp_path: Path) -> None:
    data = itk_bytes(KNEE, tmp_path, "x.mha").replace(b"= LOCAL", b"= /etc/passwd")
    with refused("E-IO-12", "in another file"):
        read_label_map(data, "labels.mha")


@pytest.mark.fault("V08")
@pytest.mark.parametrize(
    ("old", "new", "code", "problem"),
    [
        (b"space: left-posterior-superior\n", b"", "E-GEO-01", "space is missing"),
        (b"left-posterior-superior", b"scanner-xyz", "E-GEO-01", "scanner-xyz"),
        (b"space origin", b"content", "E-GEO-01", "space origin missing"),
        (b"space directions", b"content", "E-GEO-01", "space directions missing"),
        (b"dimension: 3\n", b'dimension: 3\nspace units: "m" "m" "m"\n', "E-GEO-05", "in m,"),
        (b"dimension: 3", b"dimension: 4", "E-IO-13", "4 dimensions"),
        (b"dimension: 3", b"dimension: three", "E-IO-13", "header of labels.nrrd"),
        (b"dimension: 3\n", b"dimension: 3\ntype: uint8\n", "E-IO-13", "Duplicate"),
        (b"type: uint8", b"type: block", "E-IO-12", "type block"),
        (b"type: uint8", b"type: short", "E-IO-13", "endian"),
        (b"sizes: 26", b"sizes: 27", "E-IO-11", "expected 14256 bytes"),
        (b"sizes: 26", b"sizes: 25", "E-IO-11", "more than the 13200 bytes"),
        (b"sizes: 26", b"sizes: -26", "E-IO-13", "size -26"),
        (b"sizes: 26 22 24", b"sizes: 100000 100000 100", "E-IO-14", "1000.0 GB"),
    ],
)
def test_nrrd_headers_that_lie(old: bytes, new: bytes, code: str, problem: str) -> None:
    data = nrrd_bytes(KNEE)
    assert old in data
    with refused(code, problem):
        read_label_map(data.replace(old, new), "labels.nrrd")


@pytest.mark.fault("V08")
@pytest.mark.parametrize(
    ("old", "new", "code", "problem"),
    [
        (b"TransformMatrix", b"Comment", "E-GEO-01", "TransformMatrix missing"),
        (b"Offset", b"Comment", "E-GEO-01", "Offset missing"),
        (b"NDims = 3", b"NDims = 4", "E-LBL-04", "4 dimensions"),
        (b"MET_UCHAR", b"MET_OTHER", "E-IO-12", "MET_OTHER"),
        (b"DimSize = 26", b"DimSize = 27", "E-IO-11", "damaged"),
        (b"DimSize = 26", b"DimSize = x", "E-IO-13", "DimSize"),
        (b"BinaryData = True", b"BinaryData = False", "E-IO-12", "BinaryData"),
        (b"CompressedData = True", b"CompressedData = Maybe", "E-IO-13", "CompressedData"),
        (b"NDims = 3\n", b"NDims = 3\nNDims = 3\n", "E-IO-13", "repeats"),
    ],
)
def test_mha_headers_that_lie(old: bytes, new: bytes, code: str, problem: str, tmp_path: Path) -> None:
    data = itk_bytes(KNEE, tmp_path, "x.mha")
    assert old in data
    with refused(code, problem):
        read_label_map(data.replace(old, new), "labels.mha")


@pytest.mark.fault("V08")
@pytest.mark.parametrize(
    ("fields", "code", "problem"),
    [
        ({"sform_code": 0, "qform_code": 0}, "E-GEO-01", "neither an sform nor a qform"),
        ({"srow_x": (1.0, 0.0, 0.0, 3.0)}, "E-GEO-02", "sform RPS, qform LPS"),
        ({"pixdim": (1, 1, 1.5, 2.5, 1, 1, 1, 1)}, "E-GEO-02", "two"),
        ({"qform_code": 0, "pixdim": (1, 1, 1.5, 2.5, 1, 1, 1, 1)}, "E-GEO-02", "voxel sizes"),
        ({"qform_code": 0, "srow_z": (np.nan, 0, 0, 0)}, "E-GEO-03", "not finite"),
        ({"pixdim": (0.5, 1, 1.5, 2, 1, 1, 1, 1)}, "E-IO-13", "pixdim"),
        ({"quatern_b": 5.0}, "E-IO-13", "quaternion"),
        ({"xyzt_units": 1}, "E-GEO-05", "metres"),
        ({"xyzt_units": 3}, "E-GEO-05", "micrometres"),
        ({"scl_slope": 2.0, "scl_inter": 1.0}, "E-LBL-05", "slope 2, intercept 1"),
        ({"datatype": 128, "bitpix": 24}, "E-IO-12", "type"),
        ({"datatype": 32, "bitpix": 64}, "E-IO-12", "complex64"),
        ({"datatype": 9999}, "E-IO-13", "voxel type"),
        ({"magic": b"ni1"}, "E-IO-12", "single-file"),
        ({"vox_offset": 300}, "E-IO-13", "byte 300"),
        ({"dim": (4, 26, 22, 12, 2, 1, 1, 1)}, "E-LBL-04", "26 x 22 x 12 x 2"),
        ({"dim": (2, 26, 528, 1, 1, 1, 1, 1)}, "E-LBL-04", "26 x 528"),
        ({"dim": (9, 26, 22, 24, 1, 1, 1, 1)}, "E-IO-12", "single-file"),
        ({"dim": (0, 26, 22, 24, 1, 1, 1, 1)}, "E-IO-13", "0 dimensions"),
        ({"dim": (3, -26, 22, 24, 1, 1, 1, 1)}, "E-IO-13", "size -26"),
        ({"dim": (3, 30000, 30000, 30000, 1, 1, 1, 1)}, "E-IO-14", "30000"),
        ({"dim": (3, 27, 22, 24, 1, 1, 1, 1)}, "E-IO-11", "expected"),
    ],
)
def test_nifti_headers_that_lie(fields: dict[str, object], code: str, problem: str) -> None:
    raw = with_header(nifti_bytes(KNEE, compressed=False), **fields)
    for name, data in (("labels.nii", raw), ("labels.nii.gz", gzip.compress(raw))):
        with refused(code, problem):
            read_label_map(data, name)


@pytest.mark.fault("V03", "V04")
@pytest.mark.parametrize("forms", [(1, 0), (0, 1), (4, 2)])
def test_nifti_with_one_form_or_both(forms: tuple[int, int]) -> None:
    image = nifti_image(KNEE)
    image.set_sform(image.affine, forms[0])
    image.set_qform(image.affine, forms[1])
    assert_same(read_label_map(image.to_bytes(), "labels.nii"), KNEE)


@pytest.mark.parametrize("kind", [nibabel.Nifti1Image, nibabel.Nifti2Image])
def test_nifti_with_extensions_before_its_voxels(kind: type) -> None:
    image = nifti_image(KNEE, kind)
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension("comment", b"x" * 5000))
    data = image.to_bytes()
    assert b"x" * 5000 in data
    assert_same(read_label_map(data, "labels.nii"), KNEE)
    assert_same(read_label_map(gzip.compress(data), "labels.nii.gz"), KNEE)


@pytest.mark.fault("V09")
def test_nifti_with_a_fourth_axis_of_one_and_no_unit() -> None:
    raw = with_header(nifti_bytes(KNEE, compressed=False), dim=(4, 26, 22, 24, 1, 1, 1, 1), xyzt_units=0)
    found = read_label_map(raw, "labels.nii")
    assert_same(found, KNEE)
    assert [finding.code for finding in found.findings] == ["N-GEO-02"]


@pytest.mark.fault("V05")
@pytest.mark.parametrize("shear", [1e-6, 5e-5, 2e-4, 1e-2, 0.3])
def test_sheared_axes(shear: float) -> None:
    matrix = oblique_matrix()
    matrix[:3, 1] += shear * 1.5 * matrix[:3, 0]
    data = nrrd_bytes(LabelVolume(KNEE.values, matrix))
    if shear <= 1e-4:
        assert_same(read_label_map(data, "labels.nrrd"), LabelVolume(KNEE.values, matrix))
    else:
        with refused("E-GEO-04", "not at right angles"):
            read_label_map(data, "labels.nrrd")


@pytest.mark.fault("V07")
@pytest.mark.parametrize(
    ("factor", "code", "problem"),
    [
        (1e-3, "E-GEO-06", "metres"),
        (1e3, "E-GEO-06", "micrometres"),
        (3.0, "E-GEO-06", "voxel size"),
        (0.0, "E-GEO-03", "flat"),
    ],
)
def test_wrong_units(factor: float, code: str, problem: str) -> None:
    matrix = KNEE.lps_from_index @ np.diag([factor, factor, factor, 1.0])
    with refused(code, problem):
        read_label_map(nrrd_bytes(LabelVolume(KNEE.values, matrix)), "labels.nrrd")


def test_a_volume_smaller_than_any_joint() -> None:
    small = LabelVolume(np.asarray(KNEE.values)[:10, :10, :9], KNEE.lps_from_index)
    with refused("E-GEO-07", f"extent .* expected {EXTENT_MM[0]:g} to"):
        read_label_map(nrrd_bytes(small), "labels.nrrd")


@pytest.mark.fault("V23")
@pytest.mark.parametrize("layers", [1, 2])
def test_layers_of_seg_nrrd(layers: int) -> None:
    values = np.stack([np.asarray(KNEE.values)] * layers)
    extra = {
        "kinds": ["list", "domain", "domain", "domain"],
        "space directions": np.vstack([[np.nan] * 3, KNEE.lps_from_index[:3, :3].T]),
    }
    data = nrrd_bytes(LabelVolume(values, KNEE.lps_from_index), extra)
    if layers == 1:
        assert_same(read_label_map(data, "labels.seg.nrrd"), KNEE)
    else:
        with refused("E-LBL-04", "has 2 layers"):
            read_label_map(data, "labels.seg.nrrd")


@pytest.mark.fault("V23")
def test_segments_are_named() -> None:
    data = nrrd_bytes(KNEE, segment_keys({"Femur": 5, "Femoral cartilage": 1}))
    assert read_label_map(data, "labels.seg.nrrd").segments == {"Femur": 5, "Femoral cartilage": 1}


@pytest.mark.parametrize("old", ["Segment1_Name:=Tibia", "Segment1_LabelValue:=6"])
@pytest.mark.parametrize("new", ["none", "same"])
def test_segments_without_a_name_or_value_of_their_own(old: str, new: str) -> None:
    data = nrrd_bytes(KNEE, segment_keys({"Femur": 5, "Tibia": 6}))
    key = old.split(":=", maxsplit=1)[0]
    same = {"Segment1_Name": "Femur", "Segment1_LabelValue": "5"}[key]
    replacement = f"{key}:={same}" if new == "same" else "Segment1_Other:=x"
    assert old.encode() in data
    with refused("E-IO-13", "of its own"):
        read_label_map(data.replace(old.encode(), replacement.encode()), "labels.seg.nrrd")


@pytest.mark.fault("V22")
def test_limits_are_checked_before_anything_is_allocated() -> None:
    with refused("E-IO-14", "at most"):
        check_layout(Layout((100_000, 100_000, 100), np.dtype("u1")), "x")
    with refused("E-IO-14", "at most"):
        check_layout(Layout((1000, 1000, 600), np.dtype("f8")), "x")


@pytest.mark.fault("V22")
def test_a_gzip_bomb_is_not_inflated() -> None:
    small = with_header(nifti_bytes(KNEE, compressed=False))
    bomb = gzip.compress(small + bytes(50_000_000))
    with refused("E-IO-11", "more than"):
        read_label_map(bomb, "labels.nii.gz")


@needs_data
@pytest.mark.parametrize("case", ["knee_mr_a", "knee_mr_b"])
def test_real_knees_lie_where_simpleitk_says(case: str) -> None:
    path = DATA / case / "labels.nrrd"
    found = read_label_map(path.read_bytes(), path.name).volume
    image = SimpleITK.ReadImage(str(path))
    index = np.argwhere(np.asarray(found.values) == 5)[::100_000]
    assert len(index) > 10
    for i, j, k in index:
        place = found.lps_from_index @ (i, j, k, 1.0)
        there = image.TransformPhysicalPointToIndex([float(x) for x in place[:3]])
        assert image.GetPixel(there) == 5
        np.testing.assert_allclose(image.TransformIndexToPhysicalPoint(there), place[:3], atol=1e-6)


@needs_data
def test_a_ct_is_refused() -> None:
    path = DATA / "foot_ct/foot_ct_crop.nii.gz"
    with refused("E-LBL-02", "values from -1024"):
        read_label_map(path.read_bytes(), path.name)
