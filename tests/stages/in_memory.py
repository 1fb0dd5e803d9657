"""Stages run on artifacts in memory; each sees and leaves only what it declares."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.artifacts import Artifact
from pipeline.engine.stage import Findings, Stage, StrictParams
from pipeline.kinematics.joint_coordinates import JointCoordinates, reference_from_moving
from pipeline.records import Anatomy, CaseFacts, Matrix, Vector

T = TypeVar("T")
Float = NDArray[np.float64]
#: Flexion, varus, internal rotation (deg), lateral, anterior, proximal (mm).
Attitude = tuple[float, float, float, float, float, float]

FACTS = CaseFacts(
    case_id="P001",
    joint="knee",
    side="right",
    source="labels",
    source_files={},
    structures={"femur": 1, "tibia": 2},
    voxels={},
    spacing_mm=(1.0, 1.0, 1.0),
    shape=(10, 10, 10),
    clipped_mm2={},
    landmarks={},
)


@dataclass
class Run:
    """One stage with its inputs; what it left and told after :meth:`go`."""

    stage: Stage
    given: dict[str, Any]
    jobs: int = 1
    left: dict[str, Any] = field(default_factory=dict)
    told: list[tuple[int, int]] = field(default_factory=list)

    def __getitem__(self, artifact: Artifact[T]) -> T:
        """The artifact that the stage left, or was given."""
        if artifact not in (*self.stage.reads, *self.stage.writes):
            raise KeyError(artifact.name)
        value: T = {**self.given, **self.left}[artifact.name]
        return value

    def __setitem__(self, artifact: Artifact[T], value: T) -> None:
        if artifact not in self.stage.writes:
            raise KeyError(artifact.name)
        # as on disk: what cannot be encoded cannot be left
        self.left[artifact.name] = artifact.decode(artifact.encode(value))

    def progress(self, done: int, total: int) -> None:
        self.told.append((done, total))

    def took(self, part: str, seconds: float) -> None:
        """Nobody asks how long it took."""

    def go(self, params: StrictParams) -> Findings:
        """Run the stage."""
        return self.stage.run(self, params, self)


def facts(**changes: Any) -> CaseFacts:
    return replace(FACTS, **changes)


def matrix(values: Any) -> Matrix:
    """A 4x4 array as a record holds it."""
    return tuple((float(a), float(b), float(c), float(d)) for a, b, c, d in np.asarray(values))


def scanned(scan_from_reference: Float, attitude: Attitude) -> Float:
    """(4, 4) frame of the moving body that was scanned at this attitude."""
    flexion, varus, rotation = (float(np.radians(angle)) for angle in attitude[:3])
    coordinates = JointCoordinates(flexion, varus, rotation, *attitude[3:])
    return np.asarray(scan_from_reference @ reference_from_moving(coordinates))


def anatomy(scan_from_reference: Any, scan_from_moving: Any, scan_attitude: Attitude) -> Anatomy:
    """A right joint with these frames and nothing else known of it."""
    x, y, z = (float(value) for value in np.asarray(scan_from_moving)[:3, 2])
    delta: Vector = (x, y, z)
    frames = matrix(scan_from_reference), matrix(scan_from_moving)
    return Anatomy("right", (), (), *frames, delta, scan_attitude, ())
