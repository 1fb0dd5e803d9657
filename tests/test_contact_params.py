"""Settings of exact contact, and the bodies they put into their frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.contact_params import ContactParams, fibres_of
from pipeline.errors import CaseRejected
from pipeline.geometry.mesh import check_closed, transformed
from pipeline.kinematics.cell import ProofSettings
from pipeline.kinematics.descent import MotionSettings
from pipeline.kinematics.joint_coordinates import rigid
from pipeline.kinematics.ligaments import NO_FIBRES
from pipeline.records import LigamentFibre
from tests.geometry.knees import MIRROR, about
from tests.geometry.meshes import octahedron
from tests.stages.in_memory import anatomy

REFERENCE = rigid(about(10.0, 20.0, 30.0), np.array([1.0, 2.0, 3.0]))
MOVING = rigid(about(-5.0, 8.0, 40.0), np.array([4.0, 5.0, -60.0]))


def test_the_defaults_are_those_of_the_mathematics() -> None:
    assert ContactParams().motion() == MotionSettings()
    assert ContactParams().proof() == ProofSettings(eminence_mm=5.0)


def test_each_setting_reaches_its_place() -> None:
    params = ContactParams(contact_tolerance_mm=1e-3, contact_band_mm=0.2, substep_mm=0.25, eminence_mm=4.0)
    assert (params.motion().tolerance_mm, params.motion().substep_mm) == (1e-3, 0.25)
    assert (params.proof().contact_band_mm, params.proof().eminence_mm) == (0.2, 4.0)


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


# --- ligaments

SPRING = LigamentFibre("spring", reference=(0.0, 0.0, 5.0), moving=(0.0, 3.0, 1.0), slack_mm=4.0, stiffness_n=20.0)
FRAMES = anatomy(np.eye(4), np.eye(4), (0.0,) * 6)
PAIR = ContactParams().pair(octahedron(5.0), octahedron(5.0), FRAMES)


def test_fibres_pull_as_multiples_of_the_push() -> None:
    fibres = fibres_of((SPRING,), FRAMES, PAIR, push_n=10.0, reference_strain=0.0)
    np.testing.assert_array_equal(fibres.on_reference, [SPRING.reference])
    np.testing.assert_array_equal(fibres.on_moving, [SPRING.moving])
    # 20 N per unit of strain are 5 N a mm at 4 mm
    assert (fibres.slack_mm[0], fibres.stiffness[0]) == (4.0, 0.5)


def test_fibres_without_a_slack_length_are_as_much_stretched_at_the_scan_as_is_said() -> None:
    given = replace(SPRING, slack_mm=None)
    fibres = fibres_of((given,), FRAMES, PAIR, push_n=10.0, reference_strain=0.25)
    assert fibres.slack_mm[0] == pytest.approx(5.0 / 1.25)


def test_without_a_push_to_compare_with_no_fibre_takes_part() -> None:
    assert fibres_of((SPRING,), FRAMES, PAIR, push_n=0.0, reference_strain=0.0) is NO_FIBRES


def test_fibres_of_another_scan_are_refused() -> None:
    stray = replace(SPRING, moving=(0.0, 300.0, 0.0))
    with pytest.raises(CaseRejected, match=r"E-LIG-03 .* not belong to this joint: Fibre spring ends 295"):
        fibres_of((SPRING, stray), FRAMES, PAIR, push_n=10.0, reference_strain=0.0)
