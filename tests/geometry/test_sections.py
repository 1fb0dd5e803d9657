"""Cuts against shapes whose cut is known."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.mesh import TriangleMesh, transformed
from pipeline.geometry.sections import plane_section, volume_slice
from pipeline.geometry.views import view
from pipeline.geometry.volume import LabelVolume
from pipeline.records import Side
from tests.report.sample import frame_of, revolved

RADIUS = 10.0


def ball() -> TriangleMesh:
    """A ball of radius 10 about the origin."""
    polar = np.linspace(0.02, np.pi - 0.02, 60)
    return revolved([(-RADIUS * float(np.cos(t)), RADIUS * float(np.sin(t))) for t in polar], 90)


@pytest.mark.parametrize("height", [0.0, 3.0, -7.0])
def test_a_ball_is_cut_in_a_closed_circle(height: float) -> None:
    segments = plane_section(ball(), np.array([0.0, 0.0, height]), np.array([0.0, 0.0, 1.0]))
    assert segments[..., 2] == pytest.approx(height, abs=1e-9)
    assert np.linalg.norm(segments[..., :2], axis=-1) == pytest.approx(np.sqrt(RADIUS**2 - height**2), abs=0.05)
    ends = segments.reshape(-1, 3).round(6)
    assert (np.unique(ends, axis=0, return_counts=True)[1] % 2 == 0).all()


def test_a_plane_beside_the_mesh_cuts_nothing() -> None:
    assert plane_section(ball(), np.array([0.0, 0.0, 11.0]), np.array([0.0, 0.0, 1.0])).shape == (0, 2, 3)


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_slice_shows_the_voxel_under_each_pixel(side: Side) -> None:
    frame = frame_of(side)
    values = np.zeros((9, 9, 9), dtype=np.uint8)
    values[7, 4, 4] = 3  # 3 mm lateral of the centre
    values[4, 4, 6] = 5  # 2 mm proximal of it
    index = np.eye(4)
    index[:3, 3] = -4.0
    seen = view(frame, "anterior", frame[:3, 3], 4.5)
    shown = volume_slice(LabelVolume(values, frame @ index), seen, (9, 9))
    assert shown.dtype == np.uint8
    assert np.argwhere(shown == 3).tolist() == [[4, 1 if side == "right" else 7]]
    assert np.argwhere(shown == 5).tolist() == [[2, 4]]


def test_outside_the_volume_is_background() -> None:
    volume = LabelVolume(np.ones((2, 2, 2), dtype=np.uint16), np.eye(4))
    shown = volume_slice(volume, view(np.eye(4), "proximal", np.array([100.0, 0.0, 0.0]), 5.0), (6, 4))
    assert shown.shape == (4, 6)
    assert not shown.any()


def test_slice_and_section_agree_on_where_a_ball_is() -> None:
    frame = frame_of("left")
    mesh = transformed(ball(), frame)
    grid = np.stack(np.meshgrid(*[np.arange(-12.0, 12.5, 0.5)] * 3, indexing="ij"), axis=-1)
    index = np.diag([0.5, 0.5, 0.5, 1.0])
    index[:3, 3] = -12.0
    volume = LabelVolume((np.linalg.norm(grid, axis=-1) <= RADIUS).astype(np.uint8), frame @ index)
    seen = view(frame, "medial", frame[:3, 3] + 4.0 * frame[:3, 0], 15.0)
    area = np.count_nonzero(volume_slice(volume, seen, (300, 300))) * 0.1**2
    ends = seen.pixels(plane_section(mesh, seen.focus, seen.toward).reshape(-1, 3), (300, 300))
    reach = np.linalg.norm(ends - 150.0, axis=1).max() / 10.0
    assert area == pytest.approx(np.pi * reach**2, rel=0.02)
