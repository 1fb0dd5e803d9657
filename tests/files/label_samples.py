"""A small asymmetric label map, and writers for it that are not ours: nibabel, SimpleITK and pynrrd."""

from __future__ import annotations

import gzip
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nibabel
import nrrd
import numpy as np
import SimpleITK
from numpy.typing import NDArray

from pipeline.geometry.volume import LabelVolume

#: Takes LPS to RAS and back.
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])


def oblique_matrix(spacing_mm: tuple[float, float, float] = (1.0, 1.5, 2.0)) -> NDArray[np.float64]:
    """(4, 4) right-handed, a few degrees off the axes of the patient."""
    a, b = np.radians(7.0), np.radians(-4.0)
    about_z = np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(b), -np.sin(b)], [0.0, np.sin(b), np.cos(b)]])
    out = np.eye(4)
    out[:3, :3] = about_z @ about_x * spacing_mm
    out[:3, 3] = (-31.25, 12.5, 640.0)
    return out


def knee_like() -> LabelVolume:
    """Femur (5) above tibia (6), cartilage (1) on the femur, an odd corner of 7: no symmetry, stored in LPS order."""
    values = np.zeros((26, 22, 24), dtype=np.uint8)
    values[4:20, 5:17, 14:24] = 5
    values[4:20, 5:17, 12:14] = 1
    values[5:19, 6:18, 0:10] = 6
    values[22:25, 2:6, 15:19] = 7
    return LabelVolume(values, oblique_matrix())


def restored(volume: LabelVolume, order: tuple[int, int, int], flips: tuple[bool, bool, bool]) -> LabelVolume:
    """The same anatomy with its index axes exchanged and reversed: what another program may store."""
    matrix = volume.lps_from_index[:, (*order, 3)].copy()
    values = np.transpose(np.asarray(volume.values), order)
    for axis in range(3):
        if flips[axis]:
            matrix[:3, 3] += matrix[:3, axis] * (values.shape[axis] - 1)
            matrix[:3, axis] *= -1.0
            values = np.flip(values, axis)
    return LabelVolume(np.ascontiguousarray(values), matrix)


def nifti_image(volume: LabelVolume, kind: type = nibabel.Nifti1Image) -> Any:
    """A nibabel image with sform and qform, in millimetres."""
    image = kind(np.asarray(volume.values), FLIP @ volume.lps_from_index)
    image.header.set_xyzt_units("mm")
    image.set_sform(image.affine, 1)
    image.set_qform(image.affine, 1)
    return image


def nifti_bytes(volume: LabelVolume, *, compressed: bool = True, kind: type = nibabel.Nifti1Image) -> bytes:
    raw: bytes = nifti_image(volume, kind).to_bytes()
    return gzip.compress(raw, mtime=0) if compressed else raw


def with_header(raw: bytes, **fields: object) -> bytes:
    """Uncompressed NIfTI-1 bytes with header fields replaced."""
    header = nibabel.Nifti1Header.from_fileobj(io.BytesIO(raw), check=False)
    for name, value in fields.items():
        header[name] = value
    return bytes(header.binaryblock) + raw[348:]


def itk_image(volume: LabelVolume) -> SimpleITK.Image:
    image = SimpleITK.GetImageFromArray(np.transpose(np.asarray(volume.values), (2, 1, 0)))
    spacing = volume.spacing_mm
    image.SetSpacing([float(x) for x in spacing])
    image.SetOrigin([float(x) for x in volume.lps_from_index[:3, 3]])
    image.SetDirection([float(x) for x in (volume.lps_from_index[:3, :3] / spacing).ravel()])
    return image


def itk_bytes(volume: LabelVolume, folder: Path, name: str, *, compressed: bool = True) -> bytes:
    """What SimpleITK writes under this name (``.mha``, ``.nrrd``, ``.nii``)."""
    path = folder / name
    SimpleITK.WriteImage(itk_image(volume), str(path), useCompression=compressed)
    return path.read_bytes()


def nrrd_bytes(
    volume: LabelVolume, extra: Mapping[str, object] | None = None, space: str = "left-posterior-superior"
) -> bytes:
    """What pynrrd writes."""
    signs = {
        "left-posterior-superior": (1, 1, 1),
        "right-anterior-superior": (-1, -1, 1),
        "left-anterior-superior": (1, -1, 1),
    }
    columns = volume.lps_from_index[:3] * np.array(signs[space])[:, None]
    header = {"space": space, "space directions": columns[:, :3].T, "space origin": columns[:, 3], "encoding": "gzip"}
    buffer = io.BytesIO()
    nrrd.write(buffer, np.asarray(volume.values), header | dict(extra or {}), index_order="F")
    return buffer.getvalue()


def segment_keys(names: Mapping[str, int]) -> dict[str, object]:
    """Header keys of 3D Slicer's .seg.nrrd."""
    keys: dict[str, object] = {"Segmentation_ReferenceImageExtentOffset": "12 3 -1"}
    for number, (name, value) in enumerate(names.items()):
        keys |= {
            f"Segment{number}_ID": f"Segment_{number}",
            f"Segment{number}_Name": name,
            f"Segment{number}_LabelValue": str(value),
            f"Segment{number}_Layer": "0",
        }
    return keys
