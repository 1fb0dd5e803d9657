"""Binary glTF 2.0 (``.glb``): meshes of one colour each and animations of nodes; equal scenes give equal bytes."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mesh import TriangleMesh, compacted, vertex_normals

Float = NDArray[np.float64]

_FLOAT, _SHORT_INDEX, _LONG_INDEX = 5126, 5123, 5125
_VERTICES, _INDICES = 34962, 34963
_SIZES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_JSON_CHUNK, _BINARY_CHUNK = b"JSON", b"BIN\0"
#: The largest index of 16 bits is reserved.
_MAX_SHORT_VERTICES = 65535


@dataclass(frozen=True, eq=False)
class GlbNode:
    """A node of the scene, at rest without a transform of its own.

    Attributes
    ----------
    name : str
        Unique in the scene.
    mesh : TriangleMesh or None
        Metres, Y up.
    color : three of 0..255
        sRGB.
    children : tuple of GlbNode
    """

    name: str
    mesh: TriangleMesh | None = None
    color: tuple[int, int, int] = (255, 255, 255)
    children: tuple[GlbNode, ...] = ()


@dataclass(frozen=True, eq=False)
class GlbClip:
    """An animation of one node, linear between its K keyframes (slerp for the rotation).

    Attributes
    ----------
    name, node : str
    times_s : (K,) float64
        Increasing, from 0 up.
    translations_m : (K, 3) float64
    quaternions : (K, 4) float64
        x, y, z, w of unit length; neighbours on one side of the sphere.
    extras : mapping
        JSON-compatible facts.
    """

    name: str
    node: str
    times_s: Float
    translations_m: Float
    quaternions: Float
    extras: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class GlbScene:
    """What a file holds: one tree of nodes, its clips, the program that made it, and facts of the scene as a whole."""

    root: GlbNode
    clips: tuple[GlbClip, ...]
    generator: str
    extras: Mapping[str, Any]


@dataclass
class _Buffer:
    """The binary chunk as it grows, and the views and accessors that lead into it."""

    data: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)

    def add(self, array: NDArray[Any], kind: int, target: int | None = None, *, bounds: bool = False) -> int:
        """Number of the accessor of an array (N,) or (N, K), every view on a border of four bytes."""
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.views.append(view if target is None else {**view, "target": target})
        self.data += array.tobytes() + bytes(-array.nbytes % 4)
        columns = array.reshape(len(array), -1)
        accessor = {
            "bufferView": len(self.views) - 1,
            "componentType": kind,
            "count": len(array),
            "type": _SIZES[columns.shape[1]],
        }
        if bounds:
            accessor |= {"min": columns.min(axis=0).tolist(), "max": columns.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def floats(self, array: Float, target: int | None = None, *, bounds: bool = False) -> int:
        return self.add(array.astype("<f4"), _FLOAT, target, bounds=bounds)


def encode_glb(scene: GlbScene) -> bytes:
    """One self-contained ``.glb``.

    Raises
    ------
    ValueError
        When two nodes have one name, or a clip moves a node that is not there.
    """
    nodes = list(_walk(scene.root))
    places = {node.name: place for place, node in enumerate(nodes)}
    if len(places) < len(nodes):
        raise ValueError("two nodes of a scene have one name")
    buffer = _Buffer()
    drawn = [(node, node.mesh) for node in nodes if node.mesh is not None]
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": scene.generator},
        "scene": 0,
        "scenes": [{"name": scene.root.name, "nodes": [0], "extras": dict(scene.extras)}],
        "nodes": [_node(node, places, [one.name for one, _ in drawn]) for node in nodes],
        "meshes": [_mesh(node.name, mesh, number, buffer) for number, (node, mesh) in enumerate(drawn)],
        "materials": [_material(node) for node, _ in drawn],
        "animations": [_animation(clip, places, buffer) for clip in scene.clips],
        "bufferViews": buffer.views,
        "accessors": buffer.accessors,
        "buffers": [{"byteLength": len(buffer.data)}] if buffer.data else [],
    }
    # glTF allows no empty lists
    return _container({key: value for key, value in document.items() if value != []}, bytes(buffer.data))


def _walk(node: GlbNode) -> Iterator[GlbNode]:
    yield node
    for child in node.children:
        yield from _walk(child)


def _node(node: GlbNode, places: Mapping[str, int], drawn: Sequence[str]) -> dict[str, Any]:
    out: dict[str, Any] = {"name": node.name}
    if node.mesh is not None:
        out["mesh"] = drawn.index(node.name)
    if node.children:
        out["children"] = [places[child.name] for child in node.children]
    return out


def _mesh(name: str, mesh: TriangleMesh, material: int, buffer: _Buffer) -> dict[str, Any]:
    mesh = compacted(mesh)
    normals = vertex_normals(mesh)
    normals[~normals.any(axis=1)] = (0.0, 1.0, 0.0)  # a fold has none, and glTF wants unit length
    short = len(mesh.points) <= _MAX_SHORT_VERTICES
    corners = mesh.triangles.ravel().astype("<u2" if short else "<u4")
    primitive = {
        "attributes": {
            "POSITION": buffer.floats(mesh.points, _VERTICES, bounds=True),
            "NORMAL": buffer.floats(normals, _VERTICES),
        },
        "indices": buffer.add(corners, _SHORT_INDEX if short else _LONG_INDEX, _INDICES),
        "material": material,
    }
    return {"name": name, "primitives": [primitive]}


def _material(node: GlbNode) -> dict[str, Any]:
    factors = {"baseColorFactor": [*map(_linear, node.color), 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.7}
    return {"name": node.name, "pbrMetallicRoughness": factors}


def _linear(channel: int) -> float:
    """One channel of sRGB, 0..255, to the linear 0..1 of glTF's factors (IEC 61966-2-1)."""
    share = channel / 255.0
    return round(share / 12.92 if share <= 0.04045 else ((share + 0.055) / 1.055) ** 2.4, 6)


def _animation(clip: GlbClip, places: Mapping[str, int], buffer: _Buffer) -> dict[str, Any]:
    if clip.node not in places:
        raise ValueError(f"clip {clip.name} moves {clip.node}, which is no node of the scene")
    times = buffer.floats(clip.times_s, bounds=True)
    outputs = {"translation": buffer.floats(clip.translations_m), "rotation": buffer.floats(clip.quaternions)}
    return {
        "name": clip.name,
        "samplers": [{"input": times, "output": output, "interpolation": "LINEAR"} for output in outputs.values()],
        "channels": [
            {"sampler": number, "target": {"node": places[clip.node], "path": path}}
            for number, path in enumerate(outputs)
        ],
        "extras": dict(clip.extras),
    }


def _container(document: Mapping[str, Any], binary: bytes) -> bytes:
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    chunks = _chunk(_JSON_CHUNK, text + b" " * (-len(text) % 4))
    if binary:
        chunks += _chunk(_BINARY_CHUNK, binary)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack("<I4s", len(data), kind) + data
