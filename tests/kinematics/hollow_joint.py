"""A joint whose stable pose is the same at every attitude: a ball in a bowl about the flexion axis' middle."""

from __future__ import annotations

import numpy as np

from pipeline.adapters.contact_pool import ContactPair
from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.validation_objects import revolved
from pipeline.kinematics.cell import ProofSettings
from pipeline.kinematics.direct.prepare import prepare
from pipeline.kinematics.direct.solver import DirectSolver
from pipeline.kinematics.incremental import IncrementalSettings
from pipeline.kinematics.solvers import IncrementalSolver
from tests.geometry.knees import sphere

HOLLOW_MM, BALL_MM = 12.0, 6.0
#: Way along delta from the middle to the stable pose, less what the facets of either body change.
REST_MM = HOLLOW_MM - BALL_MM
#: Facets of the bodies: their middles lie this much inside, mm; the height of rest is known to this.
FACETS_MM = 0.02
#: Off the middle the height changes by d^2 / (2 (R - r)), so the facets leave this much of the place open, mm.
PLACE_MM = float(np.sqrt(2.0 * REST_MM * FACETS_MM))
#: Half width of the strip between the compartments, mm.
EMINENCE_MM = 1.0
#: So far from its axis the bowl ends.
OPENING_DEG = 85.0

#: Few motions a cell, a contact band below the facets' unevenness.
SETTINGS = IncrementalSettings(
    contact_band_mm=0.01,
    translation_resolution_mm=0.2,
    rotation_step_rad=float(np.radians(10.0)),
    rotation_resolution_rad=float(np.radians(2.0)),
)
PROOF = ProofSettings(contact_band_mm=0.01, eminence_mm=EMINENCE_MM)


def hollow() -> TriangleMesh:
    """A closed bowl, open downwards."""
    angles = np.radians(np.linspace(0.0, OPENING_DEG, 48))
    arc = np.column_stack([np.sin(angles), np.cos(angles)])
    return revolved(np.vstack([HOLLOW_MM * arc, 20.0 * arc[::-1]]), 96)


def ball() -> TriangleMesh:
    return sphere(BALL_MM)


def hollow_pair() -> ContactPair:
    return ContactPair(hollow(), ball(), EMINENCE_MM)


def incremental() -> IncrementalSolver:
    return IncrementalSolver(hollow_pair().bodies(), SETTINGS, PROOF)


def direct() -> DirectSolver:
    return DirectSolver(prepare(hollow(), ball()), proof=PROOF)
