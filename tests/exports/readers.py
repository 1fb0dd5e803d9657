"""Readers of the exported formats written from their own documents, with nothing of the program in them."""

from __future__ import annotations

import json
import re
import struct
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

_TYPES = {5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


class Glb:
    """A binary glTF 2.0 file; refuses what breaks the container or the accessors."""

    def __init__(self, data: bytes) -> None:
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        (text, kind), (binary, second) = self._chunks(data)
        assert (kind, second) == (b"JSON", b"BIN\0")
        self.document: dict[str, Any] = json.loads(text)
        self.binary = binary
        assert self.document["buffers"] == [{"byteLength": len(binary)}]

    @staticmethod
    def _chunks(data: bytes) -> list[tuple[bytes, bytes]]:
        out, at = [], 12
        while at < len(data):
            length, kind = struct.unpack_from("<I4s", data, at)
            assert length % 4 == 0
            out.append((data[at + 8 : at + 8 + length], kind))
            at += 8 + length
        return out

    def array(self, number: int) -> NDArray[Any]:
        """Values of an accessor, (N, K)."""
        accessor = self.document["accessors"][number]
        view = self.document["bufferViews"][accessor["bufferView"]]
        dtype, columns = np.dtype(_TYPES[accessor["componentType"]]), _COLUMNS[accessor["type"]]
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] == accessor["count"] * columns * dtype.itemsize
        found = np.frombuffer(self.binary, dtype, accessor["count"] * columns, view["byteOffset"]).reshape(-1, columns)
        for name, measure in (("min", np.min), ("max", np.max)):
            if name in accessor:
                np.testing.assert_array_equal(accessor[name], measure(found, axis=0))
        return found

    def node(self, name: str) -> dict[str, Any]:
        (found,) = (node for node in self.document["nodes"] if node["name"] == name)
        assert isinstance(found, dict)
        return found

    def mesh(self, name: str) -> tuple[Float, NDArray[Any], Float]:
        """Points, triangles and normals of a node's mesh."""
        (primitive,) = self.document["meshes"][self.node(name)["mesh"]]["primitives"]
        points, normals = (self.array(primitive["attributes"][key]) for key in ("POSITION", "NORMAL"))
        return points.astype(float), self.array(primitive["indices"]).reshape(-1, 3), normals.astype(float)

    def clip(self, name: str) -> dict[str, Any]:
        (found,) = (clip for clip in self.document["animations"] if clip["name"] == name)
        assert isinstance(found, dict)
        return found

    def pose(self, name: str, time_s: float) -> Float:
        """(4, 4) transform of the node that a clip moves, as the standard interpolates."""
        clip, out = self.clip(name), np.eye(4)
        for channel in clip["channels"]:
            sampler = clip["samplers"][channel["sampler"]]
            times, values = (
                self.array(sampler["input"])[:, 0].astype(float),
                self.array(sampler["output"]).astype(float),
            )
            after = int(np.clip(np.searchsorted(times, time_s), 1, len(times) - 1))
            share = float(np.clip((time_s - times[after - 1]) / (times[after] - times[after - 1]), 0.0, 1.0))
            if channel["target"]["path"] == "translation":
                out[:3, 3] = (1.0 - share) * values[after - 1] + share * values[after]
            else:
                out[:3, :3] = matrix(slerp(values[after - 1], values[after], share))
        return out


def slerp(one: Float, other: Float, share: float) -> Float:
    """Appendix C of glTF 2.0, for quaternions on one side of the sphere."""
    assert one @ other > 0.0
    angle = float(np.arccos(np.clip(one @ other, -1.0, 1.0)))
    if angle < 1e-9:
        return one
    return np.asarray((np.sin((1.0 - share) * angle) * one + np.sin(share * angle) * other) / np.sin(angle))


def matrix(quaternion: Float) -> Float:
    """(3, 3) rotation of a quaternion x, y, z, w."""
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def parent_from_child(osim: bytes, values: Mapping[str, float]) -> Float:
    """(4, 4) pose of the CustomJoint's child: rotations in sequence, each in the frame the one before left; a
    translation along axes of the parent."""
    joint = ET.fromstring(osim).find(".//CustomJoint")
    assert joint is not None
    out = np.eye(4)
    for number in (1, 2, 3):
        angle, axis = _axis(joint, f"rotation{number}", values)
        out[:3, :3] = out[:3, :3] @ _about(axis, angle)
        way, axis = _axis(joint, f"translation{number}", values)
        out[:3, 3] += way * axis
    return out


def _axis(joint: ET.Element, name: str, values: Mapping[str, float]) -> tuple[float, Float]:
    axis = joint.find(f"SpatialTransform/TransformAxis[@name='{name}']")
    assert axis is not None
    arguments = [values[one] for one in str(axis.findtext("coordinates")).split()]
    function = axis.find("*[@name='function']")
    assert function is not None
    coefficients = numbers(function, "coefficients")
    if function.tag == "LinearFunction":
        return float(coefficients[0] * arguments[0] + coefficients[1]), numbers(axis, "axis")
    assert (function.tag, function.findtext("dimension")) == ("MultivariatePolynomialFunction", "2")
    order = int(str(function.findtext("order")))
    powers = [arguments[0] ** i * arguments[1] ** j for i in range(order + 1) for j in range(order + 1 - i)]
    assert len(powers) == len(coefficients)
    return float(coefficients @ powers), numbers(axis, "axis")


def numbers(element: ET.Element, tag: str) -> Float:
    """Numbers in the text of a child."""
    return np.array(str(element.findtext(tag)).split(), dtype=float)


def _about(axis: Float, angle_rad: float) -> Float:
    """Rodrigues."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle_rad) * cross + (1.0 - np.cos(angle_rad)) * cross @ cross)


_JSON_TYPES: dict[str, tuple[type, ...]] = {
    "object": (dict,),
    "array": (list,),
    "string": (str,),
    "number": (int, float),
    "integer": (int,),
    "boolean": (bool,),
    "null": (type(None),),
}


def violations(value: Any, schema: Mapping[str, Any], at: str = "$") -> list[str]:
    """What of a JSON value breaks a JSON Schema; an unknown rule is an error, so that none goes unchecked."""
    out: list[str] = []
    for rule, argument in schema.items():
        if not _RULES[rule](value, argument):
            out.append(f"{at}: {rule}")
    if isinstance(value, dict) and "properties" in schema:
        for key in value.keys() & schema["properties"].keys():
            out += violations(value[key], schema["properties"][key], f"{at}.{key}")
        if not schema.get("additionalProperties", True):
            out += [f"{at}: {key} is not known" for key in value.keys() - schema["properties"].keys()]
    if isinstance(value, list) and "items" in schema:
        for place, item in enumerate(value):
            out += violations(item, schema["items"], f"{at}[{place}]")
    return out


def _is(value: Any, kind: str) -> bool:
    return isinstance(value, _JSON_TYPES[kind]) and (kind == "boolean" or not isinstance(value, bool))


def _number(value: Any) -> bool:
    return _is(value, "number")


_RULES: dict[str, Any] = {
    "$schema": lambda value, rule: True,
    "title": lambda value, rule: True,
    "description": lambda value, rule: True,
    "properties": lambda value, rule: True,
    "items": lambda value, rule: True,
    "additionalProperties": lambda value, rule: True,
    "type": lambda value, rule: any(_is(value, kind) for kind in ([rule] if isinstance(rule, str) else rule)),
    "required": lambda value, rule: not isinstance(value, dict) or set(rule) <= set(value),
    "const": lambda value, rule: value == rule,
    "enum": lambda value, rule: value in rule,
    "pattern": lambda value, rule: not isinstance(value, str) or re.search(rule, value) is not None,
    "minItems": lambda value, rule: not isinstance(value, list) or len(value) >= rule,
    "maxItems": lambda value, rule: not isinstance(value, list) or len(value) <= rule,
    "minimum": lambda value, rule: not _number(value) or value >= rule,
    "maximum": lambda value, rule: not _number(value) or value <= rule,
}
