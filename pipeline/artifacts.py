"""Every artifact of the flow, in order: what stages leave for one another on disk."""

from __future__ import annotations

from pipeline.engine.artifacts import folder
from pipeline.engine.records import record_artifact
from pipeline.files.arrays import (
    array_artifact,
    ct_volume_artifact,
    label_volume_artifact,
    mesh_artifact,
    mesh_set_artifact,
)
from pipeline.kinematics.neutral import NeutralCurve
from pipeline.kinematics.table import RawTable, SmoothTable
from pipeline.records import (
    Anatomy,
    CaseFacts,
    LigamentFibre,
    MeshQuality,
    ScanReturn,
    SurfaceOrigin,
    SweepFacts,
    Verdict,
)

# 10_intake
GIVEN_FACTS = record_artifact("given_facts", "given.json", CaseFacts)
GIVEN_LABELS = label_volume_artifact("given_labels", "given_labels.nrrd")  # None where the case brought none
CT = ct_volume_artifact("ct", "ct.nrrd")  # None where the case brought none
GIVEN_MESHES = mesh_set_artifact("given_meshes", "given_meshes.npz")  # empty where the case brought labels
LIGAMENTS = record_artifact("ligaments", "ligaments.json", tuple[LigamentFibre, ...])  # empty where it brought none

# 20_segment
CASE_FACTS = record_artifact("case_facts", "case.json", CaseFacts)
LABELS = label_volume_artifact("labels", "labels.nrrd")  # given, or found in the CT; None where the case brought meshes

# 30_mesh
MESHES = mesh_set_artifact("meshes", "meshes.npz")
MESH_QUALITY = record_artifact("mesh_quality", "mesh_quality.json", tuple[MeshQuality, ...])

# 40_anatomy
ANATOMY = record_artifact("anatomy", "anatomy.json", Anatomy)

# 50_contact
REFERENCE_BODY = mesh_artifact("reference_body", "reference_body.npz")
MOVING_BODY = mesh_artifact("moving_body", "moving_body.npz")
MADE_MESHES = mesh_set_artifact("made_meshes", "made_meshes.npz")  # empty where nothing had to be made
SURFACE_ORIGINS = record_artifact("surface_origins", "surface_origins.json", tuple[SurfaceOrigin, ...])

# 60_sweep
RAW_TABLE = array_artifact("raw_table", "raw_table.npz", RawTable)
NEUTRAL_CURVE = array_artifact("neutral_curve", "neutral_curve.npz", NeutralCurve)
SWEEP_FACTS = record_artifact("sweep_facts", "sweep_facts.json", SweepFacts)
SCAN_RETURNS = record_artifact("scan_returns", "scan_returns.json", tuple[ScanReturn, ...])

# 70_smooth
SMOOTH_TABLE = array_artifact("smooth_table", "smooth_table.npz", SmoothTable)

# 80_qa
VERDICT = record_artifact("verdict", "verdict.json", Verdict)
REPORT = folder("report", "report/")  # report.html, report.pdf and images/*.png

# 90_package
PACKAGE = folder("package", "./")  # the deliverable itself: lut.h5, lut.csv, meshes/ ...
