"""Medial or lateral, told by the structures that only one side has."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.knee_side import side_signs
from tests.geometry.knees import sphere

LATERAL = np.array([-1.0, 0.0, 0.0])  # of a right knee in LPS


def test_each_pair_that_is_there_gives_a_sign() -> None:
    structures = {
        "tibia": sphere(10.0),
        "fibula": sphere(5.0, (-30.0, 20.0, -40.0)),
        "medial_meniscus": sphere(5.0, (20.0, 0.0, 5.0)),
        "lateral_meniscus": sphere(5.0, (-22.0, 0.0, 5.0)),
    }
    signs = side_signs(structures, LATERAL)
    assert [(sign.sentence, sign.agrees) for sign in signs] == [
        ("the fibula lies 30 mm lateral of the tibia", True),
        ("the lateral meniscus lies 42 mm lateral of the medial meniscus", True),
    ]
    assert [sign.lateral_mm for sign in signs] == pytest.approx([30.0, 42.0])


@pytest.mark.fault("V18")
def test_the_other_side_disagrees_in_every_sign() -> None:
    structures = {"tibia": sphere(10.0), "fibula": sphere(5.0, (30.0, 20.0, -40.0))}
    (sign,) = side_signs(structures, LATERAL)
    assert (sign.sentence, sign.agrees) == ("the fibula lies 30 mm medial of the tibia", False)
    assert sign.lateral_mm == pytest.approx(-30.0)


def test_a_pair_that_is_close_along_the_axis_says_nothing() -> None:
    structures = {"tibia": sphere(10.0), "fibula": sphere(5.0, (-7.0, 40.0, -40.0))}
    assert side_signs(structures, LATERAL) == ()


def test_bones_alone_say_nothing() -> None:
    assert side_signs({"femur": sphere(10.0), "tibia": sphere(10.0, (0.0, 0.0, -50.0))}, LATERAL) == ()
