"""Pictures show what is there, from where they say, and a machine that cannot draw says so."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import pytest

from pipeline.adapters import rendering
from pipeline.adapters.rendering import Image, Surface, distances_mm, snapshots
from pipeline.errors import EnvironmentFault
from pipeline.geometry.mesh import TriangleMesh, flipped, transformed
from pipeline.geometry.views import Direction, View, view
from pipeline.records import Side
from tests.report.sample import frame_of, revolved

SIZE = (120, 120)
RED = np.array([220, 30, 30], dtype=np.uint8)
SIDES: tuple[Direction, ...] = ("anterior", "posterior", "lateral", "medial", "proximal", "distal")


def ball(radius: float = 8.0) -> TriangleMesh:
    """A ball about the origin."""
    polar = np.linspace(0.05, np.pi - 0.05, 24)
    return revolved([(-radius * float(np.cos(t)), radius * float(np.sin(t))) for t in polar], 32)


def colored(image: Image) -> tuple[float, float]:
    """Mean (x, y) of the pixels that are not white."""
    y, x = np.nonzero((image < 250).any(axis=-1))
    return float(x.mean()), float(y.mean())


def pictures(mesh: TriangleMesh, views: list[View]) -> list[Image]:
    """Snapshots of one red mesh."""
    return snapshots([Surface(mesh, RED)], views, SIZE)


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_surface_appears_where_the_view_says(side: Side) -> None:
    frame = frame_of(side)
    center = np.array([20.0, 10.0, 15.0])
    mesh = transformed(TriangleMesh(ball().points + center, ball().triangles), frame)
    views = [view(frame, seen_from, frame[:3, 3], 50.0) for seen_from in SIDES]
    for seen, image in zip(views, pictures(mesh, views), strict=True):
        expected = seen.pixels((frame[:3, :3] @ center + frame[:3, 3])[None], SIZE)[0]
        assert colored(image) == pytest.approx(expected, abs=1.0)


def test_two_poses_and_two_views_give_different_pictures() -> None:
    frame = frame_of("right")
    views = [view(frame, seen_from, frame[:3, 3], 50.0) for seen_from in SIDES]
    mesh = transformed(TriangleMesh(ball().points * [1.0, 1.5, 2.0] + [9.0, 14.0, 5.0], ball().triangles), frame)
    shift = np.eye(4)
    shift[:3, 3] = [4.0, 4.0, 4.0]
    shown = [*pictures(mesh, views), *pictures(transformed(mesh, shift), views)]
    assert all((a != b).any() for a, b in itertools.combinations(shown, 2))


def test_the_same_scene_gives_the_same_pixels() -> None:
    views = [view(np.eye(4), "anterior", np.zeros(3), 20.0)]
    (first,), (second,) = pictures(ball(), views), pictures(ball(), views)
    assert (first == second).all()


def test_vertex_colors_are_shown_as_they_are() -> None:
    mesh = ball()
    colors = np.where(mesh.points[:, :1] > 0.0, [[0, 0, 255]], [[255, 0, 0]]).astype(np.uint8)
    (image,) = snapshots([Surface(mesh, colors, plain=True)], [view(np.eye(4), "proximal", np.zeros(3), 10.0)], SIZE)
    left, right = image[60, 30].astype(int), image[60, 90].astype(int)
    assert left[0] > 150 > left[2]
    assert right[2] > 150 > right[0]


@pytest.mark.parametrize(
    ("mesh", "problem"),
    [
        (TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32)), "finite points and at least one triangle"),
        (TriangleMesh(np.full((3, 3), np.nan), np.array([[0, 1, 2]], np.int32)), "finite points"),
        (TriangleMesh(np.eye(3), np.array([[0, 1, 3]], np.int32)), "index out of range"),
        (TriangleMesh(np.eye(3), np.array([[0, 1, -1]], np.int32)), "index out of range"),
    ],
)
def test_a_broken_mesh_never_reaches_the_renderer(mesh: TriangleMesh, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        pictures(mesh, [view(np.eye(4), "anterior", np.zeros(3), 10.0)])
    with pytest.raises(ValueError, match=problem):
        distances_mm(np.zeros((1, 3)), mesh)


def test_distances_to_a_ball() -> None:
    points = np.array([[0.0, 0.0, 12.0], [9.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
    assert distances_mm(points, ball()) == pytest.approx([4.0, 1.0, -3.0], abs=0.06)
    assert distances_mm(np.empty((0, 3)), ball()).shape == (0,)


def test_one_scene_leaves_nothing_in_the_next() -> None:
    seen = [view(np.eye(4), "anterior", np.zeros(3), 20.0)]
    (first,) = pictures(ball(), seen)
    pictures(ball(15.0), [view(np.eye(4), "proximal", np.full(3, 5.0), 90.0)])
    snapshots([Surface(ball(3.0), RED, plain=True)], seen, (60, 90))
    (again,) = pictures(ball(), seen)
    assert (first == again).all()


def test_what_faces_away_is_hidden_and_not_drawn() -> None:
    """Of a ball turned inside out only the far side is left."""
    seen = [view(np.eye(4), "anterior", np.zeros(3), 20.0)]
    (outward,), (inward,) = pictures(ball(), seen), pictures(flipped(ball()), seen)
    assert (outward != inward).any()


@pytest.fixture
def fresh_probe() -> Iterator[None]:
    """The renderer is tested again, before and after."""
    rendering.require_renderer.cache_clear()
    yield
    rendering.require_renderer.cache_clear()


@pytest.mark.usefixtures("fresh_probe")
@pytest.mark.parametrize(
    ("code", "how"),
    [("import os; os.abort()", "code -6"), ("raise SystemExit(3)", "code 3"), ("while True: pass", "1 s")],
)
def test_a_machine_that_cannot_draw_says_what_to_install(monkeypatch: pytest.MonkeyPatch, code: str, how: str) -> None:
    monkeypatch.setattr(rendering, "_PROBE", code)
    monkeypatch.setattr(rendering, "PROBE_SECONDS", 1.0)
    with pytest.raises(EnvironmentFault, match=f"{how}.*apt-get install .* libegl1 libgl1-mesa-dri") as caught:
        pictures(ball(), [view(np.eye(4), "anterior", np.zeros(3), 10.0)])
    assert caught.value.code == "E-ENV-10"
