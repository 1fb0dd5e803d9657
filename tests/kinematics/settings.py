"""Solver settings and starts shared by the tests and by ``make validate``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.kinematics.contact import Pose
from pipeline.kinematics.descent import MotionSettings
from pipeline.kinematics.incremental import IncrementalSettings

PAPER = IncrementalSettings()
#: Facets of smooth bodies are closer together than the default band; only what truly touches is to react.
SMOOTH = replace(PAPER, contact_band_mm=0.002)
#: A fifth of the paper's resolutions, with contact exact enough to see the smaller gain.
FINE = replace(
    PAPER,
    translation_resolution_mm=0.02,
    rotation_resolution_rad=float(np.radians(0.02)),
    contact_band_mm=2e-4,
    gain_mm=4e-6,
    motion=MotionSettings(tolerance_mm=1e-6),
)
FINE_BAR = replace(FINE, contact_band_mm=0.05)
LARGE_MM = {"ball": 12.0, "bar": 20.0}

BALL_STARTS = [Pose(2.5, 1.5, -20, 0), Pose(-3, 1, -20, 0.2), Pose(0.5, -4, -20, 0), Pose(0.3, 0.2, -20, 0)]
BAR_STARTS = [
    Pose(1.5, 2, -20, 0.28),
    Pose(-2, -5, -20, -0.2),
    Pose(0.5, 0, -20, 0.1),
    Pose(0.37, 10, -20, -0.02),
    Pose(3, -15, -20, 0.3),
]


def with_steps(settings: IncrementalSettings, step_mm: float) -> IncrementalSettings:
    """Steps of this size; a turn of 60 degrees moves the bar's ends farther than its width."""
    return replace(settings, translation_step_mm=step_mm, rotation_step_rad=float(np.radians(60.0)))
