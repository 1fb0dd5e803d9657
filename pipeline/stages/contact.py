"""Stage 50, contact: the two rigid bodies that meet: what was labelled, and what was made in place of what was not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Literal

import numpy as np
from pydantic import Field

from pipeline.adapters.mask_surface import SurfaceResult, SurfaceSettings, SurfaceTask, meshes_of
from pipeline.artifacts import (
    ANATOMY,
    CASE_FACTS,
    LABELS,
    MADE_MESHES,
    MESHES,
    MOVING_BODY,
    REFERENCE_BODY,
    SURFACE_ORIGINS,
)
from pipeline.engine.stage import Finding, Findings, Inputs, Outputs, Severity, Stage, StrictParams
from pipeline.errors import CaseRejected
from pipeline.geometry.made_surfaces import MeniscusShape, SurfaceBounds
from pipeline.geometry.mesh import TriangleMesh, merged
from pipeline.geometry.volume import LabelVolume
from pipeline.geometry.voxel_mask import part_with, seen_as_right, voxels_of
from pipeline.missing_surfaces import NOTHING_MADE, Made, Missing, Request, filled_in, make_surfaces
from pipeline.records import Anatomy, CaseFacts, SurfaceOrigin
from pipeline.suggestions import plain

#: Bounds of what is made, beside the maths that keeps them.
BOUNDS = SurfaceBounds()


class MeniscusParams(StrictParams):
    """Bounds of one made meniscus."""

    height_mm: float = Field(gt=0, le=20, description="over the bone of the plateau, at most")
    anterior_width_mm: float = Field(gt=0, le=30, description="of the anterior horn, from the outer edge inwards")
    posterior_width_mm: float = Field(gt=0, le=30, description="of the posterior horn")
    anterior_inset_mm: float = Field(ge=0, le=20, description="from the edge of the plateau in front")
    posterior_inset_mm: float = Field(ge=0, le=20, description="from the edge of the plateau behind")

    def shape(self) -> MeniscusShape:
        """As the maths takes it."""
        return MeniscusShape(**self.model_dump())


class MadeParams(StrictParams):
    """Bounds of cartilage and menisci that are made from the bones."""

    least_cartilage_mm: float = Field(
        BOUNDS.thickness_mm[0], gt=0, le=10, description="thickness of one side, at least"
    )
    most_cartilage_mm: float = Field(
        BOUNDS.thickness_mm[1], gt=0, le=10, description="thickness of the femoral side, at most"
    )
    cartilage_mm: float = Field(
        BOUNDS.default_thickness_mm, gt=0, le=10, description="thickness where the bones of the scan do not tell"
    )
    thicker_mm: float = Field(
        BOUNDS.extra_mm, ge=0, le=10, description="tibial cartilage beyond its thickness where the bones are nearest"
    )
    clearance_mm: float = Field(
        BOUNDS.clearance_mm, ge=0, le=2, description="left between made surfaces at the scan pose"
    )
    filler_mm: float = Field(BOUNDS.filler_mm, gt=0, le=30, description="height of the filler, at most")
    triangle_mm2: float = Field(0.7, ge=0.05, le=10, description="area of a triangle of what is made, on average")
    medial_meniscus: MeniscusParams = Field(
        default=MeniscusParams(**asdict(BOUNDS.medial)), description="bounds of the medial meniscus"
    )
    lateral_meniscus: MeniscusParams = Field(
        default=MeniscusParams(**asdict(BOUNDS.lateral)), description="bounds of the lateral meniscus"
    )

    def bounds(self) -> SurfaceBounds:
        """As the maths takes them."""
        return SurfaceBounds(
            thickness_mm=(self.least_cartilage_mm, self.most_cartilage_mm),
            default_thickness_mm=self.cartilage_mm,
            extra_mm=self.thicker_mm,
            clearance_mm=self.clearance_mm,
            medial=self.medial_meniscus.shape(),
            lateral=self.lateral_meniscus.shape(),
            filler_mm=self.filler_mm,
        )


class Params(StrictParams):
    """Which structures make each body, and how finely they are meshed."""

    reference: list[str] = Field(min_length=1, description="structures of the body that stands still")
    moving: list[str] = Field(min_length=1, description="structures of the body that moves, rigid on one another")
    triangles: int = Field(60_000, ge=500, le=400_000, description="triangles of each body")
    missing_surfaces: Missing = Field(
        "leave",
        description="cartilage and menisci that are not labelled: make them from the bones, put one filler between the "
        "bones, or leave them out",
    )
    made: MadeParams = Field(default=MadeParams(), description="bounds of what is made")
    reach_mm: float = Field(
        90.0, gt=10, le=1000, description="what lies farther than this from the joint never meets and is left out"
    )


def run(reads: Inputs, params: Params, out: Outputs) -> Findings:
    """Make both contact bodies."""
    names = (*params.reference, *params.moving)
    present = [name for name in names if name in reads[CASE_FACTS].structures]
    reference, moving, findings = _labelled(reads, params, out)
    missing = tuple(name for name in names if name not in present)
    made = _made((reference, moving), missing, reads[ANATOMY], params, out)
    out[MADE_MESHES] = made.meshes
    out[REFERENCE_BODY] = _joined(reference, [made.meshes[name] for name in made.reference])
    out[MOVING_BODY] = _joined(moving, [made.meshes[name] for name in made.moving])
    out[SURFACE_ORIGINS] = _origins(params, present, made)
    return findings + made.findings + _missing_surfaces(names, (*present, *filled_in(names, made)))


def _labelled(reads: Inputs, params: Params, out: Outputs) -> tuple[TriangleMesh, TriangleMesh, Findings]:
    if reads[CASE_FACTS].source != "meshes":
        return _of_labels(reads, params, out)
    meshes = reads[MESHES]
    return _of_meshes(meshes, params.reference, "reference"), _of_meshes(meshes, params.moving, "moving"), ()


def _made(
    bodies: tuple[TriangleMesh, TriangleMesh], missing: tuple[str, ...], anatomy: Anatomy, params: Params, out: Outputs
) -> Made:
    """What is missing, made from what is there, where that is wanted."""
    if params.missing_surfaces == "leave":
        return NOTHING_MADE
    request = Request(
        names=missing,
        reference=bodies[0],
        moving=bodies[1],
        anatomy=anatomy,
        bounds=params.made.bounds(),
        triangle_mm2=params.made.triangle_mm2,
        filler=params.missing_surfaces == "filler",
    )
    return make_surfaces(request, out.jobs)


def _joined(body: TriangleMesh, more: list[TriangleMesh]) -> TriangleMesh:
    return merged([body, *more]) if more else body


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


def _of_labels(reads: Inputs, params: Params, out: Outputs) -> tuple[TriangleMesh, TriangleMesh, Findings]:
    given, facts, anatomy = reads[LABELS], reads[CASE_FACTS], reads[ANATOMY]
    if given is None:
        raise ValueError("a case of labels has no label volume")
    near = _near_joint(seen_as_right(given, facts.side), anatomy, params.reach_mm)
    reference, moving = _values(facts, params.reference), _values(facts, params.moving)
    settings = SurfaceSettings(triangles=params.triangles)
    results = meshes_of([_task(near, reference, moving, settings), _task(near, moving, reference, settings)], out.jobs)
    first, second = (_kept(body, result) for body, result in zip(("reference", "moving"), results, strict=True))
    return first.mesh, second.mesh, (_described("reference", first), _described("moving", second))


def _task(near: LabelVolume, own: list[int], other: list[int], settings: SurfaceSettings) -> SurfaceTask:
    part = part_with(near, own)
    return SurfaceTask(voxels_of(part.values, own), part.lps_from_index, settings, voxels_of(part.values, other))


def _kept(body: str, result: SurfaceResult | ValueError) -> SurfaceResult:
    if isinstance(result, ValueError):
        raise _no_surface(body, result) from result
    return result


def _described(name: str, result: SurfaceResult) -> Finding:
    return Finding(
        "N-CON-01",
        Severity.NOTE,
        f"{name.capitalize()} body: {len(result.mesh.triangles)} triangles, {result.deviation.rms_mm:.2f} mm RMS and "
        f"{result.deviation.max_mm:.2f} mm at most from the voxel surface, "
        f"volume {100 * result.volume_error:+z.1f} %.",
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


def _origins(params: Params, present: list[str], made: Made) -> tuple[SurfaceOrigin, ...]:
    def origin(name: str) -> Literal["labelled", "synthesised", "absent"]:
        return "labelled" if name in present else "synthesised" if name in made.meshes else "absent"

    reference = [*params.reference, *(name for name in made.reference if name not in params.reference)]
    moving = [*params.moving, *(name for name in made.moving if name not in params.moving)]
    return (
        *(SurfaceOrigin("reference", name, origin(name)) for name in reference),
        *(SurfaceOrigin("moving", name, origin(name)) for name in moving),
    )


def _missing_surfaces(names: tuple[str, ...], there: tuple[str, ...]) -> Findings:
    absent = [plain(name) for name in names if name not in there]
    if not absent:
        return ()
    message = f"Not labelled and therefore not part of the contact: {', '.join(absent)}."
    return (Finding("W-CON-01", Severity.REVIEW, message),)


STAGE = Stage(
    50,
    "contact",
    (CASE_FACTS, LABELS, MESHES, ANATOMY),
    (REFERENCE_BODY, MOVING_BODY, MADE_MESHES, SURFACE_ORIGINS),
    Params,
    run,
)
