"""A folder of DICOM files to one CT: the same volume however it was written, and a refusal for each fault."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import CaseRejected
from pipeline.files import dicom_series
from pipeline.files.dicom_series import MAX_FILES, choose_series, read_dicom_series
from pipeline.files.dicom_writer import TRANSFER_SYNTAXES, SeriesSpec, encode_series
from pipeline.geometry.volume import CtVolume
from tests.files import dicom_samples
from tests.files.dicom_samples import (
    SECONDARY_CAPTURE,
    STRUCTURED_REPORT,
    Files,
    assert_same,
    codes,
    deflated,
    ds,
    edited,
    enhanced,
    headers_of,
    leg,
    other_object,
    read,
    refused,
    scout,
    series,
    short,
    turned,
    with_edited,
    without,
)

FOOT = Path(__file__).resolve().parents[3] / "shared/data/foot_ct/dicom"
needs_foot = pytest.mark.skipif(not FOOT.is_dir(), reason="the foot CT was not found beside the checkout")

LEG = leg()
FILES = series()
MIDDLE, LAST = "IM0006.dcm", "IM0012.dcm"


# what is accepted


@pytest.mark.fault("D16")
@pytest.mark.parametrize("syntax", TRANSFER_SYNTAXES)
@pytest.mark.parametrize("signed", [True, False])
def test_every_syntax_gives_the_same_volume(syntax: str, *, signed: bool) -> None:
    found = read(series(SeriesSpec(syntax=syntax, signed=signed)))
    assert_same(found, LEG)
    assert found.volume.values.dtype == np.int16
    assert (found.findings, found.set_aside, found.laterality) == ((), (), None)


@pytest.mark.fault("D10")
@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
@pytest.mark.parametrize("flips", list(itertools.product((False, True), repeat=3)))
def test_every_orientation_gives_the_same_volume(order: tuple[int, int, int], flips: tuple[bool, ...]) -> None:
    """Head or feet first, supine or prone, axial, sagittal, coronal; a little oblique, so that nothing is round."""
    ct = leg(oblique=True)
    values, matrix = np.transpose(ct.values, order), ct.lps_from_index[:, (*order, 3)].copy()
    for axis in np.flatnonzero(flips):
        matrix[:3, 3] += matrix[:3, axis] * (values.shape[axis] - 1)
        matrix[:3, axis] *= -1.0
        values = np.flip(values, int(axis))
    found = read(encode_series(CtVolume(values, matrix)))
    assert_same(found, ct)
    assert found.findings == ()


@pytest.mark.fault("D10")
@pytest.mark.parametrize("angles", [(30.0, 20.0), (-75.0, 10.0), (3.0, 44.0)])
def test_any_oblique_stack_lands_where_its_headers_say(angles: tuple[float, float]) -> None:
    matrix = LEG.lps_from_index.copy()
    matrix[:3, :3] = turned(*angles) * dicom_samples.SPACING_MM
    found = read(encode_series(CtVolume(LEG.values, matrix))).volume
    index = np.linalg.inv(found.lps_from_index) @ matrix @ (8.0, 7.0, 3.0, 1.0)
    at = tuple(int(n) for n in np.rint(index[:3]))
    np.testing.assert_allclose(index[:3], at, atol=1e-6)
    assert found.values[at] == LEG.values[8, 7, 3]
    assert np.linalg.det(found.lps_from_index[:3, :3]) > 0


def test_names_and_their_order_mean_nothing() -> None:
    shuffled = {
        f"x/{n}.{ending}": data for (n, ending), data in zip(_odd_names(), reversed(FILES.values()), strict=True)
    }
    assert_same(read(shuffled), LEG)


def _odd_names() -> list[tuple[int, str]]:
    return [((7 * n) % 12, "IMA" if n % 2 else "17") for n in range(12)]


def test_laterality_and_facts() -> None:
    found = read(with_edited(series(SeriesSpec(laterality="L")), {"KVP": b"120", "ConvolutionKernel": b"B60f"}))
    assert (found.laterality, found.facts.kvp, found.facts.kernel, found.facts.lossy) == ("left", 120.0, "B60f", False)
    mixed = with_edited(series(SeriesSpec(laterality="L")), {"Laterality": b"R"}, MIDDLE)
    assert read(mixed).laterality is None


@needs_foot
def test_a_real_series() -> None:
    files = {path.name: path.read_bytes() for path in sorted(FOOT.iterdir())}
    found = read(files)
    assert found.volume.values.shape == (512, 512, 20)
    np.testing.assert_allclose(found.volume.lps_from_index[:3, 3], (0.0, 0.0, 100.0))
    assert (found.volume.values.min(), found.volume.values.max()) == (-1024, 1427)
    assert found.set_aside == ()
    assert codes(found) == ["N-DCM-05"]
    assert "numbered from 101 on" in found.findings[0].message  # it is a part of a longer series
    with refused("E-DCM-09", r"1 slices are missing .*\(0, 0, 109\) mm .*\(0, 0, 111\) mm"):
        read({name: data for name, data in files.items() if "_111" not in name})


# what is set aside


@pytest.mark.fault("D03")
def test_identical_copies_are_set_aside() -> None:
    found = read({**FILES, "copy/IM0006.dcm": FILES[MIDDLE]})
    assert_same(found, LEG)
    assert found.set_aside == (("copy/IM0006.dcm", "copy of IM0006.dcm"),)
    assert codes(found) == ["N-DCM-01"]


@pytest.mark.fault("D06")
@pytest.mark.parametrize(("localizer", "size"), [(True, 20), (True, 33), (False, 20), (False, 33)])
def test_scouts_are_set_aside(size: int, *, localizer: bool) -> None:
    found = read({**FILES, "IM0000.dcm": scout(FILES, localizer=localizer, size=size)})
    assert_same(found, LEG)
    assert [file for file, why in found.set_aside if "localiser" in why] == ["IM0000.dcm"]


@pytest.mark.fault("D24")
def test_junk_is_set_aside() -> None:
    junk = {
        "Thumbs.db": b"\xd0\xcf\x11\xe0",
        ".DS_Store": b"\0\0\0\1Bud1",
        "DICOMDIR": b"junk",
        "._IM0001.dcm": b"\0\5\x16\7",
        "series.zip": b"PK\3\4",
        "notes.txt": b"text",
        "report.dcm": other_object(FILES, "SR", STRUCTURED_REPORT),
        "structures.dcm": other_object(FILES, "RTSTRUCT", "1.2.840.10008.5.1.4.1.1.481.3"),
        "dose.dcm": other_object(FILES, "CT", SECONDARY_CAPTURE),
    }
    found = read({**FILES, **junk})
    assert_same(found, LEG)
    assert dict(found.set_aside).keys() == junk.keys()
    assert dict(found.set_aside)["report.dcm"] == "modality SR, not CT"
    assert codes(found) == ["N-DCM-01"]


@pytest.mark.fault("D24", "D30")
@pytest.mark.parametrize(
    ("files", "problem"),
    [
        ({}, "no file at all"),
        ({"notes.txt": b"x"}, "1 x not DICOM"),
        ({"ct.zip": b"PK\3\4"}, "archive, unpack it"),
        ({"a.dcm": other_object(FILES, "MR", "1.2.840.10008.5.1.4.1.1.4")}, "modality MR, not CT"),
    ],
)
def test_nothing_to_read(files: Files, problem: str) -> None:
    with refused("E-DCM-01", problem):
        read(files)


# which series


@pytest.mark.fault("D05")
def test_two_series_are_listed() -> None:
    other = {f"other/{name}": data for name, data in list(series(SeriesSpec(seed="b")).items())[:5]}
    with refused("E-DCM-03", "more than one study: 12 slices with IM0001.dcm, 5 slices with other/IM0001.dcm"):
        read({**FILES, **other})
    study = {"StudyInstanceUID": b"1.2.3", "FrameOfReferenceUID": b"1.2.4"}
    same_study = {**with_edited(FILES, study), **with_edited(other, study)}
    with refused("E-DCM-03", "more than one series: 12 slices with IM0001.dcm, 5 slices with other/IM0001.dcm"):
        read(same_study)


@pytest.mark.fault("D07")
def test_two_patients_under_one_series() -> None:
    names = [f"IM{n:04d}.dcm" for n in range(1, 7)]
    with refused("E-DCM-02", "more than one patient: 6 slices with IM0001.dcm, 6 slices with IM0007.dcm") as caught:
        read(with_edited(FILES, {"PatientID": b"CANARY7", "PatientName": b"Canary^Eve"}, *names))
    assert "canary" not in str(caught.value).lower()
    with refused("E-DCM-02"):
        read(with_edited(FILES, {"PatientName": b"Another"}, MIDDLE))


def test_two_frames_of_reference() -> None:
    with refused("E-DCM-03", "frame of reference"):
        read(with_edited(FILES, {"FrameOfReferenceUID": b"1.2.3.4"}, MIDDLE))


@pytest.mark.fault("D02")
def test_slices_that_are_missing_at_an_end() -> None:
    cut = without(FILES, "IM0001.dcm", "IM0002.dcm")
    assert codes(read(cut)) == ["N-DCM-05"]
    assert "numbered from 3 on; 2 may be missing" in read(cut).findings[0].message
    for keyword in ("ImagesInAcquisition", "NumberOfSeriesRelatedInstances"):
        told = with_edited(FILES, {keyword: b"12"})
        assert codes(read(told)) == []
        for lost in ("IM0001.dcm", LAST):
            found = read(without(told, lost))
            assert codes(found) == ["W-DCM-03"]
            assert "says that it has 12 images, and 11 are here" in found.findings[0].message


def test_numbers_that_a_scout_or_nobody_has_taken() -> None:
    numbered = {
        name: edited(data, {"InstanceNumber": str(n).encode()}) for n, (name, data) in enumerate(FILES.items(), 2)
    }
    assert codes(read(numbered)) == ["N-DCM-05"]
    overview = edited(scout(FILES, localizer=True), {"InstanceNumber": b"1"})
    assert codes(read({**numbered, "IM0000.dcm": overview})) == ["N-DCM-01"]
    assert codes(read(with_edited(FILES, {"InstanceNumber": None}))) == []


def test_too_few_slices() -> None:
    with refused("E-DCM-15", "2 slices"):
        read(dict(list(FILES.items())[:2]))


# tags


@pytest.mark.fault("D11", "D12")
@pytest.mark.parametrize(
    ("keyword", "value", "code", "problem"),
    [
        *((tag, None, "E-DCM-07", f"{tag} of {MIDDLE} is missing") for tag in ("PixelSpacing", "ImagePositionPatient")),
        *((tag, None, "E-DCM-07", f"{tag} of {MIDDLE} is missing") for tag in ("ImageOrientationPatient", "Rows")),
        ("PixelSpacing", b"0,5\\0,5", "E-DCM-07", "PixelSpacing .* is not 2 numbers"),
        ("PixelSpacing", b"0\\1", "E-DCM-07", "PixelSpacing .* is not a length"),
        ("PixelSpacing", b"-1\\1", "E-DCM-07", "PixelSpacing .* is not a length"),
        ("ImagePositionPatient", b"NaN\\0\\0", "E-DCM-07", "is not 3 numbers"),
        ("ImagePositionPatient", b"1e200\\0\\0", "E-DCM-07", "beyond 100 m"),
        ("ImageOrientationPatient", b"1\\0\\0\\0\\1e200\\0", "E-DCM-07", "is not two directions"),
        ("ImageOrientationPatient", ds(1, 0, 0, 0, 0.9, 0), "E-DCM-08", "right angles"),
        ("ImageOrientationPatient", ds(1, 0, 0, 0.1, 0.994987, 0), "E-DCM-08", "right angles"),
        ("ImageOrientationPatient", ds(0, 0, 0, 0, 0, 0), "E-DCM-08", "right angles"),
        ("SeriesInstanceUID", None, "E-DCM-03", "more than one series"),
        ("PixelRepresentation", None, "E-DCM-07", "is missing"),
        ("PixelRepresentation", short(2), "E-DCM-07", "is neither 0 nor 1"),
        ("RescaleSlope", None, "E-DCM-12", f"RescaleSlope of {MIDDLE} is missing"),
        ("RescaleIntercept", None, "E-DCM-12", f"RescaleIntercept of {MIDDLE} is missing"),
        ("RescaleSlope", b"0", "E-DCM-12", "is 0"),
        ("RescaleSlope", b"-1", "E-DCM-12", "is -1"),
        ("RescaleSlope", b"NaN", "E-DCM-12", "is not a number"),
        ("RescaleSlope", b"1e30", "E-DCM-12", "1e\\+30"),
        ("RescaleIntercept", b"1e30", "E-DCM-12", "1e\\+30"),
    ],
)
def test_tags_that_cannot_be_meant(keyword: str, value: bytes | None, code: str, problem: str) -> None:
    with refused(code, problem):
        read(with_edited(FILES, {keyword: value}, MIDDLE))


@pytest.mark.fault("D12")
@pytest.mark.parametrize("value", [None, b"0", b"NaN", b"1e30"])
def test_a_rescale_that_no_slice_has(value: bytes | None) -> None:
    with refused("E-DCM-12", "RescaleSlope of IM0001.dcm"):
        read(with_edited(FILES, {"RescaleSlope": value}))


@pytest.mark.fault("D14")
@pytest.mark.parametrize(
    ("tags", "code", "problem"),
    [
        ({"PhotometricInterpretation": b"MONOCHROME1"}, "E-DCM-06", "photometric MONOCHROME1"),
        ({"PhotometricInterpretation": b"PALETTE COLOR"}, "E-DCM-06", "PALETTE COLOR"),
        ({"PhotometricInterpretation": b"RGB", "SamplesPerPixel": short(3)}, "E-DCM-06", "RGB"),
        ({"SamplesPerPixel": short(2)}, "E-DCM-06", "samples 2"),
        ({"BitsAllocated": short(12)}, "E-DCM-06", "bits_allocated 12"),
        ({"BitsAllocated": short(32)}, "E-DCM-06", "bits_allocated 32"),
        ({"BitsStored": short(17)}, "E-DCM-07", "BitsStored"),
        ({"HighBit": short(14)}, "E-DCM-07", "HighBit"),
        ({"NumberOfFrames": b"3"}, "E-DCM-05", "multi-frame image of 3 frames"),
    ],
)
def test_pixels_of_another_kind(tags: dict[str, bytes | None], code: str, problem: str) -> None:
    with refused(code, problem):
        read(with_edited(FILES, tags))


@pytest.mark.fault("D27")
def test_enhanced_ct_is_refused_by_its_name() -> None:
    with refused("E-DCM-05", "enhanced multi-frame CT"):
        read({"scan.dcm": enhanced(FILES)})
    with refused("E-DCM-05", "enhanced multi-frame CT"):
        read({**FILES, "scan.dcm": enhanced(FILES)})


# damaged files


@pytest.mark.fault("D18")
@pytest.mark.parametrize("syntax", ["explicit little endian", "implicit little endian", "JPEG-LS lossless", "RLE"])
@pytest.mark.parametrize("name", [MIDDLE, LAST])
def test_cut_anywhere(syntax: str, name: str) -> None:  # the last slice too, which no gap would tell
    files = series(SeriesSpec(syntax=syntax))
    whole = files[name]
    for part in range(64):
        with refused("E-IO-11", name):
            read({**files, name: whole[: len(whole) * part // 64]})


@pytest.mark.fault("D18")
@pytest.mark.parametrize("data", [b"", FILES[LAST][:128], FILES[LAST][:132], b"<html>404</html>" * 99])
def test_no_dicom_where_a_slice_should_be(data: bytes) -> None:
    for name in (LAST, "IM0012", "12.IMA"):
        with refused("E-IO-11", f"{name} is damaged or no DICOM file"):
            read({**without(FILES, LAST), name: data})


@pytest.mark.fault("D20")
def test_flipped_bits_of_one_header() -> None:
    """Every third byte before the pixels of the end slice: refused, or the volume is the same to 0.1 mm."""
    begin = headers_of({LAST: FILES[LAST]})[0].pixels[0]
    bits = np.random.default_rng(3).integers(0, 8, begin)
    refusals = 0
    for position in range(132, begin, 3):
        data = bytearray(FILES[LAST])
        data[position] ^= 1 << int(bits[position])
        try:
            found = read({**FILES, LAST: bytes(data)})
        except CaseRejected:
            refusals += 1
            continue
        np.testing.assert_array_equal(found.volume.values, LEG.values)
        np.testing.assert_allclose(found.volume.lps_from_index, LEG.lps_from_index, atol=0.1)
    assert refusals > 100


@pytest.mark.fault("D17")
def test_a_deflated_slice() -> None:
    with refused("E-DCM-04", "deflated"):
        read({**FILES, MIDDLE: deflated(FILES[MIDDLE])})


@pytest.mark.fault("D29")
def test_a_program_in_the_preamble() -> None:
    assert_same(read({name: b"\x7fELF" * 32 + data[128:] for name, data in FILES.items()}), LEG)


@pytest.mark.fault("D26")
def test_a_file_that_changes_between_the_readings() -> None:
    seen: set[str] = set()

    def reading(name: str) -> bytes:
        again = name in seen
        seen.add(name)
        return edited(FILES[name], {"KVP": b"80"}) if again and name == MIDDLE else FILES[name]

    with refused("E-IO-17", f"{MIDDLE} changed"):
        read_dicom_series(list(FILES), reading)


# sizes


@pytest.mark.fault("D21")
@pytest.mark.parametrize(
    ("tags", "code", "problem"),
    [
        ({"Rows": short(65535), "Columns": short(65535)}, "E-IO-14", "65535 x 65535 x 12 voxels"),
        ({"Rows": short(4000)}, "E-IO-11", "bytes of pixels"),
        ({"Rows": short(0)}, "E-DCM-07", "Rows .* is 0"),
        ({"Columns": short(-24)}, "E-IO-11", "bytes of pixels"),
        ({"NumberOfFrames": b"2000000000"}, "E-DCM-05", "2000000000 frames"),
        ({"NumberOfFrames": b"-3"}, "E-DCM-07", "NumberOfFrames .* is below 1"),
        ({"NumberOfFrames": b"0"}, "E-DCM-07", "NumberOfFrames .* is below 1"),
    ],
)
def test_sizes_that_lie(tags: dict[str, bytes | None], code: str, problem: str) -> None:
    with refused(code, problem):
        read(with_edited(FILES, tags))


@pytest.mark.fault("D22")
def test_ten_thousand_large_slices_are_refused_by_their_headers() -> None:
    plain = headers_of({MIDDLE: FILES[MIDDLE]})[0]
    many = [
        replace(plain, file=f"{n}.dcm", sop_uid=f"1.2.{n}", position=(0.0, 0.0, float(n)), rows=2048, columns=2048)
        for n in range(10_000)
    ]
    with refused("E-IO-14", "2048 x 2048 x 10000 voxels"):
        choose_series(many)


@pytest.mark.fault("D22")
def test_too_many_files() -> None:
    with refused("E-IO-14", f"{MAX_FILES + 1} files"):
        read_dicom_series(["x"] * (MAX_FILES + 1), lambda _: b"")


@pytest.mark.parametrize(
    ("spacing", "code"), [(b"0.01\\0.01", "E-GEO-06"), (b"10\\10", "E-GEO-06"), (b"0.5\\0.5", "E-GEO-07")]
)
def test_the_geometry_gate_of_all_volumes(spacing: bytes, code: str) -> None:
    with refused(code, "the CT series"):
        read(with_edited(FILES, {"PixelSpacing": spacing}))


# what must not matter, and what must never happen


@pytest.mark.fault("D28")
def test_texts_of_any_kind_have_no_effect(caplog: pytest.LogCaptureFixture) -> None:
    texts: dict[str, bytes | None] = {
        "SpecificCharacterSet": b"ISO_IR CANARY",
        "PatientName": b"<script>canary</script>\x1b[31m\r\n" + b"canary^" * 1500,
        "PatientID": b"$(canary)\xff\xfe",
        "SeriesDescription": b"canary\x1b(J\xe9",
        "BodyPartExamined": b"<i>canary</i>",
        "ConvolutionKernel": b"canary\nB60",
        "Laterality": b"canary\x07",
    }
    files = with_edited(FILES, texts)
    caplog.clear()
    found = read(files)
    assert_same(found, LEG)
    assert "canary" not in repr((found.findings, found.set_aside, found.facts, found.laterality)) + caplog.text


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_volume_that_does_not_land_is_refused(axis: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The last check, of our own code: voxels turned round without their matrix."""
    monkeypatch.setattr(dicom_series, "in_lps_order", lambda ct: CtVolume(np.flip(ct.values, axis), ct.lps_from_index))
    with refused("E-DCM-16", "own header"):
        read(FILES)


def test_a_volume_that_lies_elsewhere_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    moved = LEG.lps_from_index.copy()
    moved[2, 3] += 0.02
    monkeypatch.setattr(dicom_series, "in_lps_order", lambda ct: CtVolume(ct.values, moved))
    with refused("E-DCM-16", "0.02 mm off its own header"):
        read(FILES)
