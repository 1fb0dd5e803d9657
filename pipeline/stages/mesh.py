"""Stage 30, mesh: one closed triangle mesh for each structure of the label map, in LPS millimetres."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count
from typing import Annotated

import numpy as np
from pydantic import Field

from pipeline.adapters.mask_surface import SurfaceResult, SurfaceSettings, SurfaceTask, meshes_of
from pipeline.artifacts import CASE_FACTS, GIVEN_MESHES, LABELS, MESH_QUALITY, MESHES
from pipeline.engine.stage import Finding, Findings, Inputs, Outputs, Severity, Stage, StrictParams
from pipeline.errors import CaseRejected
from pipeline.geometry.mesh import TriangleMesh, check_arrays, check_closed, components, flipped, volume_mm3
from pipeline.geometry.volume import LabelVolume
from pipeline.geometry.voxel_mask import part_with, seen_as_right
from pipeline.records import MeshQuality
from pipeline.suggestions import plain

TriangleCount = Annotated[int, Field(ge=500, le=2_000_000)]


class Params(StrictParams):
    """How smooth and how light the meshes are."""

    triangles: TriangleCount = Field(default=8000, description="triangles of a structure that has no number of its own")
    triangles_of: dict[str, TriangleCount] = Field(default={}, description="triangles of single structures")
    smoothing_iterations: int = Field(default=50, ge=1, le=500, description="degree of the windowed sinc filter")
    smoothing_pass_bands: list[Annotated[float, Field(gt=0.0, le=2.0)]] = Field(
        default=[0.01, 0.03, 0.1],
        min_length=1,
        max_length=10,
        description="pass bands of that filter, smoothest first; the first that keeps the volume is used",
    )
    volume_tolerance_fraction: float = Field(
        default=0.02, gt=0.0, le=0.5, description="largest change of volume against the voxels"
    )
    deviation_limit_factor: float = Field(
        default=1.0, gt=0.0, le=10.0, description="largest distance from the voxels' surface, in voxel diagonals"
    )
    required: list[str] = Field(default=[], description="structures that must become one closed surface each")

    def surface_settings(self, structure: str) -> SurfaceSettings:
        """Settings of one structure's surface."""
        return SurfaceSettings(
            triangles=self.triangles_of.get(structure, self.triangles),
            iterations=self.smoothing_iterations,
            pass_bands=tuple(self.smoothing_pass_bands),
            volume_tolerance=self.volume_tolerance_fraction,
        )


@dataclass(frozen=True, eq=False)
class _Meshed:
    """What became of one structure; no mesh where it had to be left out."""

    mesh: TriangleMesh | None
    quality: MeshQuality | None
    findings: Findings


def run(reads: Inputs, params: Params, out: Outputs) -> Findings:
    """Mesh every structure, or check the meshes that the case brought.

    Raises
    ------
    CaseRejected
        E-MSH-01 when a required structure is not one closed surface, E-MSH-02 when a given mesh is not closed.
    """
    facts, labels = reads[CASE_FACTS], reads[LABELS]
    if labels is None:
        meshed = {name: _checked(name, mesh) for name, mesh in sorted(reads[GIVEN_MESHES].items())}
        out.progress(len(meshed), len(meshed))
    else:
        volume = seen_as_right(labels, facts.side)
        results = _results(volume, facts.structures, params, out)
        meshed = {name: _meshed(name, results[name], volume, params) for name in sorted(results)}
    out[MESHES] = {name: one.mesh for name, one in meshed.items() if one.mesh is not None}
    out[MESH_QUALITY] = tuple(one.quality for one in meshed.values() if one.quality is not None)
    return tuple(finding for one in meshed.values() for finding in one.findings)


def _checked(name: str, mesh: TriangleMesh) -> _Meshed:
    """A mesh that the case brought: closed or refused; turned where all of it is inside out."""
    try:
        check_arrays(mesh, words := plain(name))
        inverted = all(volume_mm3(piece) < 0.0 for piece in components(mesh))
        outward = flipped(mesh) if inverted else mesh
        check_closed(outward, words)
    except ValueError as error:
        raise CaseRejected(
            "E-MSH-02",
            f"The given mesh {error}; expected a closed surface.",
            f"Repair the mesh of {words} (3D Slicer, MeshLab), or bring a label map instead.",
        ) from error
    volume = volume_mm3(outward)
    quality = MeshQuality(name, len(mesh.triangles), volume, volume, 0.0, 0.0, 0, 0)
    note = _note("N-MSH-03", f"The given mesh of {words} had its normals inward; it was turned.")
    return _Meshed(outward, quality, (note,) if inverted else ())


def _results(
    volume: LabelVolume, structures: Mapping[str, int], params: Params, out: Outputs
) -> dict[str, SurfaceResult | ValueError]:
    """The surface of each structure, or why it has none."""
    tasks = {name: _task(volume, value, params.surface_settings(name)) for name, value in structures.items()}
    largest_first = sorted(tasks, key=lambda name: (-tasks[name].mask.size, name))
    finished = count(1)
    out.progress(0, len(tasks))
    found = meshes_of(
        [tasks[name] for name in largest_first], out.jobs, lambda _: out.progress(next(finished), len(tasks))
    )
    return dict(zip(largest_first, found, strict=True))


def _task(volume: LabelVolume, value: int, settings: SurfaceSettings) -> SurfaceTask:
    part = part_with(volume, [value])
    mask = part.values == value
    return SurfaceTask(mask, part.lps_from_index, settings, keep_out=(part.values != 0) & ~mask)


def _meshed(name: str, result: SurfaceResult | ValueError, volume: LabelVolume, params: Params) -> _Meshed:
    if isinstance(result, ValueError):
        return _left_out(name, result, params)
    if name in params.required and result.pieces > 1:
        return _left_out(name, ValueError(f"it consists of {result.pieces} separate pieces"), params)
    return _Meshed(result.mesh, _quality(name, result), tuple(_findings(name, result, volume, params)))


def _left_out(name: str, error: ValueError, params: Params) -> _Meshed:
    """Go on without a structure that is not needed.

    Raises
    ------
    CaseRejected
        E-MSH-01 for one that is.
    """
    words = plain(name)
    if name in params.required:
        raise CaseRejected(
            "E-MSH-01",
            f"The label of {words} does not give one closed surface: {error}.",
            f"Correct the segmentation of {words} (loose parts, holes, sheets one voxel thin) and run again.",
        ) from error
    message = f"The label of {words} does not give a closed surface ({error}); {words} is left out."
    return _Meshed(None, None, (Finding("W-MSH-04", Severity.REVIEW, message),))


def _quality(name: str, result: SurfaceResult) -> MeshQuality:
    return MeshQuality(
        name=name,
        triangles=len(result.mesh.triangles),
        volume_mm3=volume_mm3(result.mesh),
        label_volume_mm3=result.mask_volume_mm3,
        deviation_rms_mm=result.deviation.rms_mm,
        deviation_max_mm=result.deviation.max_mm,
        removed_voxels=result.removed_voxels,
        filled_voxels=result.filled_voxels,
    )


def _findings(name: str, result: SurfaceResult, volume: LabelVolume, params: Params) -> Iterator[Finding]:
    part = plain(name)
    tolerance, error = params.volume_tolerance_fraction, result.volume_error
    if abs(error) > tolerance:
        text = f"The mesh of {part} differs from its label by {error:+.2%} in volume, expected at most {tolerance:.2%}."
        yield Finding("W-MSH-01", Severity.REVIEW, text)
    limit = params.deviation_limit_factor * float(np.linalg.norm(volume.spacing_mm))
    if result.deviation.max_mm > limit:
        off = result.deviation.max_mm
        text = f"The mesh of {part} lies up to {off:.2f} mm off its label, expected at most {limit:.2f} mm."
        yield Finding("W-MSH-02", Severity.REVIEW, text)
    if result.deviation.worn_mm > limit:
        worn = result.deviation.worn_mm
        text = f"Smoothing took {worn:.2f} mm off thin parts of {part}, expected at most {limit:.2f} mm."
        yield Finding("W-MSH-03", Severity.REVIEW, text)
    if result.pass_band != params.smoothing_pass_bands[0]:
        text = f"{part} is thin and was smoothed less, to keep its volume (pass band {result.pass_band:g})."
        yield _note("N-MSH-01", text)
    if result.removed_voxels or result.filled_voxels:
        text = f"{part}: {result.removed_voxels} loose voxels removed, {result.filled_voxels} voxels of gaps filled."
        yield _note("N-MSH-02", text)
    if result.pieces > 1:
        yield _note("N-MSH-04", f"{part} consists of {result.pieces} separate pieces.")


def _note(code: str, message: str) -> Finding:
    return Finding(code, Severity.NOTE, message)


STAGE = Stage(
    number=30,
    name="mesh",
    reads=(CASE_FACTS, LABELS, GIVEN_MESHES),
    writes=(MESHES, MESH_QUALITY),
    Params=Params,
    run=run,
)
