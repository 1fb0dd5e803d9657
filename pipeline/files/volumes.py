"""A label map in any accepted format to one canonical volume: LPS order, right-handed, millimetres, whole numbers.

The value gate stands here once for every format; that of the geometry is :mod:`pipeline.files.geometry_gate`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.stage import Finding, Severity
from pipeline.errors import CaseRejected
from pipeline.files.foreign_image import ForeignImage, not_labels, unsupported
from pipeline.files.geometry_gate import check_geometry, handedness
from pipeline.files.metaimage_format import read_metaimage
from pipeline.files.nrrd_format import read_nrrd
from pipeline.geometry.volume import LabelVolume, in_lps_order, label_counts

#: What reads the bytes of a file of some name.
Reader = TypeVar("Reader", bound=Callable[[bytes, str], Any])

#: More different values than any label scheme has: it is an image.
MAX_LABELS = 256
#: Largest label value.
MAX_VALUE = 65_535


def _read_nifti(data: bytes, file: str) -> ForeignImage:
    from pipeline.files.nifti_format import read_nifti  # noqa: PLC0415 - nibabel, which a cached run must not pay for

    return read_nifti(data, file)


def _read_dicom_seg(data: bytes, file: str) -> ForeignImage:
    from pipeline.files.dicom_seg import read_dicom_seg  # noqa: PLC0415 - as above, for a file that is seldom given

    return read_dicom_seg(data, file)


_READERS: dict[str, Callable[[bytes, str], ForeignImage]] = {
    ".nii": _read_nifti,
    ".nii.gz": _read_nifti,
    ".nrrd": read_nrrd,
    ".mha": read_metaimage,
    ".dcm": _read_dicom_seg,
}
#: File name endings of label maps that are read (``.seg.nrrd`` is a ``.nrrd``).
LABEL_MAP_ENDINGS = tuple(_READERS)
#: Headers whose voxels lie in another file: refused, since such a header can name any file of the machine.
DETACHED_ENDINGS = (".mhd", ".nhdr", ".hdr", ".img")


@dataclass(frozen=True, eq=False)
class LabelMap:
    """A label map that passed every gate.

    Attributes
    ----------
    volume : LabelVolume
        uint16, axes in the order and direction nearest to +L, +P, +S; right-handed.
    segments : mapping of str to int
        Segment name -> label value where the file names them, else empty.
    counts : (65536,) int64
        Voxels of each label value.
    findings : tuple of Finding
        What was assumed or changed.
    side, frame_of_reference : str
        As in :class:`ForeignImage`; empty where the file does not say.
    """

    volume: LabelVolume
    segments: Mapping[str, int]
    counts: NDArray[np.int64]
    findings: tuple[Finding, ...]
    side: str = ""
    frame_of_reference: str = ""


def read_label_map(data: bytes, file: str) -> LabelMap:
    """Read a label map and refuse what cannot be trusted.

    Parameters
    ----------
    data : bytes
        The whole file.
    file : str
        Its name relative to the case folder; the ending chooses the format.

    Raises
    ------
    CaseRejected
        E-IO-*, E-GEO-*, E-LBL-02, E-LBL-04, E-LBL-05; see ``docs/messages.md``.
    """
    image = reader_of(file, _READERS)(data, file)
    check_geometry(image.lps_from_index, image.values.shape, file)
    values, notes = label_values(image.values, file)
    if (found := int(np.count_nonzero(counts := label_counts(values)))) > MAX_LABELS:
        raise not_labels(file, f"it has {found} different values, expected at most {MAX_LABELS}")
    volume = in_lps_order(LabelVolume(values, image.lps_from_index))
    findings = (*image.findings, *handedness(image, file), *notes)
    return LabelMap(volume, image.segments, counts, findings, image.side, image.frame_of_reference)


def check_belongs(label_map: LabelMap, file: str, side: str, frame_of_reference: str) -> None:
    """Refuse a label map that says it is of the other leg, or of another scan than the CT beside it.

    Parameters
    ----------
    label_map : LabelMap
    file : str
        For messages.
    side : str
        As the case declares it.
    frame_of_reference : str
        Of the CT, as :func:`pipeline.files.dicom_headers.frame_hash` has it; empty where there is none.

    Raises
    ------
    CaseRejected
        E-SIDE-04, E-GEO-08.
    """
    if label_map.side not in ("", side):
        raise CaseRejected(
            "E-SIDE-04",
            f"The case is declared {side}, and the segments of {file} are coded as {label_map.side}.",
            "Correct 'side:' in case.yaml, or give the segmentation of the other leg.",
        )
    frames = {label_map.frame_of_reference, frame_of_reference} - {""}
    if len(frames) > 1:
        raise CaseRejected(
            "E-GEO-08",
            f"{file} does not belong to the CT of the case: it names another frame of reference.",
            "Give the segmentation that was drawn on this CT series, or the series that it was drawn on.",
        )


def label_values(values: NDArray[Any], file: str) -> tuple[NDArray[np.uint16], tuple[Finding, ...]]:
    """The voxels as uint16 labels, and a note where they came as fractions that happen to be whole.

    Raises
    ------
    CaseRejected
        E-LBL-02 for NaN, fractions, negative or large values.
    """
    low, high = values.min(), values.max()
    if not (low >= 0 and high <= MAX_VALUE):  # also false for NaN
        raise not_labels(file, f"it has values from {low:g} to {high:g}, expected 0 to {MAX_VALUE}")
    labels = values.astype(np.uint16)
    if values.dtype.kind == "f" and not np.array_equal(labels, values):
        raise not_labels(file, "it has fractions, expected whole numbers")
    if values.dtype.kind == "f":
        text = f"{file} stores its labels as {values.dtype.name}; all are whole numbers and were taken as such."
        return labels, (Finding("N-LBL-02", Severity.NOTE, text),)
    return labels, ()


def reader_of(file: str, readers: Mapping[str, Reader]) -> Reader:
    """The reader of a file by its ending.

    Raises
    ------
    CaseRejected
        E-IO-12 for an ending that none reads, and for a header whose voxels lie in another file.
    """
    name = file.lower()
    if name.endswith(DETACHED_ENDINGS):
        raise unsupported(file, "its voxels are in another file")
    for ending, reader in readers.items():
        if name.endswith(ending):
            return reader
    raise unsupported(file, f"expected a file that ends in {', '.join(readers)}")
