"""The meshes of ../shared/data/knee_jam as a case with a label map: ``python -m tests.validate.knee_jam_case CASES``.

Its cartilage is given as open sheets (the joint's side only), which the pipeline rightly refuses as bodies. Here the
space between sheet and bone becomes a label, at 0.4 mm, with the tibia where the first measured frame has it.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pipeline.adapters.mesh_mask import mesh_to_mask
from pipeline.engine.store import commit_folder
from pipeline.files.nrrd_format import encode_nrrd
from pipeline.geometry.mesh import Float, TriangleMesh, transformed
from pipeline.geometry.volume import LabelVolume
from tests.validate.measured_motion import OURS_FROM_DATA, frame_matrices, given_mesh

VOXEL_MM = 0.4
#: Space around the bones (mm).
MARGIN_MM = 3.0
#: Cartilage is nowhere thicker than this, and a point belongs to the triangle of its sheet at most this far aside (mm).
THICKEST_MM, ASIDE_MM = 6.0, 0.6
#: From the lateral, anterior, proximal axes of a right knee to LPS.
LPS_FROM_OURS = np.diag([-1.0, -1.0, 1.0, 1.0])

#: Label value (as ``pipeline/configs/labels/mskt.yaml``) -> closed mesh; where two overlap the later one has the voxel.
SOLIDS = {
    9: "tibia_frame/meniscus_lateral",
    10: "tibia_frame/meniscus_medial",
    5: "femur_frame/femur",
    6: "tibia_frame/tibia",
}
FEMORAL, TIBIAL = "femur_frame/femoral_cartilage", "tibia_frame/tibial_cartilage"
DECLARATION = "side: right\njoint: knee\nlabels: mskt\n"


def _placed(name: str) -> TriangleMesh:
    """A mesh of the folder in LPS, the tibia where the first frame has it."""
    femur_from_own = frame_matrices()[0] if name.startswith("tibia_frame") else np.eye(4)
    return transformed(given_mesh(name), LPS_FROM_OURS @ OURS_FROM_DATA @ femur_from_own)


def _grid(meshes: list[TriangleMesh]) -> tuple[tuple[int, int, int], Float]:
    """Shape and ``lps_from_index`` of a grid that holds all meshes."""
    points = np.concatenate([mesh.points for mesh in meshes])
    low = points.min(axis=0) - MARGIN_MM
    i, j, k = (int(n) for n in np.ceil((points.max(axis=0) + MARGIN_MM - low) / VOXEL_MM))
    lps_from_index: Float = np.diag([VOXEL_MM, VOXEL_MM, VOXEL_MM, 1.0])
    lps_from_index[:3, 3] = low
    return (i, j, k), lps_from_index


def _under(sheet: TriangleMesh, points: Float) -> NDArray[np.bool_]:
    """Which points (N, 3) lie behind a sheet, no farther than cartilage is thick and not beyond its rim."""
    corners: Float = sheet.points[sheet.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    asked = KDTree(corners.mean(axis=1)).query(points, distance_upper_bound=THICKEST_MM)
    distance: Float = np.asarray(asked[0])
    nearest: NDArray[np.intp] = np.asarray(asked[1])
    near = np.isfinite(distance)
    away = points[near] - corners.mean(axis=1)[nearest[near]]
    above = np.einsum("ij,ij->i", away, normals[nearest[near]])
    aside = np.sqrt(np.maximum(distance[near] ** 2 - above**2, 0.0))
    under = np.zeros(len(points), dtype=bool)
    under[near] = (above < 0.0) & (aside < ASIDE_MM)
    return under


def _behind(sheet: TriangleMesh, shape: tuple[int, int, int], lps_from_index: Float) -> NDArray[np.bool_]:
    """(I, J, K) the voxels behind a sheet, no farther than cartilage is thick."""
    origin: Float = lps_from_index[:3, 3]
    low: Float = (sheet.points.min(axis=0) - THICKEST_MM - origin) / VOXEL_MM
    high: Float = (sheet.points.max(axis=0) + THICKEST_MM - origin) / VOXEL_MM
    axes = [np.arange(max(int(a), 0), min(int(b), size)) for a, b, size in zip(low, high, shape, strict=True)]
    index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    mask = np.zeros(shape, dtype=bool)
    mask[tuple(index.T)] = _under(sheet, index * VOXEL_MM + origin)
    return mask


def knee_jam_labels() -> LabelVolume:
    """The label map: bones, menisci, and the cartilage between the bones and their sheets."""
    solids = {value: _placed(name) for value, name in SOLIDS.items()}
    shape, lps_from_index = _grid(list(solids.values()))
    values = np.zeros(shape, dtype=np.uint16)
    tibial = _placed(TIBIAL)
    medial_side = np.arange(shape[0]) * VOXEL_MM + lps_from_index[0, 3] > tibial.points[:, 0].mean()
    under_tibial = _behind(tibial, shape, lps_from_index)
    values[under_tibial & medial_side[:, None, None]] = 2
    values[under_tibial & ~medial_side[:, None, None]] = 3
    values[_behind(_placed(FEMORAL), shape, lps_from_index)] = 1
    for value, mesh in solids.items():
        values[mesh_to_mask(mesh, shape, lps_from_index)] = value
    return LabelVolume(values, lps_from_index)


def write_case(cases: Path) -> Path:
    """Make ``cases/knee_jam``."""
    folder = cases / "knee_jam"
    commit_folder(folder, {"labels.nrrd": encode_nrrd(knee_jam_labels()), "case.yaml": DECLARATION.encode()})
    return folder


if __name__ == "__main__":
    write_case(Path(sys.argv[1]))
