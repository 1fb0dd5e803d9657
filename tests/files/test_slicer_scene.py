"""Files for 3D Slicer: ITK reads the inverse of the motion, our own reader the landmarks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import SimpleITK

from pipeline.files.markups import read_markups
from pipeline.files.slicer_scene import encode_landmarks, encode_tfm
from pipeline.playback import Lut
from tests.files.lut_sample import content

POINTS = {"lateral_epicondyle": (-110.25, -8.5, 21.0), "tibia_shaft_centre": (1e-17, 0.1, -64.0)}


@pytest.mark.parametrize("side", ["right", "left"])
def test_itk_takes_the_moved_point_back_to_the_scan(side: str, tmp_path: Path) -> None:
    motion = Lut(content(side)).pose(37.0, 1.0)
    file = tmp_path / "pose.tfm"
    file.write_bytes(encode_tfm(motion))
    read = SimpleITK.ReadTransform(str(file))
    for point in np.eye(3) * 80.0 + [120.0, -80.0, 600.0]:
        moved = motion[:3, :3] @ point + motion[:3, 3]
        np.testing.assert_allclose(read.TransformPoint(moved.tolist()), point, rtol=0, atol=1e-9)
        np.testing.assert_allclose(read.GetInverse().TransformPoint(point.tolist()), moved, rtol=0, atol=1e-9)


def test_a_pose_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="not finite"):
        encode_tfm(np.full((4, 4), np.nan))


def test_landmarks_come_back() -> None:
    assert read_markups(encode_landmarks(POINTS), "landmarks.mrk.json") == POINTS


def test_no_landmarks_are_an_empty_list() -> None:
    assert read_markups(encode_landmarks({}), "landmarks.mrk.json") == {}
