"""Stage 50: the two rigid bodies that meet: what was labelled, as one closed surface each, in scan space."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import Field

from pipeline.adapters.mask_surface import SurfaceResult, SurfaceSettings, SurfaceTask, meshes_of
from pipeline.artifacts import ANATOMY, CASE_FACTS, LABELS, MESHES, MOVING_BODY, REFERENCE_BODY, SURFACE_ORIGINS
from pipeline.engine.stage import Finding, Findings, Inputs, Outputs, Severity, Stage, StrictParams
from pipeline.errors import CaseRejected
from pipeline.geometry.mesh import TriangleMesh, merged
from pipeline.geometry.volume import LabelVolume
from pipeline.geometry.voxel_mask import part_with, seen_as_right, voxels_of
from pipeline.records import Anatomy, CaseFacts, SurfaceOrigin


class Params(StrictParams):
    """Which structures make each body, and how finely they are meshed."""

    reference: list[str] = Field(min_length=1, description="structures of the body that stands still")
    moving: list[str] = Field(min_length=1, description="structures of the body that moves, rigid on one another")
    triangles: int = Field(60_000, ge=500, le=400_000, description="triangles of each body")
    reach_mm: float = Field(
        90.0, gt=10, le=1000, description="what lies farther than this from the joint never meets and is left out"
    )


def run(reads: Inputs, params: Params, out: Outputs) -> Findings:
    """Make both contact bodies."""
    facts = reads[CASE_FACTS]
    present = [name for name in (*params.reference, *params.moving) if name in facts.structures]
    if facts.source == "meshes":
        meshes = reads[MESHES]
        out[REFERENCE_BODY] = _of_meshes(meshes, params.reference, "reference")
        out[MOVING_BODY] = _of_meshes(meshes, params.moving, "moving")
        findings: Findings = ()
    else:
        findings = _of_labels(reads, params, out)
    out[SURFACE_ORIGINS] = _origins(params, present)
    return findings + _missing_surfaces(params, present)


def _of_meshes(meshes: Mapping[str, TriangleMesh], names: list[str], body: str) -> TriangleMesh:
    try:
        return merged([meshes[name] for name in names if name in meshes])
    except ValueError as error:
        raise _no_surface(body, error) from error


def _no_surface(body: str, error: ValueError) -> CaseRejected:
    return CaseRejected(
        "E-CON-01",
        f"The {body} contact body has no closed surface: {error}.",
        "Look at its labels for holes and loose voxels.",
    )


def _of_labels(reads: Inputs, params: Params, out: Outputs) -> Findings:
    given, facts, anatomy = reads[LABELS], reads[CASE_FACTS], reads[ANATOMY]
    if given is None:
        raise ValueError("a case of labels has no label volume")
    near = _near_joint(seen_as_right(given, facts.side), anatomy, params.reach_mm)
    reference, moving = _values(facts, params.reference), _values(facts, params.moving)
    settings = SurfaceSettings(triangles=params.triangles)
    results = meshes_of([_task(near, reference, moving, settings), _task(near, moving, reference, settings)], out.jobs)
    return tuple(_kept(body, result, out) for body, result in zip(("reference", "moving"), results, strict=True))


def _task(near: LabelVolume, own: list[int], other: list[int], settings: SurfaceSettings) -> SurfaceTask:
    part = part_with(near, own)
    return SurfaceTask(voxels_of(part.values, own), part.lps_from_index, settings, voxels_of(part.values, other))


def _kept(body: str, result: SurfaceResult | ValueError, out: Outputs) -> Finding:
    if isinstance(result, ValueError):
        raise _no_surface(body, result) from result
    out[REFERENCE_BODY if body == "reference" else MOVING_BODY] = result.mesh
    return _described(body, result)


def _described(name: str, result: SurfaceResult) -> Finding:
    return Finding(
        "N-CON-01",
        Severity.NOTE,
        f"{name.capitalize()} body: {len(result.mesh.triangles)} triangles, {result.deviation.rms_mm:.2f} mm RMS and "
        f"{result.deviation.max_mm:.2f} mm at most from the voxel surface, "
        f"volume {100 * result.volume_error:+.1f} %.",
    )


def _values(facts: CaseFacts, names: list[str]) -> list[int]:
    return [facts.structures[name] for name in names if name in facts.structures]


def _near_joint(labels: LabelVolume, anatomy: Anatomy, reach_mm: float) -> LabelVolume:
    """The labels within the reach of the moving frame's origin; slice by slice, which takes little memory."""
    matrix, values = labels.lps_from_index, np.zeros_like(labels.values)
    offset = matrix[:3, 3] - np.asarray(anatomy.scan_from_moving)[:3, 3]
    i, j, k = (np.arange(n, dtype=np.float64) for n in values.shape)
    planes = [row[0] * i[:, None] + row[1] * j for row in matrix[:3]]
    for at in range(len(k)):
        squared = sum((planes[r] + matrix[r, 2] * k[at] + offset[r]) ** 2 for r in range(3))
        values[:, :, at] = np.where(squared < reach_mm**2, labels.values[:, :, at], 0)
    return LabelVolume(values, matrix)


def _origins(params: Params, present: list[str]) -> tuple[SurfaceOrigin, ...]:
    rows = [("reference", name) for name in params.reference] + [("moving", name) for name in params.moving]
    return tuple(SurfaceOrigin(body, name, "labelled" if name in present else "absent") for body, name in rows)  # type: ignore[arg-type]


def _missing_surfaces(params: Params, present: list[str]) -> Findings:
    absent = [name.replace("_", " ") for name in (*params.reference, *params.moving) if name not in present]
    if not absent:
        return ()
    message = f"Not labelled and therefore not part of the contact: {', '.join(absent)}."
    return (Finding("W-CON-01", Severity.REVIEW, message),)


STAGE = Stage(
    50,
    "contact",
    (CASE_FACTS, LABELS, MESHES, ANATOMY),
    (REFERENCE_BODY, MOVING_BODY, SURFACE_ORIGINS),
    Params,
    run,
)
