"""Stage 40: landmarks, joint frames, delta and the scan's own attitude, each with how sure we are of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from pipeline.artifacts import ANATOMY, CASE_FACTS, MESHES
from pipeline.engine.stage import Finding, Findings, Inputs, Outputs, Severity, Stage, StrictParams
from pipeline.errors import CaseRejected
from pipeline.geometry.directions import unit
from pipeline.geometry.knee import KNOWN_LANDMARKS, DeltaRule, KneeAnatomy, knee_anatomy
from pipeline.geometry.landmark_check import misplaced
from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.joint_coordinates import JointCoordinates, joint_coordinates
from pipeline.records import Anatomy, AxisEstimate, CaseFacts, Landmark, Matrix, Side, Vector

Float = NDArray[np.float64]
Row = Annotated[list[float], Field(min_length=4, max_length=4)]


class Params(StrictParams):
    """Where frames and delta come from, and how uncertain they may be."""

    method: Literal["knee", "given"] = Field(
        "knee", description="knee: from landmarks found on the meshes; given: the two frames below"
    )
    delta_rule: DeltaRule = Field(
        "neutral",
        description="push along the tibial long axis (long_axis), or the same square to the flexion axis (neutral)",
    )
    delta: list[float] | None = Field(
        None, min_length=3, max_length=3, description="direction of the push in scan space (LPS), instead of a rule"
    )

    @field_validator("delta")
    @classmethod
    def _delta_has_a_length(cls, delta: list[float] | None) -> list[float] | None:
        if delta is not None and not any(delta):
            raise ValueError("delta has no length")
        return delta

    scan_from_reference: list[Row] | None = Field(
        None, description="4x4 frame of the reference body in scan space, with method given"
    )
    scan_from_moving: list[Row] | None = Field(
        None, description="4x4 frame of the moving body in scan space, z along delta, with method given"
    )
    max_flexion_axis_uncertainty_deg: float = Field(
        2.5, gt=0, le=30, description="above this the case needs review: the axis leaks into every rotation"
    )
    max_long_axis_uncertainty_deg: float = Field(
        10.0, gt=0, le=45, description="above this the case needs review: too little of a shaft is in the scan"
    )


def run(reads: Inputs, params: Params, out: Outputs) -> Findings:
    """Find or take the frames of the joint."""
    facts = reads[CASE_FACTS]
    if params.method == "given":
        out[ANATOMY] = _given(facts.side, params)
        return ()
    meshes = reads[MESHES]
    given = _checked_landmarks(facts, meshes)
    try:
        knee = knee_anatomy(meshes, _handed(facts.side), given, _delta(params))
    except ValueError as error:
        raise CaseRejected(
            "E-ANA-01", f"{str(error)[:1].upper()}{str(error)[1:]}.", "Use a scan that shows more of the bones."
        ) from error
    _check_side(facts.side, knee)
    out[ANATOMY] = _record(facts.side, knee)
    return _findings(knee, params)


def _handed(side: Side) -> float:
    return 1.0 if side == "right" else -1.0


def _delta(params: Params) -> Float | DeltaRule:
    return params.delta_rule if params.delta is None else unit(np.asarray(params.delta, dtype=np.float64))


def _checked_landmarks(facts: CaseFacts, meshes: Mapping[str, TriangleMesh]) -> dict[str, Float]:
    """The landmarks that the user gave, each known by name and near its bone."""
    unknown = sorted(set(facts.landmarks) - set(KNOWN_LANDMARKS))
    if unknown:
        raise CaseRejected(
            "E-LMK-01", f"Unknown landmark {unknown[0]}.", f"Use these names: {', '.join(KNOWN_LANDMARKS)}."
        )
    given = {name: np.asarray(position) for name, position in facts.landmarks.items()}
    problem = misplaced(given, meshes)
    if problem is not None:
        raise CaseRejected("E-LMK-02", problem, "Check the coordinate system of the landmark file (LPS or RAS).")
    return given


def _check_side(side: Side, knee: KneeAnatomy) -> None:
    against = [sign.sentence for sign in knee.signs if not sign.agrees]
    if against:
        raise CaseRejected(
            "E-SIDE-02",
            f"The case says {side} knee, but {against[0]} there.",
            "Correct side: in case.yaml, or export the labels again: their left and right may be mirrored.",
        )


def _findings(knee: KneeAnatomy, params: Params) -> Findings:
    out = []
    if not knee.signs:
        out.append(
            Finding(
                "W-SIDE-01",
                Severity.REVIEW,
                "Nothing in the labels tells medial from lateral (fibula, menisci or tibial cartilage): "
                "check the side by eye.",
            )
        )
    limits = {
        "flexion_axis": params.max_flexion_axis_uncertainty_deg,
        "femoral_long_axis": params.max_long_axis_uncertainty_deg,
        "tibial_long_axis": params.max_long_axis_uncertainty_deg,
    }
    for name, limit in limits.items():
        spread = knee.axes[name].uncertainty_deg
        if spread > limit:
            out.append(
                Finding(
                    "W-ANA-01",
                    Severity.REVIEW,
                    f"The {name.replace('_', ' ')} is uncertain by {spread:.1f} deg (limit {limit:.1f}): "
                    "give landmarks, or a scan that shows more of the bone.",
                )
            )
    return tuple(out)


def _record(side: Side, knee: KneeAnatomy) -> Anatomy:
    return Anatomy(
        side=side,
        landmarks=tuple(
            Landmark(name, _vector(p.position), float(p.uncertainty_mm), "given" if p.given else "found")
            for name, p in sorted(knee.points.items())
        ),
        axes=tuple(
            AxisEstimate(name, _vector(axis.direction), float(axis.uncertainty_deg), axis.method)
            for name, axis in knee.axes.items()
        ),
        scan_from_reference=_matrix(knee.scan_from_femur),
        scan_from_moving=_matrix(knee.scan_from_tibia),
        delta=_vector(knee.delta),
        scan_attitude=_attitude(knee.scan),
        side_evidence=tuple(sign.sentence for sign in knee.signs),
    )


def _given(side: Side, params: Params) -> Anatomy:
    if params.scan_from_reference is None or params.scan_from_moving is None:
        raise CaseRejected(
            "E-ANA-02", "The joint takes its frames as given, but one is missing.", "Give both 4x4 frames."
        )
    reference, moving = np.asarray(params.scan_from_reference), np.asarray(params.scan_from_moving)
    for name, frame in (("scan_from_reference", reference), ("scan_from_moving", moving)):
        _check_frame(name, frame, side)
    scan = joint_coordinates(np.linalg.inv(reference) @ moving)
    return Anatomy(side, (), (), _matrix(reference), _matrix(moving), _vector(moving[:3, 2]), _attitude(scan), ())


def _check_frame(name: str, frame: Float, side: Side) -> None:
    orthonormal = frame.shape == (4, 4) and np.allclose(frame[:3, :3].T @ frame[:3, :3], np.eye(3), atol=1e-6)
    if not orthonormal or not np.allclose(frame[3], [0, 0, 0, 1]) or np.linalg.det(frame) * _handed(side) < 0:
        handed = "right-handed" if side == "right" else "left-handed"
        raise CaseRejected(
            "E-ANA-03", f"{name} is not a 4x4 {handed} orthonormal frame.", "Correct it in the joint file."
        )


def _attitude(scan: JointCoordinates) -> tuple[float, float, float, float, float, float]:
    flexion, varus, rotation = (float(np.degrees(angle)) for angle in scan[:3])
    return flexion, varus, rotation, scan.lateral_mm, scan.anterior_mm, scan.proximal_mm


def _vector(values: Float) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])


def _matrix(values: Float) -> Matrix:
    return tuple((float(r[0]), float(r[1]), float(r[2]), float(r[3])) for r in values)


STAGE = Stage(40, "anatomy", (CASE_FACTS, MESHES), (ANATOMY,), Params, run)
