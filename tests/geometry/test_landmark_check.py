"""Given landmarks against the bones: near, far, and explained by RAS read as LPS."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.knee import KNOWN_LANDMARKS
from pipeline.geometry.landmark_check import FAR_LANDMARKS, FARTHEST_MM, misplaced
from tests.geometry.knees import sphere

#: Well away from the origin, where LPS and RAS differ.
BONES = {"femur": sphere(20.0, (80.0, -60.0, 300.0)), "tibia": sphere(20.0, (80.0, -60.0, 250.0))}


def test_landmarks_in_their_bones_are_accepted() -> None:
    given = {
        "medial_condyle_centre": np.array([80.0, -60.0, 300.0]),
        "tibia_shaft_centre": np.array([80.0, -60.0, 250.0]),
        "medial_plateau_centre": np.array([80.0, -60.0, 270.0]),
    }
    assert misplaced(given, BONES) is None
    assert misplaced({}, BONES) is None


@pytest.mark.parametrize("name", sorted(set(KNOWN_LANDMARKS) - FAR_LANDMARKS))
def test_a_landmark_read_in_the_other_system_is_recognised(name: str) -> None:
    bone = "tibia" if name.startswith("tibia") or "plateau" in name else "femur"
    height = 300.0 if bone == "femur" else 250.0
    away = np.hypot(160.0, 120.0) - 20.0
    assert misplaced({name: np.array([-80.0, 60.0, height])}, BONES) == (
        f"Landmark {name} lies {away:.0f} mm from the {bone}; read the other way (RAS as LPS) it would fit."
    )


def test_a_landmark_that_fits_neither_way_is_only_far() -> None:
    problem = misplaced({"femur_shaft_centre": np.array([80.0, -60.0, 500.0])}, BONES)
    assert problem == "Landmark femur_shaft_centre lies 180 mm from the femur."


def test_hip_and_ankle_may_lie_outside_the_scan() -> None:
    assert misplaced({name: np.array([80.0, -60.0, 800.0]) for name in FAR_LANDMARKS}, BONES) is None


@pytest.mark.parametrize(("away_mm", "accepted"), [(FARTHEST_MM - 0.5, True), (FARTHEST_MM + 0.5, False)])
def test_the_limit_is_the_distance_from_the_surface(away_mm: float, accepted: bool) -> None:  # noqa: FBT001 - a case
    given = {"lateral_epicondyle": np.array([80.0, -60.0, 320.0 + away_mm])}
    assert (misplaced(given, BONES) is None) is accepted


def test_the_first_by_name_is_reported() -> None:
    given = {name: np.zeros(3) for name in ("tibia_shaft_centre", "lateral_epicondyle")}
    problem = misplaced(given, BONES)
    assert problem is not None
    assert problem.startswith("Landmark lateral_epicondyle lies")
