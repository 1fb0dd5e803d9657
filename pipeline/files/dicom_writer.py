"""A CT of ours as a DICOM series: one file a slice, in any transfer syntax that is read; synthetic, and says so.

Format: DICOM PS3.3 C.8.2 (CT image), PS3.5 A.4 (encapsulated pixels). Equal volumes give equal bytes: no dates, and
UIDs made from the content.
"""

from __future__ import annotations

import hashlib
import importlib
import io
import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.files.dicom_headers import CT_SLICE, SYNTAXES
from pipeline.geometry.volume import CtVolume

if TYPE_CHECKING:
    from pydicom import Dataset

#: Name of a way of writing -> its UID.
TRANSFER_SYNTAXES = {
    "implicit little endian": "1.2.840.10008.1.2",
    "explicit little endian": "1.2.840.10008.1.2.1",
    "explicit big endian": "1.2.840.10008.1.2.2",
    "RLE": "1.2.840.10008.1.2.5",
    "JPEG lossless": "1.2.840.10008.1.2.4.70",
    "JPEG-LS lossless": "1.2.840.10008.1.2.4.80",
    "JPEG 2000 lossless": "1.2.840.10008.1.2.4.90",
}
#: Stands for patient and series alike.
SYNTHETIC = "SYNTHETIC"

_RADIOGRAPHIC_AIR = -1024
#: Who wrote it; without a version, so that an upgrade leaves the bytes alone.
_PROGRAM_UID = "2.25.318160310733364150164216174061213640211"


@dataclass(frozen=True)
class SeriesSpec:
    """How a series is written.

    Attributes
    ----------
    syntax : str
        A key of TRANSFER_SYNTAXES.
    seed : str
        Goes into the UIDs: the same volume with another seed is another series.
    intercept : int
        HU = stored value + intercept; the slope is 1.
    signed : bool
        Whether stored values are int16, else uint16.
    laterality : str
        ``R``, ``L`` or empty.
    """

    syntax: str = "explicit little endian"
    seed: str = ""
    intercept: int = _RADIOGRAPHIC_AIR
    signed: bool = True
    laterality: str = ""


def encode_series(ct: CtVolume, spec: SeriesSpec | None = None) -> dict[str, bytes]:
    """File name -> bytes of a CT series.

    Parameters
    ----------
    ct : CtVolume
        The third index axis counts the slices, the first the columns, the second the rows, in whatever direction of
        the patient they run. Columns of the matrix orthogonal.
    spec : SeriesSpec, optional
        By default explicit VR little endian.

    Raises
    ------
    ValueError
        For values that cannot be stored with this intercept and sign.
    """
    spec = spec or SeriesSpec()
    stored = ct.values.astype(np.int32) - spec.intercept
    limits = np.iinfo(np.int16 if spec.signed else np.uint16)
    if stored.min() < limits.min or stored.max() > limits.max:
        raise ValueError(f"values from {stored.min()} to {stored.max()} do not fit into {limits.dtype}")
    typed = stored.astype(limits.dtype)
    writer = _Writer(ct.lps_from_index, spec, _content_hash(ct, spec))
    # the columns of a slice are the first index of the array, the rows the second
    return {f"IM{k + 1:04d}.dcm": writer.slice_bytes(typed[:, :, k].T, k) for k in range(typed.shape[2])}


def _content_hash(ct: CtVolume, spec: SeriesSpec) -> str:
    digest = hashlib.sha256(repr((ct.values.shape, replace(spec, syntax=""))).encode())
    digest.update(np.ascontiguousarray(ct.values).tobytes())
    digest.update(np.ascontiguousarray(ct.lps_from_index).tobytes())
    return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class _Writer:
    """What all slices of a series share."""

    lps_from_index: NDArray[np.float64]
    spec: SeriesSpec
    content: str

    def slice_bytes(self, pixels: NDArray[Any], k: int) -> bytes:
        """The file of one (rows, columns) slice."""
        from pydicom import dcmwrite  # noqa: PLC0415 - a third of a second that only a writer of DICOM pays

        dataset = self._identified(k)
        self._place(dataset, k)
        self._describe(dataset, pixels.shape)
        buffer = io.BytesIO()
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*(big endian|implicit VR).*")  # asked for
            self._add_pixels(dataset, pixels)
            dcmwrite(buffer, dataset, enforce_file_format=True)
        return buffer.getvalue()

    def _uid(self, *what: str) -> str:
        from pydicom.uid import generate_uid  # noqa: PLC0415 - as in slice_bytes

        return str(generate_uid(entropy_srcs=[self.content, *what]))

    def _identified(self, k: int) -> Dataset:
        """A data set that says whose it is and which slice."""
        from pydicom.dataset import Dataset, FileMetaDataset  # noqa: PLC0415 - as in slice_bytes
        from pydicom.uid import UID  # noqa: PLC0415 - as in slice_bytes

        out = Dataset()
        out.SOPClassUID, out.SOPInstanceUID = UID(CT_SLICE), self._uid("slice", str(k))
        out.StudyInstanceUID, out.SeriesInstanceUID = self._uid("study"), self._uid("series")
        out.FrameOfReferenceUID = self._uid("frame of reference")
        out.PatientName = out.PatientID = SYNTHETIC
        out.Modality, out.SeriesDescription = "CT", SYNTHETIC.lower()
        out.SeriesNumber, out.InstanceNumber = 1, k + 1
        if self.spec.laterality:
            out.Laterality = self.spec.laterality
        out.file_meta = FileMetaDataset()
        out.file_meta.MediaStorageSOPClassUID = out.SOPClassUID
        out.file_meta.MediaStorageSOPInstanceUID = out.SOPInstanceUID
        out.file_meta.ImplementationClassUID = UID(_PROGRAM_UID)
        out.file_meta.ImplementationVersionName = "CT2LUT"
        out.file_meta.TransferSyntaxUID = UID(TRANSFER_SYNTAXES[self.spec.syntax])
        return out

    def _place(self, dataset: Dataset, k: int) -> None:
        """Where the slice lies in the patient."""
        axes, origin = self.lps_from_index[:3, :3], self.lps_from_index[:3, 3]
        spacing = np.linalg.norm(axes, axis=0)
        dataset.ImageOrientationPatient = _decimals((axes[:, :2] / spacing[:2]).T.ravel())
        dataset.ImagePositionPatient = _decimals(origin + k * axes[:, 2])
        dataset.PixelSpacing = _decimals(spacing[1::-1])
        dataset.SliceThickness = _decimals(spacing[2:])[0]

    def _describe(self, dataset: Dataset, shape: tuple[int, ...]) -> None:
        """How the pixels are to be read."""
        dataset.ImageType = ["ORIGINAL", "PRIMARY", "AXIAL"]
        dataset.Rows, dataset.Columns = shape
        dataset.SamplesPerPixel, dataset.PhotometricInterpretation = 1, "MONOCHROME2"
        dataset.BitsAllocated, dataset.BitsStored, dataset.HighBit = 16, 16, 15
        dataset.PixelRepresentation = int(self.spec.signed)
        dataset.RescaleIntercept, dataset.RescaleSlope, dataset.RescaleType = str(self.spec.intercept), "1", "HU"

    def _add_pixels(self, dataset: Dataset, pixels: NDArray[Any]) -> None:
        from pydicom.encaps import encapsulate  # noqa: PLC0415 - as in slice_bytes

        syntax = TRANSFER_SYNTAXES[self.spec.syntax]
        _, little, encapsulated = SYNTAXES[syntax]
        raw = pixels.astype(pixels.dtype.newbyteorder("<" if little else ">")).tobytes()
        if encapsulated:
            raw = encapsulate([_compressed(raw, pixels.shape, syntax, signed=self.spec.signed)])
        dataset.PixelData = raw
        dataset["PixelData"].VR = "OB" if encapsulated else "OW"
        dataset["PixelData"].is_undefined_length = encapsulated


def _decimals(numbers: NDArray[np.float64]) -> list[str]:
    """Decimal strings: the 16 characters of DICOM hold a millimetre to better than a nanometre."""
    from pydicom.valuerep import format_number_as_ds  # noqa: PLC0415 - as in slice_bytes

    return [format_number_as_ds(float(number) + 0.0) for number in numbers]


def _compressed(raw: bytes, shape: tuple[int, ...], syntax: str, *, signed: bool) -> bytes:
    """One frame of 16-bit little-endian pixels, compressed without loss by GDCM."""
    gdcm: Any = importlib.import_module("gdcm")
    writer = gdcm.ImageWriter()  # GDCM makes an image only as part of a writer, which must outlive it
    image = writer.GetImage()
    image.SetNumberOfDimensions(2)
    image.SetDimensions((shape[1], shape[0], 1))
    kind = gdcm.PhotometricInterpretation.GetPIType("MONOCHROME2")
    image.SetPhotometricInterpretation(gdcm.PhotometricInterpretation(kind))
    image.SetTransferSyntax(gdcm.TransferSyntax(gdcm.TransferSyntax.ImplicitVRLittleEndian))
    image.SetPixelFormat(gdcm.PixelFormat(1, 16, 16, 15, int(signed)))
    element = gdcm.DataElement(gdcm.Tag(0x7FE0, 0x0010))
    element.SetByteStringValue(raw)
    image.SetDataElement(element)
    change = gdcm.ImageChangeTransferSyntax()
    change.SetTransferSyntax(gdcm.TransferSyntax(gdcm.TransferSyntax.GetTSType(syntax)))
    change.SetInput(image)
    if not change.Change():
        raise ValueError(f"GDCM cannot write transfer syntax {syntax}")
    fragments = change.GetOutput().GetDataElement().GetSequenceOfFragments()
    if fragments.GetNumberOfFragments() != 1:
        raise ValueError(f"GDCM wrote {fragments.GetNumberOfFragments()} fragments, expected one")
    # GDCM hands bytes over as text
    frame: str = fragments.GetFragment(0).GetByteValue().GetBuffer()
    return frame.encode("utf-8", "surrogateescape")
