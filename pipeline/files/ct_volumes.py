"""A CT: what every reader of one returns, the gate of its CT numbers, and CTs in one file (NIfTI, NRRD, MetaImage).

The geometry gate is that of the label maps (``geometry_gate.check_geometry``).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.stage import Finding, Severity
from pipeline.errors import CaseRejected
from pipeline.files.foreign_image import ForeignImage, gunzip, gunzip_head
from pipeline.files.geometry_gate import check_geometry, handedness
from pipeline.files.metaimage_format import read_metaimage
from pipeline.files.nrrd_format import read_nrrd
from pipeline.files.volumes import reader_of
from pipeline.geometry.volume import CtVolume, in_lps_order

#: CT numbers that scanners write: below air some mark the rim of the scan, above 3071 an extended scale.
HU_RANGE = (-3100.0, 32_767.0)
#: A voxel below is air, one above is bone.
AIR_HU, BONE_HU = -500, 300
#: Top of the usual 12-bit scale; more than this far above it, only metal or an extended scale.
TOP_HU, TOP_MARGIN_HU = 3071, 100
#: As many voxels at the very top are cut-off metal, fewer are noise.
CLIPPED_VOXELS = 50
#: Smallest part of the voxels that must be bone.
BONE_FRACTION = 1e-3

_EXPORT = "Export the CT again as a DICOM series, or load it in 3D Slicer and save it there."
_GZIP_MAGIC = b"\x1f\x8b"

_SLAB = 32


@dataclass(frozen=True)
class CtFacts:
    """What the headers say of the scan besides its geometry; ``None`` where they do not.

    Attributes
    ----------
    kvp : float or None
        Peak voltage of the tube, kV.
    kernel, body_part : str or None
        Plain words only.
    slice_thickness_mm, tilt_deg : float or None
        As declared; the geometry is never taken from them.
    lossy : bool
        Whether the pixels went through a compression that loses something.
    """

    kvp: float | None = None
    kernel: str | None = None
    body_part: str | None = None
    slice_thickness_mm: float | None = None
    tilt_deg: float | None = None
    lossy: bool = False


@dataclass(frozen=True, eq=False)
class CtScan:
    """A CT that passed every gate.

    Attributes
    ----------
    volume : CtVolume
        int16 HU, axes nearest to +L, +P, +S; right-handed.
    findings : tuple of Finding
        What was assumed, changed, or should be looked at.
    set_aside : tuple of (str, str)
        Files that are not part of the volume -> why.
    laterality : str or None
        ``right`` or ``left`` where every slice says so.
    facts : CtFacts
    frame_of_reference : str
        Hash of the frame of reference of a DICOM series; empty of other files. Never to be stored.
    """

    volume: CtVolume
    findings: tuple[Finding, ...] = ()
    set_aside: tuple[tuple[str, str], ...] = ()
    laterality: str | None = None
    facts: CtFacts = CtFacts()
    frame_of_reference: str = ""


def _read_nifti(data: bytes, file: str) -> tuple[ForeignImage, tuple[float, float]]:
    from pipeline.files.nifti_format import read_nifti  # noqa: PLC0415 - nibabel, which a cached run must not pay for

    try:
        return read_nifti(data, file), (1.0, 0.0)
    except CaseRejected as error:
        if error.code != "E-LBL-05":
            raise
    return _read_scaled_nifti(data, file)


def _read_nrrd(data: bytes, file: str) -> tuple[ForeignImage, tuple[float, float]]:
    return read_nrrd(data, file), (1.0, 0.0)


def _read_metaimage(data: bytes, file: str) -> tuple[ForeignImage, tuple[float, float]]:
    return read_metaimage(data, file), (1.0, 0.0)


_READERS: dict[str, Callable[[bytes, str], tuple[ForeignImage, tuple[float, float]]]] = {
    ".nii": _read_nifti,
    ".nii.gz": _read_nifti,
    ".nrrd": _read_nrrd,
    ".mha": _read_metaimage,
}
#: File name endings of CTs in one file.
CT_ENDINGS = tuple(_READERS)


def read_ct_volume(data: bytes, file: str) -> CtScan:
    """Read a CT from a single file and refuse what cannot be trusted.

    Parameters
    ----------
    data : bytes
        The whole file.
    file : str
        Its name relative to the case folder; the ending chooses the format.

    Raises
    ------
    CaseRejected
        E-IO-*, E-GEO-*, E-CT-*; see ``docs/messages.md``.
    """
    reader = reader_of(file, _READERS)
    try:
        image, scale = reader(data, file)
        check_geometry(image.lps_from_index, image.values.shape, file)
    except CaseRejected as error:
        raise _told_of_a_ct(error, file) from error
    values, notes = hounsfield(image.values, scale, file)
    findings = (*image.findings, *handedness(image, file), *notes, *check_hounsfield(values, file))
    return CtScan(in_lps_order(CtVolume(values, image.lps_from_index)), findings)


def hounsfield(
    values: NDArray[Any], scale: tuple[float, float], file: str
) -> tuple[NDArray[np.int16], tuple[Finding, ...]]:
    """Stored values times slope plus intercept as int16, and a note where fractions were rounded.

    Parameters
    ----------
    values : array
        Whole numbers or fractions.
    scale : (float, float)
        Slope and intercept.
    file : str
        For messages.

    Raises
    ------
    CaseRejected
        E-CT-02 for NaN and for numbers that no CT has.
    """
    slope, intercept = scale
    if values.dtype.kind in "iu" and scale == (1.0, 0.0):
        _check_range(float(values.min()), float(values.max()), file)
        return values.astype(np.int16), ()
    out = np.empty(values.shape, dtype=np.int16)
    rounded = 0.0
    for begin in range(0, values.shape[-1], _SLAB):  # slab by slab, since scaling copies to 64 bits
        part = (..., slice(begin, begin + _SLAB))
        with np.errstate(over="ignore", invalid="ignore"):
            exact = values[part].astype(np.float64) * slope + intercept
        _check_range(float(exact.min()), float(exact.max()), file)
        whole = np.rint(exact)
        rounded = max(rounded, float(np.abs(whole - exact).max()))
        out[part] = whole.astype(np.int16)
    if rounded <= 1e-3:  # the scaling of a float header is no fraction of its own
        return out, ()
    text = f"{file} holds fractions of CT numbers; they were rounded to whole Hounsfield units."
    return out, (Finding("N-CT-01", Severity.NOTE, text),)


def check_hounsfield(values: NDArray[np.int16], file: str) -> tuple[Finding, ...]:
    """The gate of the CT numbers: bone must be there, air should, and nothing brighter than bone can be.

    Raises
    ------
    CaseRejected
        E-CT-02 out of range, E-CT-03 without bone.
    """
    _check_range(float(values.min()), float(values.max()), file)
    bone = np.count_nonzero(values > BONE_HU) / values.size
    if bone < BONE_FRACTION:
        raise CaseRejected(
            "E-CT-03",
            f"{file} shows no bone: {100 * bone:.2g} % of it is above {BONE_HU} HU, "
            f"expected at least {100 * BONE_FRACTION:g} %.",
            "Check that this is the CT of the joint and that it was exported in Hounsfield units.",
        )
    return (*_without_air(values, file), *_bright(values, file))


def _check_range(low: float, high: float, file: str) -> None:
    if not (low >= HU_RANGE[0] and high <= HU_RANGE[1]):  # also for NaN
        raise CaseRejected(
            "E-CT-02",
            f"{file} has values from {low:g} to {high:g}, expected Hounsfield units from "
            f"{HU_RANGE[0]:g} to {HU_RANGE[1]:g}.",
            "Check that this is a CT, and export it again in Hounsfield units.",
        )


def _without_air(values: NDArray[np.int16], file: str) -> tuple[Finding, ...]:
    if (values < AIR_HU).any():
        return ()
    text = (
        f"{file} has no voxel of air: its darkest is {values.min()} HU. Check that the scale of its CT numbers was not "
        "lost; a crop inside the limb is another reason."
    )
    return (Finding("W-CT-01", Severity.REVIEW, text),)


def _bright(values: NDArray[np.int16], file: str) -> tuple[Finding, ...]:
    highest = int(values.max())
    if highest > TOP_HU + TOP_MARGIN_HU:
        count = int(np.count_nonzero(values > TOP_HU + TOP_MARGIN_HU))
        bright = f"{file} reaches {highest} HU ({count} voxels above bone): look for metal or a damaged slice."
        return (Finding("W-CT-02", Severity.REVIEW, bright),)
    clipped = int(np.count_nonzero(values == highest)) if highest >= TOP_HU - 1 else 0
    if clipped < CLIPPED_VOXELS:
        return ()
    text = f"{file} is cut off at {highest} HU in {clipped} voxels; there may be metal, which streaks."
    return (Finding("N-CT-02", Severity.NOTE, text),)


def _told_of_a_ct(error: CaseRejected, file: str) -> CaseRejected:
    """The refusal of a reader that was written for label maps, in words for a CT."""
    if error.code == "E-LBL-04":
        return CaseRejected("E-CT-01", f"{file} is not one 3-D volume.", _EXPORT)
    if error.code in ("E-GEO-04", "E-GEO-06", "E-GEO-07"):
        return error
    if error.code == "E-IO-14":
        return CaseRejected(error.code, error.problem, "Crop the CT to the joint and save it with 16 bits.")
    return CaseRejected(error.code, error.problem, _EXPORT)


def _read_scaled_nifti(data: bytes, file: str) -> tuple[ForeignImage, tuple[float, float]]:
    """A NIfTI volume of scaled values, unscaled, with its slope and intercept.

    The reader refuses scaled values, since scaled labels are other labels, once it found the rest of the header sound.
    A CT is a measurement, and dcm2niix leaves the intercept of the scanner in the header.
    """
    import nibabel  # noqa: PLC0415 - which a cached run must not pay for

    compressed = data.startswith(_GZIP_MAGIC)
    head = gunzip_head(data, 540, file) if compressed else data[:540]
    kind = nibabel.Nifti2Header if 540 in (_number(head, "little"), _number(head, "big")) else nibabel.Nifti1Header
    header = kind(head[: kind.sizeof_hdr], check=False)
    scale = float(header["scl_slope"]), float(header["scl_inter"])
    if not np.isfinite(scale).all():
        problem = f"{file} scales its values by slope {scale[0]:g} and intercept {scale[1]:g}."
        raise CaseRejected("E-CT-04", problem, _EXPORT)
    rank = int(header["dim"][0])
    size = math.prod(int(n) for n in header["dim"][1 : rank + 1]) * header.get_data_dtype().itemsize
    plain = gunzip(data, int(header["vox_offset"]) + size, file) if compressed else data
    header["scl_slope"], header["scl_inter"] = 1.0, 0.0
    from pipeline.files.nifti_format import read_nifti  # noqa: PLC0415 - as above

    return read_nifti(bytes(header.binaryblock) + plain[kind.sizeof_hdr :], file), scale


def _number(head: bytes, order: Literal["little", "big"]) -> int:
    return int.from_bytes(head[:4], order)
