"""A flow of two stages with settings of every kind, for tests of what is around a flow."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from pipeline.engine.artifacts import SOURCE, folder
from pipeline.engine.records import record_artifact
from pipeline.engine.stage import Finding, Findings, Inputs, Outputs, Severity, Stage, StrictParams
from pipeline.errors import CaseRejected

TEXT = record_artifact("text", "text.json", str)
REPORT = folder("report", "report/")


class IntakeParams(StrictParams):
    joint: str = "knee"
    side: Literal["right", "left"] | None = None
    labels: dict[str, int] = Field(default={}, description="Structure name -> label value.")
    required: list[str] = Field(default=[])
    optional: list[str] = Field(default=[])


class Grid(StrictParams):
    step_deg: float = Field(default=2.0, gt=0.0, le=10.0, description="Step of the grid.")
    range_deg: tuple[float, float] = (0.0, 120.0)

    @model_validator(mode="after")
    def _range_is_ordered(self) -> Grid:
        if self.range_deg[0] > self.range_deg[1]:
            raise ValueError("range_deg must not end before it begins")
        return self


class QaParams(StrictParams):
    grid: Grid = Grid()
    word: str = Field(default="fine", description="What the report says.")
    passes: tuple[Grid, ...] = ()
    count: int = Field(default=3, ge=1, le=9)
    review: bool = False


def _intake(reads: Inputs, params: IntakeParams, out: Outputs) -> Findings:
    if params.side is None:
        raise CaseRejected("E-SIDE-01", "The side is not given.", "Add side: right or side: left to case.yaml.")
    source = reads[SOURCE]
    out[TEXT] = source.read("labels.txt").decode()
    return ()


def _qa(reads: Inputs, params: QaParams, out: Outputs) -> Findings:
    out[REPORT] = {"report.html": f"<p>{reads[TEXT]} {params.word}</p>".encode()}
    found = Finding("W-TOY-01", Severity.REVIEW, "Look at the toy.")
    return (found,) * params.count if params.review else ()


INTAKE = Stage(10, "intake", (SOURCE,), (TEXT,), IntakeParams, _intake)
QA = Stage(80, "qa", (TEXT,), (REPORT,), QaParams, _qa)
TOY_FLOW = (INTAKE, QA)


def write_toy_configs(folder: Path) -> Path:
    """Configuration files that speak of the toy flow only, to stand in for those of the program."""
    for name in ("joints/knee", "joints/elbow", "protocols/clinical", "protocols/demo", "labels/toy"):
        path = folder / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("femur: 1\ntibia: 2\n" if name == "labels/toy" else "{}\n")
    return folder
