"""Labels held against the CT they came with: whether they lie on bone, how far off, and what an export did to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.stage import Finding, Findings, Severity
from pipeline.errors import CaseRejected
from pipeline.geometry.label_fit import BoneFit, Edge, bone_fit, displacement_mm, edge_of, header_mistakes
from pipeline.geometry.volume import CtVolume, LabelVolume
from pipeline.records import CaseFacts

Float = NDArray[np.float64]

#: Bones whose edges a CT shows all round.
HELD = ("femur", "tibia")
#: Share of an edge that may lie outside the CT.
_OUTSIDE = 0.01
_WAYS = (("left", "right"), ("back", "front"), ("head", "feet"))


@dataclass(frozen=True)
class FitLimits:
    """When labels lie on bone.

    Attributes
    ----------
    contrast_hu : float
        By this the CT is denser inside the edge of a label than outside, at least.
    review_mm, refuse_mm : float
        Labels that lie off by more are looked at, or refused.
    """

    contrast_hu: float
    review_mm: float
    refuse_mm: float

    def met(self, fit: BoneFit) -> bool:
        """Whether a label lies on bone at all."""
        return fit.covered > 1.0 - _OUTSIDE and fit.inside_hu - fit.outside_hu >= self.contrast_hu


def hold_against_ct(ct: CtVolume, labels: LabelVolume, facts: CaseFacts, limits: FitLimits) -> Findings:
    """See that labels of bone lie on bone.

    Parameters
    ----------
    ct : CtVolume
    labels : LabelVolume
        On any grid.
    facts : CaseFacts
    limits : FitLimits

    Raises
    ------
    CaseRejected
        E-LBL-08 when they do not, E-LBL-09 when they lie too far off; E-SEG-08 for either of labels that programs of
        the site have made.
    """
    edges = {name: edge_of(labels, facts.structures[name]) for name in HELD if name in facts.structures}
    fits = {name: bone_fit(ct, edge) for name, edge in edges.items()}
    if bad := {name: fit for name, fit in fits.items() if not limits.met(fit)}:
        raise _elsewhere(_words(bad), _mistake(ct, edges, limits), facts)
    off = displacement_mm(ct, tuple(edges.values())) if edges else np.zeros(3)
    length = float(np.linalg.norm(off))
    if length > limits.refuse_mm:
        raise _displaced(_way(off), limits.refuse_mm, facts)
    note = Finding("N-LBL-06", Severity.NOTE, f"The labels lie on bone in the CT, {length:.1f} mm off: {_words(fits)}.")
    if length <= limits.review_mm:
        return (note,)
    text = f"The labels lie off the bone in the CT: {_way(off)}. Look at the outlines on the slices."
    return note, Finding("W-LBL-09", Severity.REVIEW, text)


def _mistake(ct: CtVolume, edges: Mapping[str, Edge], limits: FitLimits) -> str:
    """What would explain labels that do not fit; empty where nothing known does."""
    for words, undone in header_mistakes(ct):
        if all(limits.met(bone_fit(ct, edge, undone)) for edge in edges.values()):
            return f" It would when {words}."
    return ""


def _elsewhere(words: str, mistake: str, facts: CaseFacts) -> CaseRejected:
    if facts.found_by:
        problem = f"What {' and '.join(facts.found_by)} labelled does not lie on bone in the CT: {words}.{mistake}"
        return CaseRejected("E-SEG-08", problem, "Look at the labels on the CT; segment the bones by other means.")
    problem = f"The label map does not belong to this CT: {words}.{mistake}"
    return CaseRejected(
        "E-LBL-08",
        problem,
        "Export the label map again with the geometry of the CT."
        if mistake
        else "Check that labels and CT are of the same patient, study and series.",
    )


def _displaced(way: str, limit_mm: float, facts: CaseFacts) -> CaseRejected:
    if facts.found_by:
        problem = f"What {' and '.join(facts.found_by)} labelled lies off the bone in the CT: {way}."
        return CaseRejected("E-SEG-08", problem, "Look at the labels on the CT; segment the bones by other means.")
    return CaseRejected(
        "E-LBL-09",
        f"The label map lies off the bone in the CT: {way}, expected at most {limit_mm:g} mm.",
        "Export the label map again with the geometry of this CT; the patient may have moved between two scans.",
    )


def _way(off_mm: Float) -> str:
    """A displacement in words, its largest part first."""
    order = [int(axis) for axis in np.argsort(-np.abs(off_mm)) if abs(off_mm[axis]) >= 0.05]
    parts = [f"{abs(off_mm[axis]):.1f} mm to the {_WAYS[axis][int(off_mm[axis] < 0)]}" for axis in order]
    return ", ".join(parts)


def _words(fits: Mapping[str, BoneFit]) -> str:
    return "; ".join(
        f"{name} at its edge {fit.inside_hu:.0f} HU, around it {fit.outside_hu:.0f} HU"
        + (f", {100 * (1 - fit.covered):.0f} % of it outside the CT" if fit.covered < 0.995 else "")
        for name, fit in fits.items()
    )
