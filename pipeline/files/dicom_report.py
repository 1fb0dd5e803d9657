"""A report for the archive (PACS): its PDF as an Encapsulated PDF, its pictures as Secondary Captures, in the study of
the CT.

Format: DICOM PS3.3 A.45.1 (Encapsulated PDF), A.8.1 (Secondary Capture). Nothing is dated: an export is no examination,
and the same result exported twice is the same objects, to the byte; their UIDs are made from what is in them.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline import __version__
from pipeline.files.dicom_headers import CT_SLICE, silent_pydicom
from pipeline.files.dicom_study import SourceStudy

if TYPE_CHECKING:
    from pydicom import Dataset

NOTICE = "Research use - not for diagnosis"

_EXPLICIT_LITTLE = "1.2.840.10008.1.2.1"
_ENCAPSULATED_PDF = "1.2.840.10008.5.1.4.1.1.104.1"
#: Beyond the numbers that scanners give.
_SERIES_NUMBERS = {"report": 9401, "pictures": 9402}
#: What highdicom adds that is of this moment or this machine.
_OF_NOW = (
    "ContributingEquipmentSequence",
    "InstanceCreationDate",
    "InstanceCreationTime",
    "ContentDate",
    "ContentTime",
    "DateOfSecondaryCapture",
    "TimeOfSecondaryCapture",
)


@dataclass(frozen=True)
class ArchivedResult:
    """What the objects say of the result.

    Attributes
    ----------
    case_id, joint, side, verdict : str
        ``side`` is ``right`` or ``left``; ``verdict`` the word of the report.
    """

    case_id: str
    joint: str
    side: str
    verdict: str

    def title(self, what: str) -> str:
        """One line on an object, in plain letters: they are the same in every character set."""
        return f"ct2lut {what} of case {self.case_id}, {self.side} {self.joint}: {self.verdict}. {NOTICE}"


def encode_report(study: SourceStudy, result: ArchivedResult, pdf: bytes) -> bytes:
    """An Encapsulated PDF.

    Parameters
    ----------
    study : SourceStudy
        That of the CT.
    result : ArchivedResult
    pdf : bytes
        Kept to the byte; EncapsulatedDocumentLength says how many there are, without padding.

    Raises
    ------
    ValueError
        For bytes that are no PDF.
    """
    from pydicom.dataset import Dataset  # noqa: PLC0415 - a third of a second that only a writer of DICOM pays
    from pydicom.uid import UID  # noqa: PLC0415 - as above

    if not pdf.startswith(b"%PDF-"):
        raise ValueError("report.pdf is no PDF")
    out = Dataset()
    out.SOPClassUID, out.Modality, out.ConversionType = UID(_ENCAPSULATED_PDF), "DOC", "WSD"
    # empty: required to be there, and not known
    out.ContentDate = out.ContentTime = out.AcquisitionDateTime = ""
    out.DocumentTitle, out.VerificationFlag = result.title("report"), "UNVERIFIED"
    out.ConceptNameCodeSequence = [_code("126000", "DCM", "Imaging Measurement Report")]
    out.SourceInstanceSequence = [_reference(uid) for uid in study.slices]
    out.MIMETypeOfEncapsulatedDocument = "application/pdf"
    out.EncapsulatedDocument, out.EncapsulatedDocumentLength = pdf + b"\0" * (len(pdf) % 2), len(pdf)
    return _Series(study, result, "report", _hash(pdf)).encode(out, 1)


def encode_pictures(study: SourceStudy, result: ArchivedResult, pictures: Mapping[str, bytes]) -> dict[str, bytes]:
    """A Secondary Capture in colour for each picture, one series together.

    Parameters
    ----------
    study : SourceStudy
        That of the CT.
    result : ArchivedResult
    pictures : mapping of str to bytes
        Name -> PNG; transparency is ignored.

    Returns
    -------
    dict of str to bytes
        Name -> DICOM file, the names in order.

    Raises
    ------
    ValueError
        For bytes that are no PNG.
    """
    hashes = [(name, _hash(pictures[name])) for name in sorted(pictures)]
    series = _Series(study, result, "pictures", repr(hashes))
    return {
        name: series.encode(_capture(series, name, _pixels(pictures[name], name)), number)
        for number, name in enumerate(sorted(pictures), 1)
    }


@dataclass(frozen=True)
class _Series:
    """A new series in the study of the CT.

    Attributes
    ----------
    study, result
    name : str
        Of _SERIES_NUMBERS.
    content : str
        Stands for all that is in it.
    """

    study: SourceStudy
    result: ArchivedResult
    name: str
    content: str

    def uid(self, *what: str) -> str:
        """A UID of an object in the series; without arguments that of the series itself."""
        from pydicom.uid import generate_uid  # noqa: PLC0415 - as in encode_report

        about = [self.study.digest, repr(self.result), __version__, self.name, self.content, *what]
        return str(generate_uid(entropy_srcs=about))

    def encode(self, out: Dataset, number: int) -> bytes:
        """The file of an object that holds its content, with what every object says."""
        from pydicom import dcmwrite  # noqa: PLC0415 - as in encode_report

        self._describe(out, number)
        _add_file_meta(out)
        buffer = io.BytesIO()
        with silent_pydicom():  # it complains of values that are as the archive has them
            _identify(out, self.study)
            dcmwrite(buffer, out, enforce_file_format=True)
        return buffer.getvalue()

    def _describe(self, out: Dataset, number: int) -> None:
        out.SeriesInstanceUID, out.SOPInstanceUID = self.uid(), self.uid(str(number))
        out.SeriesNumber, out.InstanceNumber = _SERIES_NUMBERS[self.name], number
        out.SeriesDescription = f"ct2lut {self.name}, {self.result.side} {self.result.joint}. {NOTICE}"
        out.Manufacturer = out.ManufacturerModelName = "ct2lut"
        out.SoftwareVersions = __version__
        out.BurnedInAnnotation = "YES"


def _identify(out: Dataset, study: SourceStudy) -> None:
    """The patient and the study, in the bytes of the CT."""
    from pydicom.charset import convert_encodings  # noqa: PLC0415 - as in encode_report
    from pydicom.datadict import dictionary_VR, tag_for_keyword  # noqa: PLC0415 - as in encode_report
    from pydicom.dataelem import RawDataElement  # noqa: PLC0415 - as in encode_report
    from pydicom.tag import Tag  # noqa: PLC0415 - as in encode_report

    for keyword, value in study.values.items():
        tag = Tag(tag_for_keyword(keyword) or 0)
        vr = dictionary_VR(tag)
        padded = value + (b"\0" if vr == "UI" else b" ") * (len(value) % 2)
        out[tag] = RawDataElement(tag, vr, len(padded), padded, 0, is_implicit_VR=False, is_little_endian=True)
    # as if it had been read so, else pydicom decodes the bytes and encodes them again
    charset = convert_encodings(out.SpecificCharacterSet) if "SpecificCharacterSet" in out else None
    out.set_original_encoding(is_implicit_vr=False, is_little_endian=True, character_encoding=charset)


def _add_file_meta(out: Dataset) -> None:
    from pydicom.dataset import FileMetaDataset  # noqa: PLC0415 - as in encode_report
    from pydicom.uid import UID  # noqa: PLC0415 - as in encode_report

    out.file_meta = FileMetaDataset()
    out.file_meta.MediaStorageSOPClassUID = out.SOPClassUID
    out.file_meta.MediaStorageSOPInstanceUID = out.SOPInstanceUID
    out.file_meta.TransferSyntaxUID = UID(_EXPLICIT_LITTLE)


def _capture(series: _Series, name: str, pixels: NDArray[np.uint8]) -> Dataset:
    """The picture (rows, columns, 3); whose it is and which number it has is filled in later."""
    from highdicom.sc import SCImage  # noqa: PLC0415 - more than a second that only a writer of DICOM pays

    out = SCImage(
        pixels,
        photometric_interpretation="RGB",
        bits_allocated=8,
        coordinate_system="PATIENT",
        study_instance_uid=series.study.study_uid,
        series_instance_uid=series.uid(),
        series_number=1,
        sop_instance_uid=series.uid(),
        instance_number=1,
        manufacturer="ct2lut",
        patient_orientation=("L", "P"),
        laterality=series.result.side[0].upper(),
    )
    for keyword in _OF_NOW:
        if keyword in out:
            delattr(out, keyword)
    out["PixelData"].VR = "OB"
    # several views in one picture look from several sides
    out.PatientOrientation = []
    out.ConversionType, out.ImageComments = "WSD", series.result.title(f"picture {name}")
    return out


def _pixels(data: bytes, name: str) -> NDArray[np.uint8]:
    import cv2  # noqa: PLC0415 - slow to import

    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if picture is None:
        raise ValueError(f"the picture {name} is no PNG")
    return np.ascontiguousarray(picture[..., ::-1], dtype=np.uint8)


def _code(value: str, scheme: str, meaning: str) -> Dataset:
    from pydicom.dataset import Dataset  # noqa: PLC0415 - as in encode_report

    out = Dataset()
    out.CodeValue, out.CodingSchemeDesignator, out.CodeMeaning = value, scheme, meaning
    return out


def _reference(sop_uid: str) -> Dataset:
    from pydicom.dataset import Dataset  # noqa: PLC0415 - as in encode_report
    from pydicom.uid import UID  # noqa: PLC0415 - as in encode_report

    out = Dataset()
    out.ReferencedSOPClassUID, out.ReferencedSOPInstanceUID = UID(CT_SLICE), sop_uid
    return out


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
