"""What the model of the page is given, and the scripts that move it."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.mesh import TriangleMesh, merged
from pipeline.records import Side
from pipeline.report import figure_viewer
from pipeline.report.figure_viewer import content_policy, quantised, scripts, viewer_data
from pipeline.report.palette import hexadecimal, structure_color
from pipeline.report.settings import PictureSettings
from tests.report.sample import only_one_attitude, revolved, sample_evidence

SETTINGS = PictureSettings()


def decoded(part: dict[str, object]) -> TriangleMesh:
    """The mesh that a page makes of a part."""
    points = np.frombuffer(base64.b64decode(str(part["points"])), "<u2").reshape(-1, 3)
    corners = np.frombuffer(base64.b64decode(str(part["corners"])), f"<u{int(str(part['corner_bits'])) // 8}")
    low, step = np.array(part["low"], dtype=np.float64), float(str(part["step_mm"]))
    return TriangleMesh(low + points * step, corners.reshape(-1, 3).astype(np.int32))


def ball(count: int) -> TriangleMesh:
    """A sphere of 2 count^2 triangles."""
    turn = np.linspace(-1.5, 1.5, count)
    return revolved([(30.0 * float(np.sin(t)), 30.0 * float(np.cos(t))) for t in turn], count)


def test_a_mesh_is_kept_to_half_a_step() -> None:
    mesh = sample_evidence().meshes["tibia"]
    part = quantised(mesh)
    kept = decoded(part)
    np.testing.assert_array_equal(kept.triangles, mesh.triangles)
    assert part["corner_bits"] == 16
    assert part["step_mm"] < 0.002
    np.testing.assert_allclose(kept.points, mesh.points, rtol=0, atol=0.5001 * part["step_mm"])


def test_more_vertices_than_16_bits_count_are_kept_as_well() -> None:
    mesh = ball(280)
    part = quantised(mesh)
    assert part["corner_bits"] == 32
    np.testing.assert_array_equal(decoded(part).triangles, mesh.triangles)


@pytest.mark.parametrize("side", ["right", "left"])
def test_what_moves_is_the_moving_body_and_what_goes_with_it(side: Side) -> None:
    evidence = sample_evidence(side)
    parts = viewer_data(evidence, SETTINGS)["parts"]
    bodies = {part["name"]: part["body"] for part in parts}
    assert bodies == {
        "femur": "reference",
        "femoral cartilage": "reference",
        "tibia": "moving",
        "medial meniscus": "moving",
        "fibula": "moving",
    }
    assert {part["name"] for part in parts if part["bone"]} == {"femur", "tibia", "fibula"}
    for part in parts:
        name = part["name"].replace(" ", "_")
        assert part["color"] == hexadecimal(structure_color(name))
        np.testing.assert_allclose(decoded(part).points, evidence.meshes[name].points, rtol=0, atol=0.01)


def test_a_structure_that_the_program_made_says_so() -> None:
    evidence = sample_evidence()
    made = tuple(
        replace(one, origin="synthesised") if "cartilage" in one.structure else one for one in evidence.origins
    )
    parts = viewer_data(replace(evidence, origins=made), SETTINGS)["parts"]
    assert [part["name"] for part in parts if "made" in part["name"]] == ["femoral cartilage (made by the program)"]
    assert not next(part for part in parts if "made" in part["name"])["bone"]


def test_a_body_without_meshes_of_its_structures_is_shown_whole() -> None:
    evidence = replace(sample_evidence(), meshes={})
    parts = viewer_data(evidence, SETTINGS)["parts"]
    assert [(part["name"], part["body"]) for part in parts] == [
        ("reference body", "reference"),
        ("moving body", "moving"),
    ]
    assert len(decoded(parts[1]).triangles) == len(evidence.moving.triangles)


def test_many_triangles_become_few_and_stay_near_the_surface() -> None:
    evidence = sample_evidence()
    many = {"femur": merged([ball(150), ball(150)]), "tibia": ball(100)}
    parts = viewer_data(replace(evidence, meshes=many), SETTINGS)["parts"]
    counts = [len(decoded(part).triangles) for part in parts]
    assert sum(counts) <= 1.02 * figure_viewer.TRIANGLES
    assert sum(counts) > 0.9 * figure_viewer.TRIANGLES
    inner = np.linalg.norm(decoded(parts[1]).points, axis=1)
    assert np.percentile(np.abs(inner - 30.0), 90) < 0.2


def test_a_small_structure_beside_large_ones_keeps_its_shape() -> None:
    evidence = sample_evidence()
    many = {"femur": ball(200), "tibia": ball(200), "medial_meniscus": ball(20)}
    parts = {part["name"]: part for part in viewer_data(replace(evidence, meshes=many), SETTINGS)["parts"]}
    assert len(decoded(parts["medial meniscus"]).triangles) >= figure_viewer.FEWEST_TRIANGLES


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_axes_lie_where_the_frames_say(side: Side) -> None:
    evidence = sample_evidence(side)
    flexion, push = viewer_data(evidence, SETTINGS)["axes"]
    centre = (np.array(flexion["from"]) + flexion["to"]) / 2.0
    np.testing.assert_allclose(centre, evidence.scan_from_reference[:3, 3])
    np.testing.assert_allclose(push["to"], evidence.scan_from_moving[:3, 3])
    way = np.array(push["to"]) - push["from"]
    np.testing.assert_allclose(way / np.linalg.norm(way), evidence.anatomy.delta)
    assert (flexion["body"], push["body"]) == ("reference", "moving")


def test_the_data_are_json_without_surprises_and_the_same_every_time() -> None:
    for evidence in (sample_evidence(), only_one_attitude(sample_evidence("left"))):
        text = json.dumps(viewer_data(evidence, SETTINGS), allow_nan=False, sort_keys=True)
        assert text == json.dumps(viewer_data(evidence, SETTINGS), allow_nan=False, sort_keys=True)
        assert json.loads(text)["notice"] == "Research use - not for diagnosis"


def test_no_two_files_of_the_script_give_a_name_twice() -> None:
    """They share one scope, where a second `const` or `class` of a name would stop all of them."""
    names = re.findall(
        r"^(?:export )?(?:const|let|class|(?:async )?function) +([A-Za-z_$][\w$]*)", scripts()[1], re.MULTILINE
    )
    assert {"Lut", "Nearness", "Ghost", "Viewer", "listenToSignOff"} <= set(names)
    assert sorted(names) == sorted(set(names))


def test_the_policy_names_the_scripts_by_hash_and_nothing_more() -> None:
    digest = base64.b64encode(hashlib.sha256(b"one()").digest()).decode()
    policy = content_policy(["one()"])
    nothing = "default-src 'none'; base-uri 'none'; form-action 'none'"
    strict = f"{nothing}; img-src data:; style-src 'unsafe-inline'; media-src data:"
    assert policy == f"{strict}; script-src 'sha256-{digest}'"


def test_the_scripts_cannot_end_their_element_nor_make_code_from_text_nor_load() -> None:
    for text in scripts():
        assert not re.search(r"</script|<script|<!--", text, re.IGNORECASE)
        assert not re.search(r"\beval\(|new Function|import\(|XMLHttpRequest|sendBeacon|WebSocket|\bfetch\(", text)
        assert "\r" not in text
        assert "\0" not in text


def test_the_library_is_small_and_carries_its_licence() -> None:
    library = scripts()[0]
    assert len(library.encode()) <= 700_000
    assert "The MIT License" in library
    assert "Permission is hereby granted, free of charge" in library
