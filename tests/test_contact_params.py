"""Settings of exact contact, and the bodies they put into their frames."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.contact_params import ContactParams
from pipeline.geometry.mesh import check_closed, transformed
from pipeline.kinematics.cell import ProofSettings
from pipeline.kinematics.descent import MotionSettings
from pipeline.kinematics.joint_coordinates import rigid
from tests.geometry.knees import MIRROR, about
from tests.geometry.meshes import octahedron
from tests.stages.in_memory import anatomy

REFERENCE = rigid(about(10.0, 20.0, 30.0), np.array([1.0, 2.0, 3.0]))
MOVING = rigid(about(-5.0, 8.0, 40.0), np.array([4.0, 5.0, -60.0]))


def test_the_defaults_are_those_of_the_mathematics() -> None:
    assert ContactParams().motion() == MotionSettings()
    assert ContactParams().proof() == ProofSettings()


def test_each_setting_reaches_its_place() -> None:
    params = ContactParams(contact_tolerance_mm=1e-3, contact_band_mm=0.2, substep_mm=0.25)
    assert (params.motion().tolerance_mm, params.motion().substep_mm) == (1e-3, 0.25)
    assert params.proof().contact_band_mm == 0.2


@pytest.mark.parametrize("side", [np.eye(4), MIRROR], ids=["right", "left"])
def test_both_bodies_come_in_their_own_frames(side: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> None:
    body = octahedron(5.0)
    frames = anatomy(side @ REFERENCE, side @ MOVING, (0.0,) * 6)
    pair = ContactParams(eminence_mm=4.0).pair(
        transformed(body, side @ REFERENCE), transformed(body, side @ MOVING), frames
    )
    for mesh in (pair.reference, pair.moving):
        np.testing.assert_allclose(mesh.points, body.points, rtol=0, atol=1e-12)
        check_closed(mesh, "body")
    assert pair.eminence_mm == 4.0


@pytest.mark.parametrize(
    ("name", "value"),
    [("contact_tolerance_mm", 0.1), ("contact_band_mm", 0.0), ("substep_mm", -1.0), ("eminence_mm", -1.0)],
)
def test_numbers_out_of_range_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValidationError, match=name):
        ContactParams(**{name: value})
