"""``lut.json``: the table for programs without HDF5, and the JSON Schema that describes it.

Each entry is written twice: as a ready motion (quaternion and translation, metres) for who shows entries, and as the
four found coordinates for who shows what lies between them. Numbers are rounded to 1e-10; equal tables give equal
bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.files.lut_content import LutFileContent
from pipeline.files.lut_schema import BASIS, FLAGS
from pipeline.kinematics.interpolation import (
    FOUND,
    found_coordinates,
    look_up,
    motion_map,
    motions,
    moved_from_scan_table,
    pose_curves,
    usable_entries,
)
from pipeline.kinematics.table import CurveFit

Float = NDArray[np.float64]

FORMAT = "ct2lut-json"
VERSION = "1.0"
SCHEMA_FILE = "lut.schema.json"
MM_PER_M = 1000.0

_DIGITS = 10
#: Attitudes of the check poses, as shares of the flexion and of the varus axis; the first are moved to entries.
_CHECK_SHARES = ((0.0, 0.5), (0.25, 0.2), (0.5, 1.0), (0.731, 0.357), (1.0, 0.6))
_CHECKS_AT_ENTRIES = 3
#: Their points in the moving frame (mm): spread over a leg's width, so that a swapped or mirrored axis shows.
_CHECK_POINTS_MM = (
    (40.0, 20.0, 0.0),
    (-40.0, 20.0, -60.0),
    (30.0, -25.0, -30.0),
    (-35.0, -10.0, -90.0),
    (5.0, 45.0, 10.0),
)

_TEXTS = {
    "notice": "Research use - not for diagnosis",
    "space": "LPS (DICOM patient space: x to the patient's left, y posterior, z superior), as scanned; column vectors",
    "signs": "flexion +, varus +, internal rotation +; moving body lateral +, anterior +, proximal +; both sides alike",
    "motion": "point_at_attitude = rotate(quaternion, point_as_scanned) + translation; nested [flexion][varus]",
    "formula": (
        "moved_from_scan = scan_from_reference . Rx(-flexion) . Ry(varus) . T(Rz(internal_rotation), "
        "(lateral, anterior, proximal)) . inverse(scan_from_moving)"
    ),
    "between_entries": (
        "interpolate the four coordinates, cubic in flexion (not-a-knot spline over each unbroken run of usable "
        "entries of one varus), linear in varus, then apply the formula; never interpolate matrices"
    ),
    "outside": (
        "outside the axes, and where an entry around the attitude is not usable: refuse, or take the nearest covered "
        "attitude; never extrapolate"
    ),
}


def encode_lut_json(content: LutFileContent) -> bytes:
    """``lut.json`` of a table; describes itself by :data:`SCHEMA_FILE`."""
    return _json(
        {
            "$schema": SCHEMA_FILE,
            "format": FORMAT,
            "version": VERSION,
            **_TEXTS,
            "joint": content.joint,
            "side": content.side,
            "software": content.software,
            "axes": {name: _numbers(getattr(content.smooth.grid, name)) for name in ("flexion_deg", "varus_deg")},
            "status": content.smooth.poses.status.tolist(),
            "status_names": list(FLAGS),
            "usable": usable_entries(content.smooth.poses).tolist(),
            "moved_from_scan": _motions(content),
            "coordinates": _coordinates(content),
            "polynomials": _polynomials(content),
            "frames": _frames(content),
            "checks": _checks(content),
        }
    )


def encode_lut_schema() -> bytes:
    """The JSON Schema (draft 2020-12) of ``lut.json``."""
    return (json.dumps(_SCHEMA, indent=1, sort_keys=True) + "\n").encode()


def unit_quaternions(matrices: Float) -> Float:
    """(N, 4) quaternions x, y, z, w with w >= 0 of proper rotations or motions (N, 3, 3) or (N, 4, 4)."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - a cached run must not pay for it

    found: Float = Rotation.from_matrix(matrices[:, :3, :3]).as_quat(canonical=True)
    return found


def _json(value: Mapping[str, Any]) -> bytes:
    return (json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False) + "\n").encode()


def _numbers(array: Float) -> Any:
    """Nested lists of rounded numbers; null in place of NaN."""
    rounded = np.round(array, _DIGITS) + 0.0  # adding zero turns -0.0 into 0.0
    numbers = rounded.astype(object)
    numbers[np.isnan(rounded)] = None
    return numbers.tolist()


def _motions(content: LutFileContent) -> dict[str, Any]:
    motions_lps = moved_from_scan_table(content.table)
    usable = usable_entries(content.smooth.poses)
    turns = np.full((*usable.shape, 4), np.nan)
    turns[usable] = unit_quaternions(motions_lps[usable])
    return {
        "quaternion_xyzw": _entries(turns, usable),
        "translation_m": _entries(motions_lps[..., :3, 3] / MM_PER_M, usable),
    }


def _entries(values: Float, usable: NDArray[np.bool_]) -> list[list[Any]]:
    """[flexion][varus] lists of numbers; null for an entry that is not usable."""
    return [
        [numbers if shown else None for numbers, shown in zip(row, shows, strict=True)]
        for row, shows in zip(_numbers(values), usable.tolist(), strict=True)
    ]


def _coordinates(content: LutFileContent) -> dict[str, Any]:
    found = found_coordinates(content.smooth.poses)
    return {name: _numbers(found[..., index]) for index, name in enumerate(FOUND)}


def _polynomials(content: LutFileContent) -> dict[str, Any]:
    return {
        "basis": BASIS,
        "flexion_range_deg": _numbers(content.smooth.flexion_range_deg),
        "varus_range_deg": _numbers(content.smooth.varus_range_deg),
        "order": (
            "coefficients[p][q] multiplies T_p(u) T_q(v); u and v are flexion and varus with the ends of their range "
            "taken to -1 and 1"
        ),
        "curves": [_curve(fit) for fit in content.smooth.fits],
    }


def _curve(fit: CurveFit) -> dict[str, Any]:
    return {
        "name": fit.name,
        "unit": fit.unit,
        "coefficients": fit.coefficients.tolist(),
        "residual_rms": fit.residual_rms,
        "residual_max": fit.residual_max,
    }


def _frames(content: LutFileContent) -> dict[str, Any]:
    """4x4 by rows; the shift in millimetres, as in the formula."""
    return {
        "unit": "mm",
        "scan_from_reference": _numbers(content.scan_from_reference),
        "scan_from_moving": _numbers(content.scan_from_moving),
    }


def _checks(content: LutFileContent) -> list[dict[str, Any]]:
    """Points of the moving body before and after; what an importer may assert."""
    grid = content.smooth.grid
    wanted = [
        _check_values(axis, share)
        for axis, share in zip((grid.flexion_deg, grid.varus_deg), np.transpose(_CHECK_SHARES), strict=True)
    ]
    attitudes = look_up(pose_curves(grid, content.smooth.poses), wanted[0], wanted[1], "clamp")
    moved = motions(motion_map(content.scan_from_reference, content.scan_from_moving), *attitudes)
    frame = content.scan_from_moving
    before = np.round((np.array(_CHECK_POINTS_MM) @ frame[:3, :3].T + frame[:3, 3]) / MM_PER_M, 6)
    after = np.einsum("nij,nj->ni", moved[:, :3, :3], before) + moved[:, :3, 3] / MM_PER_M
    return [
        {"flexion_deg": flexion, "varus_deg": varus, "point_in_m": point, "point_out_m": out}
        for flexion, varus, point, out in zip(*map(_numbers, (*attitudes[:2], before, after)), strict=True)
    ]


def _check_values(axis: Float, shares: Float) -> Float:
    places = shares * (len(axis) - 1)
    places[:_CHECKS_AT_ENTRIES] = np.rint(places[:_CHECKS_AT_ENTRIES])
    return np.interp(places, np.arange(len(axis)), axis)


def _list(items: Mapping[str, Any], **rules: Any) -> dict[str, Any]:
    return {"type": "array", "items": items, **rules}


def _object(properties: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "required": sorted(properties), "additionalProperties": False}


def _vector(size: int, **rules: Any) -> dict[str, Any]:
    return _list({"type": "number", **rules}, minItems=size, maxItems=size)


_NUMBER = {"type": "number"}
_TEXT = {"type": "string"}
_AXIS = _list(_NUMBER, minItems=1)
_MATRIX = _list(_vector(4), minItems=4, maxItems=4)
_BY_ENTRY = {"description": "[flexion][varus]; null where the entry is not usable"}

_SCHEMA: dict[str, Any] = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "title": f"{FORMAT} {VERSION}: look-up table of the stable poses of a joint",
    **_object(
        {
            **dict.fromkeys(_TEXTS, _TEXT),
            "$schema": _TEXT,
            "format": {"const": FORMAT},
            "version": {"type": "string", "pattern": r"^1\.[0-9]+$"},
            "joint": _TEXT,
            "side": {"enum": ["right", "left"]},
            "software": _TEXT,
            "axes": _object({"flexion_deg": _AXIS, "varus_deg": _AXIS}),
            "status": _list(_list({"type": "integer", "minimum": 0, "maximum": len(FLAGS) - 1})),
            "status_names": {"const": list(FLAGS)},
            "usable": _list(_list({"type": "boolean"})),
            "moved_from_scan": _object(
                {
                    "quaternion_xyzw": _list(
                        _list({**_vector(4, minimum=-1, maximum=1), "type": ["array", "null"]}), **_BY_ENTRY
                    ),
                    "translation_m": _list(_list({**_vector(3), "type": ["array", "null"]}), **_BY_ENTRY),
                }
            ),
            "coordinates": _object({name: _list(_list({"type": ["number", "null"]}), **_BY_ENTRY) for name in FOUND}),
            "polynomials": _object(
                {
                    "basis": {"const": BASIS},
                    "flexion_range_deg": _vector(2),
                    "varus_range_deg": _vector(2),
                    "order": _TEXT,
                    "curves": _list(
                        _object(
                            {
                                "name": {"enum": list(FOUND)},
                                "unit": {"enum": ["mm", "deg"]},
                                "coefficients": _list(_AXIS, minItems=1),
                                "residual_rms": _NUMBER,
                                "residual_max": _NUMBER,
                            }
                        )
                    ),
                }
            ),
            "frames": _object({"unit": {"const": "mm"}, "scan_from_reference": _MATRIX, "scan_from_moving": _MATRIX}),
            "checks": _list(
                _object(
                    {
                        "flexion_deg": _NUMBER,
                        "varus_deg": _NUMBER,
                        "point_in_m": _vector(3),
                        "point_out_m": _vector(3),
                    }
                ),
                minItems=5,
                maxItems=5,
            ),
        }
    ),
}
