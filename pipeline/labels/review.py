"""What a person must know, or look at, in the label map of a knee before its results are used."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.stage import Finding, Findings, Severity
from pipeline.errors import CaseRejected
from pipeline.geometry.label_cleaning import SLIP_FRACTION, LabelRepair
from pipeline.geometry.volume import LabelVolume, centroid_lps, shared_area_mm2

#: A second piece of a required bone this large is another bone, not a slip of the segmentation.
OTHER_BONE_FRACTION = 0.1
#: Bones whose shafts leave the field of view in any scan of a knee.
SHAFTS = ("femur", "tibia", "fibula")
#: What marks a structure as soft tissue, which may be worn into several pieces.
SOFT_WORDS = ("cartilage", "meniscus")
#: Area on a second face of the volume that is more than a shaft which leaves through an edge.
SECOND_FACE_MM2 = 20.0
#: Bones do not touch in a living joint, but a few voxel faces may.
TOUCHING_MM2 = 20.0
#: Largest voxel side over the smallest from which on the surface is worse than the limits of the report assume.
MAX_ANISOTROPY = 4.0
#: Cosine between superior and tibia-to-femur: below it the order of the bones is not clear, below -it it is wrong.
UPRIGHT_COSINE = 0.5


def is_soft(structure: str) -> bool:
    """Whether a structure is cartilage or meniscus, by its name."""
    return structure.endswith(SOFT_WORDS)


def review_pieces(repairs: Mapping[str, LabelRepair], required: Collection[str], file: str) -> Findings:
    """Islands and cavities of every structure: what was mended, and what was too large to be a slip.

    Raises
    ------
    CaseRejected
        E-LBL-07 when a required bone is labelled twice.
    """
    findings: list[Finding] = []
    for name, repair in repairs.items():
        if name in required and not is_soft(name) and repair.second_fraction >= OTHER_BONE_FRACTION:
            raise CaseRejected(
                "E-LBL-07",
                f"{name} consists of {repair.pieces} separate pieces in {file}, the second with "
                f"{repair.second_fraction:.0%} of the first's volume, expected one bone.",
                "Keep one knee in the label map, and check that no other bone carries this label.",
            )
        findings += _islands(name, repair)
        findings += _cavities(name, repair)
    return tuple(findings)


def review_order(volume: LabelVolume, structures: Mapping[str, int], file: str) -> Findings:
    """Whether the femur lies proximal of the tibia; scanners make +S proximal in a leg.

    Raises
    ------
    CaseRejected
        E-LBL-06 when it clearly does not: labels exchanged, or the volume upside down.
    """
    if not {"femur", "tibia"} <= structures.keys():
        return ()
    values = np.asarray(volume.values)
    femur, tibia = (centroid_lps(values == structures[name], volume.lps_from_index) for name in ("femur", "tibia"))
    cosine = float((femur - tibia)[2] / max(float(np.linalg.norm(femur - tibia)), 1e-9))
    if cosine < -UPRIGHT_COSINE:
        raise CaseRejected(
            "E-LBL-06",
            f"The femur lies {(tibia - femur)[2]:.0f} mm below the tibia in {file}, expected above.",
            "Check that the labels of femur and tibia are not exchanged and that the volume is not upside down.",
        )
    if cosine < UPRIGHT_COSINE:
        return (_review("W-GEO-02", "The femur is not clearly above the tibia; check labels and orientation."),)
    return ()


def review_touching(volume: LabelVolume, structures: Mapping[str, int]) -> Findings:
    """Whether femur and tibia are labelled up to each other, as when a tool merged them or forgot the cartilage."""
    if not {"femur", "tibia"} <= structures.keys():
        return ()
    pair = (structures["femur"], structures["tibia"])
    area = shared_area_mm2(np.asarray(volume.values), pair, volume.spacing_mm)
    if area <= TOUCHING_MM2:
        return ()
    text = f"Femur and tibia touch over {area:.0f} mm2, expected at most {TOUCHING_MM2:.0f}; check where they meet."
    return (_review("W-LBL-03", text),)


def review_clipping(name: str, face_areas_mm2: NDArray[np.float64]) -> Findings:
    """Whether the field of view cuts a structure; a shaft may leave through one face.

    Parameters
    ----------
    name : str
    face_areas_mm2 : (6,) float64
        Area of the structure on each face of the volume.
    """
    total, largest = float(face_areas_mm2.sum()), float(face_areas_mm2.max())
    if total <= 0.0:
        return ()
    if name not in SHAFTS:
        return (_review("W-FOV-01", f"The field of view cuts {name} over {total:.0f} mm2."),)
    if (beside := total - largest) > SECOND_FACE_MM2:
        text = f"The field of view cuts {name} on more than one side ({beside:.0f} mm2 besides the shaft)."
        return (_review("W-FOV-01", text),)
    return (_note("N-FOV-01", f"The shaft of {name} leaves the field of view ({total:.0f} mm2)."),)


def review_anisotropy(spacing_mm: NDArray[np.float64]) -> Findings:
    """Whether the slices are much thicker than the pixels."""
    ratio = float(spacing_mm.max() / spacing_mm.min())
    if ratio <= MAX_ANISOTROPY:
        return ()
    size = " x ".join(f"{x:.3g}" for x in spacing_mm)
    text = f"Voxels of {size} mm are {ratio:.1f} times longer than wide, expected at most {MAX_ANISOTROPY:g} times."
    return (_review("W-GEO-01", text),)


def review_unused(counts: NDArray[np.int64], used: Collection[int], file: str) -> Findings:
    """Labels of the file that are no structure of this joint."""
    unused = [value for value in map(int, np.flatnonzero(counts[1:]) + 1) if value not in used]
    if not unused:
        return ()
    return (_note("N-LBL-01", f"Labels of {file} that are not used: {', '.join(map(str, unused))}."),)


def _islands(name: str, repair: LabelRepair) -> Findings:
    if repair.second_fraction >= SLIP_FRACTION:
        kept = "every large one" if is_soft(name) else "the largest"
        share = f"{repair.second_fraction:.1%}"
        text = f"{name} is labelled in {repair.pieces} pieces, the second {share} of the first; {kept} was kept."
        return (_review("W-LBL-01", text),)
    if repair.removed_voxels:
        text = f"{repair.pieces - 1} islands of {name} ({repair.removed_voxels} voxels) were removed."
        return (_note("N-LBL-04", text),)
    return ()


def _cavities(name: str, repair: LabelRepair) -> Findings:
    if not repair.filled_voxels:
        return ()
    text = f"Cavities inside {name} ({repair.filled_voxels} voxels, {repair.filled_fraction:.2%}) were filled."
    if repair.filled_fraction >= SLIP_FRACTION:
        return (_review("W-LBL-02", text),)
    return (_note("N-LBL-05", text),)


def _note(code: str, message: str) -> Finding:
    return Finding(code, Severity.NOTE, message)


def _review(code: str, message: str) -> Finding:
    return Finding(code, Severity.REVIEW, message)
