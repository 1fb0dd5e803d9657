"""Stage 20, segment: the labels of the bones, as given or found in the CT; given ones are held against the CT."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from pydantic import Field, field_validator

from pipeline.artifacts import CASE_FACTS, CT, GIVEN_FACTS, GIVEN_LABELS, LABELS
from pipeline.engine.stage import Finding, Findings, Inputs, Outputs, Severity, Stage, StrictParams
from pipeline.errors import CaseRejected
from pipeline.geometry.volume import CtVolume
from pipeline.labels.fitting import FitLimits, hold_against_ct
from pipeline.labels.site import SiteCommand, labels_of_commands, named_twice
from pipeline.records import CaseFacts

if TYPE_CHECKING:
    from pipeline.adapters.bone_segmentation import BoneSegmentation


class Params(StrictParams):
    """How bones are found in a CT, and what makes them doubtful."""

    smoothing_mm: float = Field(0.3, ge=0, le=3, description="standard deviation of a Gaussian on the CT")
    closing_mm: float = Field(
        1.5, ge=0, le=5, description="gaps in the shell of a bone up to about twice this are closed"
    )
    reach_mm: float = Field(160.0, ge=40, le=600, description="how far from the joint bones are followed, up and down")
    min_confidence_fraction: float = Field(0.8, ge=0, le=1, description="a bone found less surely needs review")
    least_contrast_hu: float = Field(
        100.0, ge=0, le=2000, description="given labels of bone are this much denser than what lies around them"
    )
    offset_review_mm: float = Field(
        0.75, ge=0, le=50, description="given labels that lie farther off the bone in the CT need review"
    )
    most_offset_mm: float = Field(2.0, ge=0, le=50, description="given labels that lie farther off are refused")
    commands: tuple[SiteCommand, ...] = Field(
        default=(),
        max_length=8,
        description="segmentation programs of the site, used in place of this program's own; never set by a case",
        json_schema_extra={"site_only": True},
    )
    command_limit_s: float = Field(
        3600.0,
        gt=0,
        le=86_400,
        description="each of those programs is ended after so many seconds; never set by a case",
        json_schema_extra={"site_only": True},
    )

    @field_validator("commands")
    @classmethod
    def _each_structure_has_one_command(cls, commands: tuple[SiteCommand, ...]) -> tuple[SiteCommand, ...]:
        if twice := named_twice(commands):
            raise ValueError(f"more than one command is to find: {', '.join(twice)}")
        return commands


def run(reads: Inputs, params: Params, out: Outputs) -> Findings:
    """Find the bones, or see that given labels are those of this CT.

    Raises
    ------
    CaseRejected
        E-SEG-01 when there is no such knee in the CT, E-LBL-08 and E-LBL-09 when labels do not belong to it, E-SEG-08
        when those of the site's programs do not lie on bone; what
        :func:`pipeline.labels.site.labels_of_commands` raises.
    """
    facts, labels, ct = reads[GIVEN_FACTS], reads[GIVEN_LABELS], reads[CT]
    if facts.source != "ct":
        out[CASE_FACTS], out[LABELS] = facts, labels
        return () if ct is None or labels is None else hold_against_ct(ct, labels, facts, _fit_limits(params))
    if ct is None:
        raise ValueError("a case of a CT has no CT")
    if params.commands:
        taken = labels_of_commands(ct, facts, params.commands, params.command_limit_s, out.progress)
        out[CASE_FACTS], out[LABELS] = taken.facts, taken.volume
        return (*taken.findings, *hold_against_ct(ct, taken.volume, taken.facts, _fit_limits(params)))
    found = _found(ct, facts, params)
    out[CASE_FACTS], out[LABELS] = _facts_of(facts, found), found.labels
    return _findings(found, params)


def _found(ct: CtVolume, facts: CaseFacts, params: Params) -> BoneSegmentation:
    from pipeline.adapters import bone_segmentation  # noqa: PLC0415 - scipy, which a cached run must not pay for

    settings = bone_segmentation.SegmentationSettings(params.smoothing_mm, params.closing_mm, params.reach_mm)
    try:
        return bone_segmentation.segment_bones(ct, facts.side, settings)
    except ValueError as error:
        raise CaseRejected(
            "E-SEG-01",
            f"The bones cannot be found: {error}.",
            "Check that this is the CT of the knee, and the side; else segment the bones and give a label map.",
        ) from error


def _facts_of(facts: CaseFacts, found: BoneSegmentation) -> CaseFacts:
    labels = found.labels
    x, y, z = map(float, labels.spacing_mm)
    i, j, k = labels.values.shape
    return replace(
        facts,
        structures=dict(found.structures),
        voxels={name: bone.voxels for name, bone in found.bones.items()},
        spacing_mm=(x, y, z),
        shape=(i, j, k),
        clipped_mm2={name: bone.cut_mm2 for name, bone in found.bones.items()},
    )


def _findings(found: BoneSegmentation, params: Params) -> Findings:
    sure = ", ".join(f"{name} {100 * value:.0f} %" for name, value in found.confidence.items())
    out = [Finding("N-SEG-01", Severity.NOTE, f"The bones were found in the CT by the program; how surely: {sure}.")]
    if doubtful := [name for name, value in found.confidence.items() if value < params.min_confidence_fraction]:
        message = f"Found without certainty in the CT: {', '.join(doubtful)}. Look at their outlines on the slices."
        out.append(Finding("W-SEG-01", Severity.REVIEW, message))
    if found.facts.missing:
        message = f"Not found in the CT: {', '.join(found.facts.missing)}. They take no part in the contact."
        out.append(Finding("N-SEG-02", Severity.NOTE, message))
    if found.facts.knees > 1:
        message = f"{found.facts.knees} knees are in the CT; the one of the declared side was taken."
        out.append(Finding("N-SEG-03", Severity.NOTE, message))
    if found.facts.metal_mm3 > 0.0:
        message = f"There is metal in the CT ({found.facts.metal_mm3 / 1000:.1f} ml): outlines near it are not sure."
        out.append(Finding("W-SEG-02", Severity.REVIEW, message))
    return tuple(out)


def _fit_limits(params: Params) -> FitLimits:
    return FitLimits(params.least_contrast_hu, params.offset_review_mm, params.most_offset_mm)


STAGE = Stage(20, "segment", (GIVEN_FACTS, GIVEN_LABELS, CT), (CASE_FACTS, LABELS), Params, run)
