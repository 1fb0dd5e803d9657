"""Stage 90: the deliverable - the table, meshes, report, a manifest with checksums, and all of it as one archive."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import numpy as np

from pipeline import __version__
from pipeline.artifacts import (
    ANATOMY,
    CASE_FACTS,
    MADE_MESHES,
    MESHES,
    MOVING_BODY,
    NEUTRAL_CURVE,
    PACKAGE,
    RAW_TABLE,
    REFERENCE_BODY,
    REPORT,
    SMOOTH_TABLE,
    SURFACE_ORIGINS,
    VERDICT,
)
from pipeline.engine.records import canonical_json
from pipeline.engine.stage import Findings, Inputs, Outputs, Stage, StrictParams, findings_of, settings_of
from pipeline.exports import ExportSource, export_files
from pipeline.files.archive import encode_zip
from pipeline.files.csv_table import encode_csv
from pipeline.files.lut_content import LutFileContent
from pipeline.files.lut_file import encode_lut
from pipeline.files.meshes import encode_ply, encode_stl
from pipeline.geometry.mesh import TriangleMesh
from pipeline.records import CaseFacts, SurfaceOrigin
from pipeline.suggestions import plain

#: Findings of every stage before this one, in order; one object each, since artifacts are told apart by identity.
_STAGES = ("intake", "segment", "mesh", "anatomy", "contact", "sweep", "smooth", "qa")
_SETTINGS = {name: settings_of(name) for name in _STAGES}
_FINDINGS = {name: findings_of(name) for name in _STAGES}

#: Packages whose numbers or files are in the deliverable.
_PACKAGES = ("h5py", "meshio", "numpy", "python-fcl", "scipy", "trimesh", "vtk")

_NOTICE = "research use, not for diagnosis"

_README = """\
{case_id}: look-up table of the stable poses of a {side} {joint}
Research use - not for diagnosis.

What is here
  report.html     open this first: verdict, pictures, numbers, what to look for
  report.pdf      the same on paper
  images/         the pictures and the film of the report, one file each
  lut.h5          the table for programs: poses, contact bodies, frames, proofs (HDF5, format version 1)
  lut.csv         the table for people: one row an attitude
  lut.json        the table for programs without HDF5, with poses to check a reader by; described by lut.schema.json
  {joint}.glb        AR/VR and web: lighter meshes and one animation for each varus (metres, Y up)
  opensim/        joint.osim: the joint as a function of flexion and varus, and its geometry (metres)
  slicer/         3D Slicer: landmarks, and poses every 30 degrees of flexion
  meshes/         every structure as PLY and as STL, as scanned
  manifest.json   versions, verdict, findings, SHA-256 of the input and of every file here

Space and signs
  Meshes, bodies and 4x4 matrices are in the space of the scan: LPS (DICOM patient space: x to the patient's left,
  y posterior, z superior), millimetres, column vectors. {joint}.glb and opensim/ have spaces of their own, and say so.
  Flexion +, varus +, internal rotation of the moving bone +, for a right and for a left joint alike.
  lut/moved_from_scan[i, j] takes the moving body ({moving}) from where it was scanned to its stable place at
  grid/flexion_deg[i], grid/varus_deg[j]. The reference body ({reference}) does not move.
  What belongs to neither body is shown as scanned; only what the moving bone carries, as the tibia the fibula, goes
  along with it ("carried" in manifest.json).
  Use an entry only where lut/status is 0 or 1. Do not extrapolate.

Play back in Python (needs numpy and h5py)

    import h5py, numpy as np
    with h5py.File("lut.h5") as f:
        flexion, varus = f["grid/flexion_deg"][:], f["grid/varus_deg"][:]
        moved_from_scan, status = f["lut/moved_from_scan"][:], f["lut/status"][:]
        points = f["bodies/moving/points"][:]
    i, j = np.abs(flexion - 45).argmin(), np.abs(varus - 0).argmin()
    assert status[i, j] <= 1, "no stable pose at this attitude"
    motion = moved_from_scan[i, j]
    placed = points @ motion[:3, :3].T + motion[:3, 3]

Between entries: with this software, "from pipeline.playback import Lut", then Lut.open("lut.h5").pose(flexion, varus)
is the interpolated motion; without it, interpolate the four coordinates (cubic in flexion, linear in varus) and apply
the formula of the format's documentation. Never interpolate the matrices.
"""


class Params(StrictParams):
    """The package has no settings."""


def run(reads: Inputs, params: Params, out: Outputs) -> Findings:  # noqa: ARG001 - the stage contract
    """Put the deliverable together; it adds no finding of its own."""
    facts = reads[CASE_FACTS]
    content, meshes, report = _content(reads), reads[MESHES] | reads[MADE_MESHES], reads[REPORT]
    files = {"lut.h5": encode_lut(content), "README.txt": _readme(facts, reads[SURFACE_ORIGINS])}
    files["lut.csv"] = encode_csv(content.smooth.grid, content.smooth.poses, facts.side)
    files |= {**_mesh_files(meshes), **export_files(_source(reads, content, meshes)), **report}
    files["manifest.json"] = canonical_json(_manifest(reads, files))
    archive = f"{facts.case_id}_ct2lut"
    out[PACKAGE] = {**files, f"{archive}.zip": encode_zip(files, archive)}
    return ()


def _content(reads: Inputs) -> LutFileContent:
    facts, anatomy = reads[CASE_FACTS], reads[ANATOMY]
    return LutFileContent(
        joint=facts.joint,
        side=anatomy.side,
        software=f"ct2lut {__version__}",
        smooth=reads[SMOOTH_TABLE],
        raw=reads[RAW_TABLE],
        neutral=reads[NEUTRAL_CURVE],
        scan_from_reference=np.array(anatomy.scan_from_reference),
        scan_from_moving=np.array(anatomy.scan_from_moving),
        delta=np.array(anatomy.delta),
        scan_attitude=np.array(anatomy.scan_attitude),
        reference_body=reads[REFERENCE_BODY],
        moving_body=reads[MOVING_BODY],
    )


def _source(reads: Inputs, content: LutFileContent, meshes: Mapping[str, TriangleMesh]) -> ExportSource:
    bodies = {one.structure: one.body for one in reads[SURFACE_ORIGINS] if one.origin != "absent"}
    bodies |= dict.fromkeys(_carried(reads), "moving")
    landmarks = {one.name: one.position for one in reads[ANATOMY].landmarks}
    return ExportSource(content, meshes, bodies, landmarks)


def _carried(reads: Inputs) -> list[str]:
    """Structures that the report shows moving with the moving body though they are no part of its contact surface."""
    wanted = reads[_SETTINGS["qa"]].get("pictures", {}).get("carried", [])
    return [name for name in wanted if name in reads[MESHES]]


def _mesh_files(meshes: Mapping[str, TriangleMesh]) -> dict[str, bytes]:
    """Every structure as PLY and STL; scan space, millimetres."""
    ply = {f"meshes/{name}.ply": encode_ply(mesh) for name, mesh in meshes.items()}
    return ply | {f"meshes/{name}.stl": encode_stl(mesh) for name, mesh in meshes.items()}


def _readme(facts: CaseFacts, origins: tuple[SurfaceOrigin, ...]) -> bytes:
    parts = {body: _words(origins, body) for body in ("reference", "moving")}
    return _README.format(case_id=facts.case_id, side=facts.side, joint=facts.joint, **parts).encode()


def _words(origins: tuple[SurfaceOrigin, ...], body: str) -> str:
    names = (plain(one.structure) for one in origins if one.body == body and one.origin != "absent")
    return ", ".join(names) or f"{body} body"


def _manifest(reads: Inputs, files: Mapping[str, bytes]) -> dict[str, Any]:
    facts, verdict = reads[CASE_FACTS], reads[VERDICT]
    return {
        "schema": {"name": "ct2lut-package", "version": "1.0"},
        "notice": _NOTICE,
        "software": {"name": "ct2lut", "version": __version__},
        "packages": {name: version(name) for name in _PACKAGES},
        "case_id": facts.case_id,
        "joint": facts.joint,
        "side": facts.side,
        "verdict": {"word": verdict.word, "reasons": list(verdict.reasons)},
        "surfaces": [
            {"body": one.body, "structure": one.structure, "origin": one.origin} for one in reads[SURFACE_ORIGINS]
        ],
        "carried": _carried(reads),
        # not their names, since a user may have put a patient's name into one
        "sources_sha256": sorted(facts.source_files.values()),
        "settings": {name: reads[artifact] for name, artifact in _SETTINGS.items()},
        "findings": [
            {"stage": stage, "code": one.code, "severity": str(one.severity), "message": one.message}
            for stage, artifact in _FINDINGS.items()
            for one in reads[artifact]
        ],
        "files": {
            name: {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)} for name, data in files.items()
        },
    }


STAGE = Stage(
    number=90,
    name="package",
    reads=(
        CASE_FACTS,
        MESHES,
        MADE_MESHES,
        ANATOMY,
        REFERENCE_BODY,
        MOVING_BODY,
        SURFACE_ORIGINS,
        RAW_TABLE,
        NEUTRAL_CURVE,
        SMOOTH_TABLE,
        VERDICT,
        REPORT,
        *_FINDINGS.values(),
        *_SETTINGS.values(),
    ),
    writes=(PACKAGE,),
    Params=Params,
    run=run,
)
