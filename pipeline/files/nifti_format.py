"""NIfTI-1 and NIfTI-2 label maps (``.nii``, ``.nii.gz``): bytes to volume.

Format: https://nifti.nimh.nih.gov/nifti-1. nibabel decodes the header; every judgement of it is made here, because
readers disagree on files that break the rules (they pick sform or qform, guess a missing one, convert units or not).
"""

from __future__ import annotations

from typing import Any

import nibabel
import numpy as np
from nibabel.spatialimages import HeaderDataError
from numpy.typing import NDArray

from pipeline.engine.stage import Finding, Severity
from pipeline.errors import CaseRejected
from pipeline.files.foreign_image import (
    ForeignImage,
    Layout,
    bad_header,
    check_layout,
    damaged,
    gunzip,
    gunzip_head,
    no_orientation,
    not_finite,
    unsupported,
    voxels,
    wrong_unit,
)
from pipeline.geometry.volume import axis_codes, corner_points

#: Largest disagreement of sform, qform and voxel size over the corners of the volume.
AGREEMENT_MM = 0.01

_LPS_FROM_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
_GZIP_MAGIC = b"\x1f\x8b"
_NIFTI1_SIZE = 348
_NIFTI2_SIZE = 540
_UNITS = {0: "unknown", 1: "metres", 2: "mm", 3: "micrometres"}


def read_nifti(data: bytes, file: str) -> ForeignImage:
    """Read one single-file NIfTI volume, compressed or not.

    Parameters
    ----------
    data : bytes
        The whole file.
    file : str
        Its name relative to the case folder, for messages.

    Returns
    -------
    ForeignImage
        A fourth axis of length 1 is dropped.

    Raises
    ------
    CaseRejected
        E-IO-11..14, E-GEO-01, E-GEO-02 (sform and qform disagree), E-GEO-03, E-GEO-05, E-LBL-04, E-LBL-05.
    """
    compressed = data.startswith(_GZIP_MAGIC)
    header = _header(gunzip_head(data, _NIFTI2_SIZE, file) if compressed else data[:_NIFTI2_SIZE], file)
    layout, offset = _layout(header, file), _voxel_offset(header, file)
    check_layout(layout, file)
    _check_scaling(header, file)
    findings = _check_units(header, file)
    lps_from_index = _LPS_FROM_RAS @ _ras_from_index(header, layout.shape[:3], file)
    content = gunzip(data, offset + layout.nbytes, file) if compressed else data
    values = voxels(content[offset:], layout, file)
    return ForeignImage(values.reshape(layout.shape[:3], order="F"), lps_from_index, findings=findings)


def _header(head: bytes, file: str) -> Any:
    """The header, unchecked and without the extensions that may follow it."""
    is_nifti2 = _NIFTI2_SIZE.to_bytes(4, "little") == head[:4] or _NIFTI2_SIZE.to_bytes(4, "big") == head[:4]
    size, kind = (_NIFTI2_SIZE, nibabel.Nifti2Header) if is_nifti2 else (_NIFTI1_SIZE, nibabel.Nifti1Header)
    if len(head) < size:
        raise damaged(file, f"expected a header of {size} bytes, got {len(head)}")
    header = kind(head[:size], check=False)
    if bytes(header["magic"].item())[:3] not in (b"n+1", b"n+2") or int(header["sizeof_hdr"]) != size:
        raise unsupported(file, "it is not a single-file NIfTI image")
    return header


def _layout(header: Any, file: str) -> Layout:
    """Shape and type of the voxels; a shape of more than three axes is refused unless the others have length 1."""
    dim = [int(n) for n in header["dim"]]
    if not 1 <= dim[0] <= 7:
        raise bad_header(file, f"it declares {dim[0]} dimensions")
    shape = tuple(dim[1 : dim[0] + 1])
    if len(shape) < 3 or any(n != 1 for n in shape[3:]):
        raise CaseRejected(
            "E-LBL-04",
            f"{file} has the size {' x '.join(map(str, shape))}, expected one 3-D label map.",
            "Export the segmentation as one 3-D label map.",
        )
    try:
        dtype = header.get_data_dtype()
    except (HeaderDataError, KeyError) as error:
        raise bad_header(file, "its voxel type is unknown") from error
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise unsupported(file, f"its voxels are of type {dtype}")
    return Layout(shape, dtype)


def _voxel_offset(header: Any, file: str) -> int:
    offset, smallest = float(header["vox_offset"]), int(header["sizeof_hdr"]) + 4
    if not (smallest <= offset <= 100_000_000 and offset == int(offset)):
        raise bad_header(file, f"its voxels begin at byte {offset:g}, expected {smallest} or more")
    return int(offset)


def _check_scaling(header: Any, file: str) -> None:
    """A label is a name, not a measurement: scaled label values would be other labels."""
    slope, inter = float(header["scl_slope"]), float(header["scl_inter"])
    unscaled = slope == 0.0 or np.isnan(slope)
    if not unscaled and (slope != 1.0 or inter != 0.0):
        raise CaseRejected(
            "E-LBL-05",
            f"{file} scales its values (slope {slope:g}, intercept {inter:g}), expected plain label numbers.",
            "Export the label map without rescaling.",
        )


def _check_units(header: Any, file: str) -> tuple[Finding, ...]:
    unit = _UNITS.get(int(header["xyzt_units"]) & 0x07, "an undefined unit")
    if unit == "unknown":
        return (Finding("N-GEO-02", Severity.NOTE, f"{file} does not name its unit of length; millimetres assumed."),)
    if unit != "mm":
        raise wrong_unit(file, unit)
    return ()


def _ras_from_index(header: Any, shape: tuple[int, ...], file: str) -> NDArray[np.float64]:
    """The one geometry that sform, qform and voxel size all tell, (4, 4)."""
    forms = [np.asarray(header.get_sform(), dtype=np.float64)] if int(header["sform_code"]) > 0 else []
    if int(header["qform_code"]) > 0:
        forms.append(_qform(header, file))
    if not forms:
        raise no_orientation(file, "it has neither an sform nor a qform")
    if not all(np.isfinite(form).all() for form in forms):
        raise not_finite(file)
    _check_agreement(forms[0], forms[-1], shape, file)
    _check_voxel_size(header, forms[0], shape, file)
    return forms[0]


def _qform(header: Any, file: str) -> NDArray[np.float64]:
    if float(header["pixdim"][0]) not in (-1.0, 0.0, 1.0):
        raise bad_header(file, "pixdim[0] is neither 1 nor -1")
    try:
        with np.errstate(invalid="ignore"):
            return np.asarray(header.get_qform(), dtype=np.float64)
    except (ValueError, HeaderDataError) as error:
        raise bad_header(file, "its quaternion (qform) is not a rotation") from error


def _check_agreement(sform: NDArray[np.float64], qform: NDArray[np.float64], shape: tuple[int, ...], file: str) -> None:
    apart = np.linalg.norm(corner_points(sform, shape) - corner_points(qform, shape), axis=1).max()
    if not apart <= AGREEMENT_MM:
        raise CaseRejected(
            "E-GEO-02",
            f"{file} gives two positions in the patient that differ by {apart:.3g} mm "
            f"(sform {axis_codes(_LPS_FROM_RAS @ sform)}, qform {axis_codes(_LPS_FROM_RAS @ qform)}), "
            f"expected at most {AGREEMENT_MM} mm.",
            "Export the label map again with the CT's geometry; programs disagree on which of the two to use.",
        )


def _check_voxel_size(header: Any, affine: NDArray[np.float64], shape: tuple[int, ...], file: str) -> None:
    declared = np.abs(np.asarray(header["pixdim"][1:4], dtype=np.float64))
    actual = np.linalg.norm(affine[:3, :3], axis=0)
    if not (np.abs(declared - actual) * np.asarray(shape)).max() <= AGREEMENT_MM:
        raise CaseRejected(
            "E-GEO-02",
            f"{file} gives two voxel sizes, {_sizes(declared)} mm (pixdim) and {_sizes(actual)} mm (its matrix).",
            "Export the label map again with the CT's geometry; programs disagree on which of the two to use.",
        )


def _sizes(spacing: NDArray[np.float64]) -> str:
    return " x ".join(f"{size:.4g}" for size in spacing)
