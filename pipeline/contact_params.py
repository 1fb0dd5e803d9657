"""Settings of exact contact, shared by every stage that tests it."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from pipeline.adapters.contact_pool import ContactPair
from pipeline.engine.stage import StrictParams
from pipeline.errors import CaseRejected
from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.body_frames import in_frame, ligaments_in_frames, stray_fibre
from pipeline.kinematics.cell import ProofSettings
from pipeline.kinematics.descent import MotionSettings
from pipeline.kinematics.ligaments import NO_FIBRES, Fibres
from pipeline.records import Anatomy, LigamentFibre


def fibres_of(
    ligaments: tuple[LigamentFibre, ...], anatomy: Anatomy, pair: ContactPair, push_n: float, reference_strain: float
) -> Fibres:
    """The fibres of a case as solvers take them; none for a push of 0.

    Raises
    ------
    CaseRejected
        E-LIG-03 where a fibre ends far from its body.
    """
    if push_n == 0.0:
        return NO_FIBRES
    frames = np.asarray(anatomy.scan_from_reference), np.asarray(anatomy.scan_from_moving)
    known = ligaments_in_frames(ligaments, *frames, reference_strain)
    stray = stray_fibre(known, pair.reference, pair.moving)
    if stray is not None:
        raise CaseRejected(
            "E-LIG-03",
            f"The ligaments do not belong to this joint: {stray}",
            "Check that ligaments.csv is in LPS millimetres of this scan (3D Slicer writes RAS unless told otherwise).",
        )
    return known.fibres(push_n)


class ContactParams(StrictParams):
    """How exact contact is, and what counts as one."""

    contact_tolerance_mm: float = Field(2e-4, ge=1e-6, le=0.01, description="width of the bracket around contact")
    contact_band_mm: float = Field(0.05, gt=0, le=1, description="features closer than this react")
    substep_mm: float = Field(0.5, gt=0, le=5, description="longest way between collision tests; the thinnest feature")
    eminence_mm: float = Field(5.0, ge=0, le=50, description="half width of the strip between the compartments")

    def motion(self) -> MotionSettings:
        """How motions are swept and stopped."""
        return MotionSettings(tolerance_mm=self.contact_tolerance_mm, substep_mm=self.substep_mm)

    def proof(self) -> ProofSettings:
        """How a pose is proven."""
        return ProofSettings(contact_band_mm=self.contact_band_mm, eminence_mm=self.eminence_mm)

    def pair(self, reference: TriangleMesh, moving: TriangleMesh, anatomy: Anatomy) -> ContactPair:
        """Both bodies (scan space) in their kinematic frames."""
        return ContactPair(
            in_frame(reference, np.asarray(anatomy.scan_from_reference)),
            in_frame(moving, np.asarray(anatomy.scan_from_moving)),
            self.eminence_mm,
        )
