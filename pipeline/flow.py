"""The flow: every stage in order."""

from __future__ import annotations

from pipeline.engine.stage import Stage
from pipeline.stages import anatomy, contact, intake, mesh, package, qa, segment, smooth, sweep

FLOW: tuple[Stage, ...] = (
    intake.STAGE,
    segment.STAGE,
    mesh.STAGE,
    anatomy.STAGE,
    contact.STAGE,
    sweep.STAGE,
    smooth.STAGE,
    qa.STAGE,
    package.STAGE,
)
