"""Reads and outputs of a stage held in memory; what is written passes through its encoder and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from pipeline.artifacts import (
    ANATOMY,
    CASE_FACTS,
    CT,
    LABELS,
    MADE_MESHES,
    MESH_QUALITY,
    MESHES,
    MOVING_BODY,
    NEUTRAL_CURVE,
    RAW_TABLE,
    REFERENCE_BODY,
    SCAN_RETURNS,
    SMOOTH_TABLE,
    SURFACE_ORIGINS,
    SWEEP_FACTS,
)
from pipeline.engine.artifacts import Artifact
from pipeline.engine.stage import findings_of
from pipeline.report.evidence import Evidence

T = TypeVar("T")


class MemoryReads:
    """Artifacts by name."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.values = dict(values)

    def __getitem__(self, artifact: Artifact[T]) -> T:
        value: T = self.values[artifact.name]
        return value


class MemoryOutputs:
    """Encoded artifacts by name."""

    def __init__(self, jobs: int = 1) -> None:
        self.jobs = jobs
        self.files: dict[str, Mapping[str, bytes]] = {}
        self.steps: list[tuple[int, int]] = []
        self.parts: list[str] = []

    def __setitem__(self, artifact: Artifact[T], value: T) -> None:
        self.files[artifact.name] = artifact.encode(value)

    def value(self, artifact: Artifact[T]) -> T:
        """What a later stage would read."""
        return artifact.decode(self.files[artifact.name])

    def progress(self, done: int, total: int) -> None:
        """Remember how far the stage says it is."""
        self.steps.append((done, total))

    def took(self, part: str, seconds: float) -> None:
        """Remember the parts."""
        self.parts.append(part)


def reads_of(evidence: Evidence) -> MemoryReads:
    """The artifacts that evidence was gathered from."""
    values: dict[str, Any] = {
        CASE_FACTS.name: evidence.facts,
        LABELS.name: evidence.labels,
        CT.name: None,
        MESHES.name: evidence.meshes,
        MESH_QUALITY.name: evidence.mesh_quality,
        ANATOMY.name: evidence.anatomy,
        REFERENCE_BODY.name: evidence.reference,
        MOVING_BODY.name: evidence.moving,
        MADE_MESHES.name: {},
        SURFACE_ORIGINS.name: evidence.origins,
        RAW_TABLE.name: evidence.raw,
        SCAN_RETURNS.name: evidence.scan_returns,
        SWEEP_FACTS.name: evidence.sweep,
        NEUTRAL_CURVE.name: evidence.neutral,
        SMOOTH_TABLE.name: evidence.smooth,
    }
    return MemoryReads(values | {findings_of(name).name: found for name, found in evidence.findings.items()})
