"""A joint whose stable pose is the same at every attitude: a ball in a hollow sphere about the flexion axis' middle."""

from __future__ import annotations

import numpy as np

from pipeline.adapters.contact_pool import ContactPair
from pipeline.geometry.mesh import TriangleMesh, flipped, merged
from pipeline.kinematics.incremental import IncrementalSettings
from pipeline.kinematics.sweep import SweepSettings
from tests.geometry.knees import sphere

HOLLOW_MM, BALL_MM = 12.0, 6.0
#: Way along delta from the middle to the stable pose, less what the facets of either sphere change.
REST_MM = HOLLOW_MM - BALL_MM
#: Facets of the spheres: their middles lie this much inside, mm; the height of rest is known to this.
FACETS_MM = 0.02
#: Off the middle the height changes by d^2 / (2 (R - r)), so the facets leave this much of the place open, mm.
PLACE_MM = float(np.sqrt(2.0 * REST_MM * FACETS_MM))
#: Half width of the strip between the compartments, mm.
EMINENCE_MM = 1.0

#: Few motions a cell, a contact band below the facets' unevenness.
SETTINGS = SweepSettings(
    IncrementalSettings(
        contact_band_mm=0.01,
        translation_resolution_mm=0.2,
        rotation_step_rad=float(np.radians(10.0)),
        rotation_resolution_rad=float(np.radians(2.0)),
    )
)


def hollow() -> TriangleMesh:
    """A closed shell: outward outside, towards its middle inside."""
    return merged([sphere(20.0, fine=2), flipped(sphere(HOLLOW_MM))])


def ball() -> TriangleMesh:
    return sphere(BALL_MM)


def hollow_pair() -> ContactPair:
    return ContactPair(hollow(), ball(), EMINENCE_MM)
