"""The player in JavaScript gives the poses of the one in Python; the vectors are those of today's Python."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.kinematics.table import Status
from pipeline.report.figure_viewer import player_data
from tests.files.lut_sample import box
from tests.players.make_vectors import BAD, COUNT, FILE, GRID, table, vectors

HERE = Path(__file__).parent
VIEWER = HERE.parents[1] / "pipeline" / "report" / "viewer"
NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="node is not installed: the player in JavaScript is not tried")


def ran(script: str, *arguments: Path, given: object = None) -> Any:
    """What a script for node prints, from JSON."""
    assert NODE
    command = [NODE, str(HERE / script), *map(str, arguments)]
    done = subprocess.run(command, input=json.dumps(given), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_the_vectors_are_what_the_python_player_answers() -> None:
    kept, now = json.loads(FILE.read_text()), vectors()
    assert {**kept, "cases": None} == {**json.loads(json.dumps(now)), "cases": None}
    assert len(kept["cases"]) == len(now["cases"]) == COUNT
    for old, new in zip(kept["cases"], now["cases"], strict=True):
        numbers = [[*(case["moved_from_scan"] or []), *(case["used"] or [])] for case in (old, new)]
        assert {**old, "moved_from_scan": 0, "used": 0} == {**new, "moved_from_scan": 0, "used": 0}
        assert numbers[0] == pytest.approx(numbers[1], rel=0, abs=1e-10)


def test_the_vectors_hold_every_kind_of_attitude() -> None:
    cases = vectors()["cases"]
    posed = [case for case in cases if case["moved_from_scan"]]
    moved = [case for case in posed if [case["flexion_deg"], case["varus_deg"]] != case["used"]]
    refused = [case["error"] for case in cases if case["error"]]
    nothing = [case for case in cases if not case["error"] and not case["moved_from_scan"]]
    assert min(len(posed), len(moved), len(refused), len(nothing)) >= 20
    for words in ("outside the table", "no stable pose at", "not a number", "expected 'raise', 'clamp' or 'nan'"):
        assert any(words in one for one in refused)


@needs_node
def test_javascript_and_python_give_the_same_poses() -> None:
    found = ran("agreement.mjs", VIEWER / "player.js", FILE)
    assert found["posed"] + found["nothing"] + found["refused"] == COUNT
    assert found["worst"] < 1e-9


@needs_node
def test_a_wrong_player_is_found(tmp_path: Path) -> None:
    text = (VIEWER / "player.js").read_text()
    wrong = tmp_path / "player.js"
    wrong.write_text(text.replace("[1, 1, 2 * chord[0]]", "[1, 0, chord[0]]"))
    assert wrong.read_text() != text
    assert ran("agreement.mjs", wrong, FILE)["worst"] > 1e-6


@needs_node
def test_the_player_says_why_an_attitude_has_no_pose() -> None:
    at = {
        (10.0, -4.0): Status.SLID_OFF,
        (7.5, -4.0): Status.SLID_OFF,
        (5.0, -4.0): Status.OK,
        (5.0, -2.5): Status.NO_CONTACT,
        (5.0, -1.0): Status.NO_CONTACT,
        (20.0, 0.0): Status.SMOOTHED,
        (15.0, 0.0): Status.SMOOTHED,
        (75.0, 0.0): Status.OK,
        (75.1, 0.0): None,
        (20.0, 9.0): None,
    }
    given = {"data": player_data(table().table), "attitudes": list(at)}
    assert ran("status.mjs", VIEWER / "player.js", given=given) == list(at.values())


@needs_node
def test_distances_of_contact_colours_are_those_to_the_nearest_triangle() -> None:
    half, centre, reach = np.array([5.0, 3.0, 8.0]), np.array([100.0, -60.0, 700.0]), 4.0
    mesh = box((5.0, 3.0, 8.0), (100.0, -60.0, 700.0))
    points = centre + np.random.default_rng(8).uniform(-2.0 * half, 2.0 * half, (2000, 3))
    outside = np.abs(points - centre) - half
    expected = np.hypot.reduce(np.maximum(outside, 0.0), axis=1) + np.abs(np.minimum(outside.max(axis=1), 0.0))
    given = {
        "meshes": [{"points": mesh.points.ravel().tolist(), "corners": mesh.triangles.ravel().tolist()}],
        "reach": reach,
        "points": points.tolist(),
    }
    found = np.array(ran("distances.mjs", VIEWER / "contact.js", given=given), dtype=np.float64)
    near = expected < reach
    assert 500 < near.sum() < 1900
    np.testing.assert_allclose(found[near], expected[near], rtol=0, atol=1e-9)
    assert np.isnan(found[~near]).all()


def test_what_a_player_is_given_is_json_with_nothing_where_there_is_no_pose() -> None:
    data = player_data(table().table)
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    assert np.shape(data["status"]) == GRID.shape
    for name in ("lateral_mm", "anterior_mm", "proximal_mm", "internal_rotation_deg"):
        missing = {(i, j) for i, row in enumerate(data[name]) for j, value in enumerate(row) if value is None}
        assert missing == set(BAD)
