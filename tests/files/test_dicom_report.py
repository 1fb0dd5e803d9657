"""Objects for the archive: whose they are, to the byte of the CT; what is in them; the same ones each time."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pydicom import Dataset, dcmread

from pipeline import __version__
from pipeline.adapters.pictures import png
from pipeline.files.dicom_report import ArchivedResult, encode_pictures, encode_report
from pipeline.files.dicom_study import SourceStudy, read_study
from tests.files.dicom_samples import Files, other_object, refused, scout, series, with_edited, written

RESULT = ArchivedResult("P001", "knee", "right", "REVIEW")
#: Its length is odd: DICOM pads it.
PDF = b"%PDF-1.4\n%%EOF"[:13]
IDENTITY: dict[str, bytes] = {
    "PatientName": b"Doe^Jane",
    "PatientID": b"MRN-4711",
    "IssuerOfPatientID": b"Hospital A",
    "PatientBirthDate": b"19700131",
    "PatientSex": b"F",
    "StudyDate": b"20260131",
    "StudyTime": b"101559.250",
    "AccessionNumber": b"A1",
    "StudyID": b"7",
    "StudyDescription": b"CT knee",
    "ReferringPhysicianName": b"Roe^Richard",
}
TYPE_2 = (
    "PatientName",
    "PatientID",
    "PatientBirthDate",
    "PatientSex",
    "StudyDate",
    "StudyTime",
    "AccessionNumber",
    "StudyID",
    "ReferringPhysicianName",
)
#: What scripts of the world look like in DICOM: character set, name.
NAMES = (
    (None, "Doe^Jane"),
    ("ISO_IR 100", "Müller^Jörg"),
    ("ISO_IR 144", "Иванов^Иван"),
    ("ISO_IR 192", "Ünal^Işıl"),
    ("GB18030", "Wang^XiaoDong=王^小东"),
    (["", "ISO 2022 IR 87"], "Yamada^Tarou=山田^太郎=やまだ^たろう"),
)


def study_of(files: Files) -> SourceStudy:
    return read_study(list(files), files.__getitem__)


def with_identity(tags: Mapping[str, bytes | None] | None = None) -> Files:
    """The series of a patient of flesh and blood."""
    return with_edited(series(), {**IDENTITY, **(tags or {})})


def named(charset: str | list[str] | None, name: str) -> Files:
    """The series with a name, encoded by pydicom."""
    out = {}
    for file, data in series().items():
        dataset = dcmread(io.BytesIO(data))
        if charset is not None:
            dataset.SpecificCharacterSet = charset
        dataset.PatientName = name
        out[file] = written(dataset)
    return out


def pictures() -> dict[str, NDArray[np.uint8]]:
    """Two of different odd sizes; no two pixels and no two channels of them alike by rule."""
    draw = np.random.default_rng(11)
    shapes = {"slices": (7, 5, 3), "bones": (4, 9, 3)}
    return {name: draw.integers(0, 256, shape, dtype=np.uint8) for name, shape in shapes.items()}


def captures(study: SourceStudy, result: ArchivedResult = RESULT) -> dict[str, Dataset]:
    encoded = encode_pictures(study, result, {name: png(picture) for name, picture in pictures().items()})
    return {name: dcmread(io.BytesIO(data)) for name, data in encoded.items()}


def report(study: SourceStudy, result: ArchivedResult = RESULT, pdf: bytes = PDF) -> Dataset:
    return dcmread(io.BytesIO(encode_report(study, result, pdf)))


def objects(study: SourceStudy) -> list[Dataset]:
    return [report(study), *captures(study).values()]


def test_they_are_of_the_patient_and_the_study_of_the_ct() -> None:
    files = with_identity()
    source = dcmread(io.BytesIO(files["IM0001.dcm"]))
    for dataset in objects(study_of(files)):
        for keyword in (*IDENTITY, "StudyInstanceUID"):
            assert dataset[keyword].value == source[keyword].value, keyword
        assert "SpecificCharacterSet" not in dataset


@pytest.mark.parametrize(("charset", "name"), NAMES)
def test_a_name_in_any_script_keeps_its_bytes(charset: str | list[str] | None, name: str) -> None:
    files = named(charset, name)
    expected = dcmread(io.BytesIO(files["IM0001.dcm"])).get_item("PatientName").value
    for dataset in objects(study_of(files)):
        assert dataset.get_item("PatientName").value == expected
        assert str(dataset.PatientName) == name
        assert dataset.get("SpecificCharacterSet") == charset
        assert dataset.SeriesDescription.endswith(", right knee. Research use - not for diagnosis")


def test_what_the_ct_does_not_say_is_empty_or_left_out() -> None:
    files = with_edited(series(), {"PatientName": None, "PatientID": None})
    for dataset in objects(study_of(files)):
        assert all(dataset[keyword].is_empty for keyword in TYPE_2)
        assert "StudyDescription" not in dataset
        assert "IssuerOfPatientID" not in dataset


def test_pixels_are_those_of_the_picture() -> None:
    found = captures(study_of(series()))
    assert list(found) == ["bones", "slices"]
    for name, picture in pictures().items():
        np.testing.assert_array_equal(found[name].pixel_array, picture)
        assert found[name].PhotometricInterpretation == "RGB"


def test_transparency_is_ignored() -> None:
    picture = pictures()["bones"]
    see_through = np.dstack([picture[..., ::-1], np.full(picture.shape[:2], 255, np.uint8)])
    done, data = cv2.imencode(".png", see_through)
    assert done
    encoded = encode_pictures(study_of(series()), RESULT, {"bones": data.tobytes()})
    np.testing.assert_array_equal(dcmread(io.BytesIO(encoded["bones"])).pixel_array, picture)


@pytest.mark.parametrize("pdf", [PDF, PDF + b"\n"])
def test_the_pdf_comes_out_to_the_byte(pdf: bytes) -> None:
    dataset = report(study_of(series()), pdf=pdf)
    assert dataset.EncapsulatedDocument[: dataset.EncapsulatedDocumentLength] == pdf
    assert len(dataset.EncapsulatedDocument) == 14
    assert dataset.MIMETypeOfEncapsulatedDocument == "application/pdf"


def test_the_report_refers_to_every_slice_that_was_used() -> None:
    files = series()
    names = {dcmread(io.BytesIO(data)).SOPInstanceUID for data in files.values()}
    files["scout.dcm"], files["readme.txt"] = scout(files, localizer=True), b"no image"
    files["capture.dcm"] = other_object(files, "OT", "1.2.840.10008.5.1.4.1.1.7")
    found = report(study_of(files)).SourceInstanceSequence
    assert {one.ReferencedSOPInstanceUID for one in found} == names
    assert len(found) == 12


@pytest.mark.parametrize("side", ["right", "left"])
def test_they_say_what_they_are(side: str) -> None:
    result = replace(RESULT, side=side)
    study = study_of(series())
    for dataset in (report(study, result), *captures(study, result).values()):
        assert (dataset.Manufacturer, dataset.SoftwareVersions) == ("ct2lut", __version__)
        assert dataset.BurnedInAnnotation == "YES"
        assert f"{side} knee. Research use - not for diagnosis" in dataset.SeriesDescription
    title = f"of case P001, {side} knee: REVIEW. Research use - not for diagnosis"
    assert report(study, result).DocumentTitle == f"ct2lut report {title}"
    for name, dataset in captures(study, result).items():
        assert dataset.ImageComments == f"ct2lut picture {name} {title}"
        assert dataset.Laterality == side[0].upper()


def test_two_new_series_and_every_object_once() -> None:
    files = series()
    source = dcmread(io.BytesIO(files["IM0001.dcm"]))
    document, *images = objects(study_of(files))
    assert len({source.SeriesInstanceUID, document.SeriesInstanceUID, images[0].SeriesInstanceUID}) == 3
    assert {one.SeriesInstanceUID for one in images} == {images[0].SeriesInstanceUID}
    assert [one.InstanceNumber for one in images] == [1, 2]
    assert document.SeriesNumber != images[0].SeriesNumber
    assert len({one.SOPInstanceUID for one in (document, *images)}) == 3
    assert all(one.file_meta.MediaStorageSOPInstanceUID == one.SOPInstanceUID for one in (document, *images))


def test_the_same_result_is_the_same_objects_and_another_one_others() -> None:
    study, given = study_of(with_identity()), {name: png(picture) for name, picture in pictures().items()}
    assert encode_pictures(study, RESULT, given) == encode_pictures(study, RESULT, given)
    assert encode_report(study, RESULT, PDF) == encode_report(study, RESULT, PDF)
    first = {one.SOPInstanceUID for one in objects(study)}
    others = [
        report(study, pdf=PDF + b"\n"),
        *captures(study, replace(RESULT, verdict="PASS")).values(),
        *objects(study_of(with_identity({"PatientID": b"MRN-4712"}))),
        *objects(replace(study, slices=study.slices[1:])),
    ]
    assert not first & {one.SOPInstanceUID for one in others}


def test_nothing_is_dated_but_by_the_ct() -> None:
    for dataset in objects(study_of(with_identity())):
        dates = {one.keyword: str(one.value) for one in dataset.iterall() if one.VR in ("DA", "TM", "DT") and one.value}
        assert dates == {"PatientBirthDate": "19700131", "StudyDate": "20260131", "StudyTime": "101559.250"}


@pytest.mark.parametrize(
    ("keyword", "value"),
    [
        ("PatientID", b"4711\n4712"),
        ("PatientName", b"Doe\x07^Jane"),
        ("PatientName", b"\x00\x01\x02Doe"),
        ("StudyInstanceUID", b"1.2.three"),
        ("StudyInstanceUID", b"1.2." + b"3" * 61),
        ("SpecificCharacterSet", b"<script>"),
    ],
)
def test_an_identity_that_cannot_be_repeated_is_refused_without_telling_it(keyword: str, value: bytes) -> None:
    with refused("E-EXP-05", f"{keyword} of IM0001.dcm cannot be repeated") as caught:
        study_of(with_identity({keyword: value}))
    assert "Doe" not in str(caught.value)
    assert "4711" not in str(caught.value)


@pytest.mark.parametrize(
    ("keyword", "value"),
    [
        ("PatientBirthDate", b"31.01.1970"),
        ("PatientBirthDate", b"19701399"),
        ("PatientSex", b"W"),
        ("StudyDate", b"20260101-20260131"),
        ("StudyTime", b"10:15"),
        ("AccessionNumber", b"A\x1f1"),
    ],
)
def test_of_the_rest_what_is_not_legal_becomes_empty(keyword: str, value: bytes) -> None:
    study = study_of(with_identity({keyword: value}))
    for dataset in objects(study):
        assert dataset[keyword].is_empty
    assert study.values["PatientName"] == b"Doe^Jane"


@pytest.mark.parametrize(
    ("keyword", "value"),
    [("PatientID", b"9" * 200), ("SpecificCharacterSet", b"ISO_IR 999"), ("PatientName", b"\xff\xfeDoe")],
)
def test_what_is_odd_and_legible_is_as_odd_as_in_the_archive(keyword: str, value: bytes) -> None:
    study = study_of(with_identity({keyword: value}))
    encoded = [
        encode_report(study, RESULT, PDF),
        *encode_pictures(study, RESULT, {"a": png(pictures()["bones"])}).values(),
    ]
    assert all(value in data for data in encoded)


def test_a_study_does_not_tell_who_it_is_of_when_it_is_printed() -> None:
    shown = repr(study_of(with_identity()))
    assert shown == "SourceStudy()"


def test_other_bytes_than_pdf_and_png_are_refused() -> None:
    study = study_of(series())
    with pytest.raises(ValueError, match=r"report\.pdf is no PDF"):
        encode_report(study, RESULT, b"<html>")
    for data in (b"", b"GIF89a", png(pictures()["bones"])[:30]):
        with pytest.raises(ValueError, match="the picture bones is no PNG"):
            encode_pictures(study, RESULT, {"bones": data})
