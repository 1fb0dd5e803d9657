"""Binary glTF: the container, what a reader gets back, what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.files.glb_file import GlbClip, GlbNode, GlbScene, encode_glb
from pipeline.geometry.mesh import TriangleMesh, volume_mm3
from tests.exports.readers import Glb
from tests.files.lut_sample import box

HALF_TURN = np.array([[0.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 1.0] / np.sqrt(2.0)])
BOX = box((0.1, 0.2, 0.3), (0.0, 0.0, 0.5))


def clip(node: str = "moving") -> GlbClip:
    return GlbClip(
        "bend", node, np.array([0.0, 2.0]), np.array([[0.0, 0, 0], [0.1, 0, 0]]), HALF_TURN, {"varus_deg": 1}
    )


def scene(*clips: GlbClip, second: str = "moving") -> GlbScene:
    parts = (GlbNode("fixed", BOX, (255, 0, 128)), GlbNode(second, BOX, children=(GlbNode("carried", BOX),)))
    return GlbScene(GlbNode("knee_R", children=parts), clips, "ct2lut 0.0.0", {"side": "right"})


def test_the_tree_and_its_facts() -> None:
    document = Glb(encode_glb(scene(clip()))).document
    assert [(node["name"], node.get("children", [])) for node in document["nodes"]] == [
        ("knee_R", [1, 2]),
        ("fixed", []),
        ("moving", [3]),
        ("carried", []),
    ]
    assert document["scenes"] == [{"name": "knee_R", "nodes": [0], "extras": {"side": "right"}}]
    assert document["asset"] == {"version": "2.0", "generator": "ct2lut 0.0.0"}


def test_nodes_move_by_translation_and_rotation_alone() -> None:
    glb = Glb(encode_glb(scene(clip())))
    assert not [node for node in glb.document["nodes"] if {"matrix", "scale"} & node.keys()]
    paths = [(one["target"]["node"], one["target"]["path"]) for one in glb.clip("bend")["channels"]]
    assert paths == [(2, "translation"), (2, "rotation")]
    assert glb.clip("bend")["extras"] == {"varus_deg": 1}


def test_a_mesh_comes_back_with_outward_unit_normals() -> None:
    points, triangles, normals = Glb(encode_glb(scene())).mesh("carried")
    np.testing.assert_allclose(points, BOX.points, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(triangles, BOX.triangles)
    assert volume_mm3(TriangleMesh(points, triangles.astype(np.int32))) == pytest.approx(0.2 * 0.4 * 0.6)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=0, atol=1e-6)
    assert (np.einsum("ij,ij->i", normals, points - [0.0, 0.0, 0.5]) > 0.0).all()


def test_a_vertex_without_a_normal_gets_a_unit_one() -> None:
    folded = TriangleMesh(BOX.points[:3], np.array([[0, 1, 2], [0, 2, 1]], dtype=np.int32))
    _, _, normals = Glb(encode_glb(GlbScene(GlbNode("fold", folded), (), "x", {}))).mesh("fold")
    np.testing.assert_array_equal(np.linalg.norm(normals, axis=1), 1.0)


def test_vertices_of_no_triangle_are_left_out() -> None:
    loose = TriangleMesh(np.vstack([BOX.points, [[9.0, 9.0, 9.0]]]), BOX.triangles)
    points, _, _ = Glb(encode_glb(GlbScene(GlbNode("box", loose), (), "x", {}))).mesh("box")
    assert len(points) == len(BOX.points)


@pytest.mark.parametrize(("side", "kind"), [(255, 5123), (256, 5125)])
def test_indices_are_as_wide_as_they_must_be(side: int, kind: int) -> None:
    i, j = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    points = np.stack([i, j, np.zeros_like(i)], axis=-1).reshape(-1, 3).astype(float)
    low = (i * side + j)[:-1, :-1].ravel()
    triangles = np.concatenate(
        [np.stack([low, low + side, low + 1], 1), np.stack([low + 1, low + side, low + side + 1], 1)]
    )
    glb = Glb(encode_glb(GlbScene(GlbNode("plane", TriangleMesh(points, triangles.astype(np.int32))), (), "x", {})))
    accessor = glb.document["accessors"][glb.document["meshes"][0]["primitives"][0]["indices"]]
    assert accessor["componentType"] == kind
    np.testing.assert_array_equal(glb.mesh("plane")[1], triangles)


def test_a_clip_is_slerped() -> None:
    pose = Glb(encode_glb(scene(clip()))).pose("bend", 1.0)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(pose[:3, :3], [[half, 0, half], [0, 1, 0], [-half, 0, half]], rtol=0, atol=1e-7)
    np.testing.assert_allclose(pose[:3, 3], [0.05, 0.0, 0.0], rtol=0, atol=1e-8)


def test_colours_are_linear() -> None:
    factors = [one["pbrMetallicRoughness"] for one in Glb(encode_glb(scene())).document["materials"]]
    assert factors[0]["baseColorFactor"] == [1.0, 0.0, pytest.approx(0.2158605, abs=1e-6), 1.0]


def test_a_scene_without_clips_has_no_empty_list() -> None:
    assert "animations" not in Glb(encode_glb(scene())).document


def test_two_nodes_of_one_name_are_refused() -> None:
    with pytest.raises(ValueError, match="two nodes of a scene have one name"):
        encode_glb(scene(second="fixed"))


def test_a_clip_of_no_node_is_refused() -> None:
    with pytest.raises(ValueError, match="clip bend moves shin, which is no node"):
        encode_glb(scene(clip("shin")))


def test_the_same_scene_gives_the_same_bytes() -> None:
    assert encode_glb(scene(clip())) == encode_glb(scene(clip()))
