"""The header of one DICOM file: its facts, and a reason for each way in which it has none."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from pipeline.files import dicom_headers
from pipeline.files.dicom_headers import DEFLATED, DicomHeader, Fault, Unread, read_header
from pipeline.files.dicom_writer import TRANSFER_SYNTAXES, SeriesSpec
from tests.files.dicom_samples import (
    ORIGIN_MM,
    STRUCTURED_REPORT,
    deflated,
    edited,
    other_object,
    series,
    short,
)

SLICE = series()["IM0002.dcm"]
each_syntax = pytest.mark.parametrize("syntax", TRANSFER_SYNTAXES)


def header_of(data: bytes) -> DicomHeader:
    found = read_header(data, "IM0002.dcm")
    assert isinstance(found, DicomHeader), found
    return found


def unread(data: bytes) -> Unread:
    found = read_header(data, "IM0002.dcm")
    assert isinstance(found, Unread)
    assert found.file == "IM0002.dcm"
    return found


@each_syntax
def test_facts_of_a_slice(syntax: str) -> None:
    found = header_of(series(SeriesSpec(syntax=syntax, laterality="R"))["IM0002.dcm"])
    assert (found.modality, found.rows, found.columns, found.frames) == ("CT", 20, 24, 1)
    assert found.pixel_spacing == (1.25, 1.0)
    assert found.orientation == (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    assert found.position == (*ORIGIN_MM[:2], ORIGIN_MM[2] + 2.0)
    assert (found.slope, found.intercept, found.bits_stored, found.signed) == (1.0, -1024.0, 16, True)
    assert (found.photometric, found.samples, found.laterality, found.lossy) == ("MONOCHROME2", 1, "R", False)
    assert found.transfer_syntax == TRANSFER_SYNTAXES[syntax]
    assert found.faults == ()


def test_facts_that_only_some_scanners_write() -> None:
    tags: dict[str, bytes | None] = {
        "KVP": b"120",
        "ConvolutionKernel": b"B60f",
        "BodyPartExamined": b"KNEE",
        "GantryDetectorTilt": b"-5.5",
        "PixelPaddingValue": short(-2000),
        "PixelPaddingRangeLimit": short(-2048),
        "ImageLaterality": b"L",
        "LossyImageCompression": b"01",
    }
    found = header_of(edited(SLICE, tags))
    assert (found.kvp, found.kernel, found.body_part, found.tilt_deg) == (120.0, "B60f", "KNEE", -5.5)
    assert (found.padding, found.laterality, found.lossy) == ((-2048, -2000), "L", True)


def test_a_patient_is_told_apart_but_not_named() -> None:
    named: dict[str, bytes | None] = {
        "PatientName": b"Canary^Token",
        "PatientID": b"CANARY-ID",
        "PatientBirthDate": b"19700101",
        "SeriesDescription": b"canary text",
        "InstitutionName": b"canary hospital",
        "BodyPartExamined": b"<b>canary</b>",
    }
    found = read_header(edited(SLICE, named), "x", b"salt")
    assert isinstance(found, DicomHeader)
    assert "canary" not in repr(found).lower()
    assert "19700101" not in repr(found)
    other = read_header(edited(SLICE, {**named, "PatientID": b"OTHER"}), "x", b"salt")
    again = read_header(edited(SLICE, {**named, "KVP": b"80"}), "x", b"salt")
    resalted = read_header(edited(SLICE, named), "x", b"pepper")
    assert isinstance(other, DicomHeader)
    assert isinstance(again, DicomHeader)
    assert isinstance(resalted, DicomHeader)
    assert found.patient == again.patient
    assert len({found.patient, other.patient, resalted.patient}) == 3


@pytest.mark.parametrize(
    ("keyword", "value", "problem"),
    [
        ("PixelSpacing", b"0,5\\0,5", "is not 2 numbers"),
        ("PixelSpacing", b"0.5", "is not 2 numbers"),
        ("PixelSpacing", b"NaN\\NaN", "is not 2 numbers"),
        ("PixelSpacing", b"1_0\\10", "is not 2 numbers"),
        ("ImagePositionPatient", b"1\\2\\1e400", "is not finite"),
        ("ImageOrientationPatient", b"1\\0\\0", "is not 6 numbers"),
        ("RescaleSlope", b"NaN", "is not a number"),
        ("RescaleIntercept", b"-1024 HU", "is not a number"),
        ("NumberOfFrames", b"1.5", "is not a whole number"),
        ("Rows", b"\0\1\0\1", "is not one number"),
    ],
)
def test_tags_that_cannot_be_used_are_named(keyword: str, value: bytes, problem: str) -> None:
    assert dict(header_of(edited(SLICE, {keyword: value})).faults) == {keyword: problem}


def test_absent_tags_are_no_faults() -> None:
    found = header_of(edited(SLICE, {"PixelSpacing": None, "RescaleSlope": None, "Rows": None}))
    assert (found.pixel_spacing, found.slope, found.rows, found.faults) == (None, None, None, ())


@each_syntax
def test_cut_anywhere(syntax: str) -> None:
    """No cut of a CT slice gives a header, so none can make the volume shorter."""
    data = series(SeriesSpec(syntax=syntax))["IM0002.dcm"]
    cuts = {len(data) * part // 64 for part in range(64)} | set(range(len(data) - 20, len(data))) | {0, 128, 132}
    for cut in sorted(cuts):
        found = unread(data[:cut])
        assert found.fault is (Fault.NOT_DICOM if cut < 132 else Fault.DAMAGED), cut


@pytest.mark.parametrize("data", [b"", b"<!DOCTYPE html><html>Not found</html>" * 9, bytes(200), b"PK\3\4" * 60])
def test_what_is_no_dicom(data: bytes) -> None:
    assert unread(data).fault is Fault.NOT_DICOM


def test_only_a_preamble() -> None:
    assert unread(SLICE[:132]).fault is Fault.DAMAGED


def test_a_program_in_the_preamble_is_ignored() -> None:
    for program in (b"MZ\x90\0" * 32, b"\x7fELF" * 32):
        assert header_of(program + SLICE[128:]).pixel_spacing == header_of(SLICE).pixel_spacing


def test_deflated_is_refused_before_it_is_inflated() -> None:
    assert unread(deflated(SLICE)).reason.startswith("is deflated")
    bomb = deflated(SLICE, surplus=200_000_000)
    assert len(bomb) < 1_000_000
    header_of(SLICE)  # pydicom is loaded
    tracemalloc.start()
    found = unread(bomb)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found.fault is Fault.COMPRESSION
    assert peak < 5_000_000


@pytest.mark.parametrize("syntax", ["1.2.840.10008.1.2.4.50", "1.2.840.10008.1.2.4.201", "1.2.840.113619.5.2", "1.2.3"])
def test_other_compressions_are_named(syntax: str) -> None:
    meta = SLICE.replace(b"1.2.840.10008.1.2.1\0", (syntax.encode() + b"\0\0")[:20].ljust(20, b"\0"), 1)
    known = syntax if len(syntax) <= 20 else syntax[:20]
    found = unread(meta)
    assert found.fault is Fault.COMPRESSION
    assert known in found.reason


def test_a_syntax_named_twice_cannot_reach_the_library() -> None:
    element = b"\x02\x00\x10\x00UI\x16\x00" + DEFLATED.encode().ljust(22, b"\0")
    begin = SLICE.index(b"\x02\x00\x12\x00UI")
    assert unread(SLICE[:begin] + element + SLICE[begin:]).fault is Fault.DAMAGED


def test_a_report_is_another_object() -> None:
    report = other_object(series(), "SR", STRUCTURED_REPORT)
    assert header_of(report).modality == "SR"
    assert unread(deflated(report)).fault is Fault.OTHER_OBJECT


def test_too_large_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dicom_headers, "MAX_FILE_BYTES", 1000)
    assert unread(SLICE).fault is Fault.TOO_LARGE


def test_flipped_bits_of_the_header_never_raise() -> None:
    """Every byte before the pixels, one bit each: a header or a reason, and no warning."""
    begin = header_of(SLICE).pixels[0]
    bits = np.random.default_rng(1).integers(0, 8, begin)
    kinds = set()
    for position in range(128, begin):
        data = bytearray(SLICE)
        data[position] ^= 1 << int(bits[position])
        kinds.add(type(read_header(bytes(data), "x")))
    assert kinds == {DicomHeader, Unread}
