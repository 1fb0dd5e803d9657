"""The joint that a reader moves by sliders: the data and the scripts of the page, and the policy that lets them run.

The scripts are constant files of ``viewer/``; all that belongs to a case is JSON beside them.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Iterator
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.adapters.decimation import decimate_quadric
from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.interpolation import FOUND, found_coordinates
from pipeline.kinematics.table import LutTable, Status
from pipeline.report.evidence import Evidence
from pipeline.report.figure_bones import AXIS_SHARE, DELTA_SHARE, half_height_mm
from pipeline.report.figure_frame import RESEARCH_USE, heading
from pipeline.report.palette import AXIS, BONE, DELTA, MOVING, Color, hexadecimal, scale, structure_color
from pipeline.report.settings import PictureSettings
from pipeline.report.templates import resource
from pipeline.suggestions import plain

Float = NDArray[np.float64]

#: What is put into the page, in the order in which it runs: two scripts, the second of several files.
LIBRARY = "viewer/three.min.js"
MODULE = ("viewer/player.js", "viewer/contact.js", "viewer/sign_off.js", "viewer/ghost.js", "viewer/viewer.js")
#: All that is put into the page from here; a change of one makes the page anew.
VIEWER_FILES = (LIBRARY, *MODULE, "viewer.html.j2", "sign_off.html.j2", "reader.css")
#: Triangles of all meshes together.
TRIANGLES = 24_000
#: Fewest of one mesh: a meniscus beside large bones stays a meniscus.
FEWEST_TRIANGLES = 500
#: Structures that are drawn in full when bones are transparent.
SOFT = ("cartilage", "meniscus")
LARGEST_STEP = 2**16 - 1
#: Colours of the scale of contact.
SHADES = 33


@cache
def scripts() -> tuple[str, str]:
    """Texts of the two scripts of the page: the library, and the module that uses it."""
    return resource(LIBRARY), "".join(resource(name) for name in MODULE)


def content_policy(allowed: Iterable[str]) -> str:
    """Content security policy of a page that loads nothing and runs exactly the scripts of these texts."""
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in allowed]
    sources = " ".join(f"'sha256-{one}'" for one in hashes)
    nothing = "default-src 'none'; base-uri 'none'; form-action 'none'"
    return f"{nothing}; img-src data:; style-src 'unsafe-inline'; media-src data:; script-src {sources}"


def viewer_data(evidence: Evidence, settings: PictureSettings) -> dict[str, Any]:
    """What ``viewer/viewer.js`` reads; plain JSON values, lengths in mm, points in scan space."""
    reference = evidence.scan_from_reference
    return {
        "heading": heading(evidence.facts),
        "joint": evidence.facts.joint,
        "notice": RESEARCH_USE,
        "lut": player_data(_table(evidence)),
        "status_words": [status.words for status in Status],
        "usable": [int(status) for status in Status if status.usable],
        "parts": _parts(evidence, settings),
        "contact": {"range_mm": settings.contact_range_mm, "colors": contact_colors()},
        "axes": _axes(evidence, half_height_mm(evidence, settings)),
        "focus": reference[:3, 3].tolist(),
        "half_height_mm": half_height_mm(evidence, settings),
    }


def contact_colors() -> list[str]:
    """The colours of contact, from none of the range to all of it."""
    return [hexadecimal((red, green, blue)) for red, green, blue in scale(np.linspace(0.0, 1.0, SHADES)).tolist()]


def _table(evidence: Evidence) -> LutTable:
    smooth = evidence.smooth
    return LutTable(
        evidence.facts.side, smooth.grid, smooth.poses, evidence.scan_from_reference, evidence.scan_from_moving
    )


def player_data(table: LutTable) -> dict[str, Any]:
    """The table as ``viewer/player.js`` takes it: names and units of ``lut.h5``, None where an entry is not usable."""
    found = found_coordinates(table.poses)
    known = found.astype(object)
    known[np.isnan(found)] = None
    return {
        "side": table.side,
        "flexion_deg": table.grid.flexion_deg.tolist(),
        "varus_deg": table.grid.varus_deg.tolist(),
        "status": table.poses.status.tolist(),
        "scan_from_reference": table.scan_from_reference.tolist(),
        "scan_from_moving": table.scan_from_moving.tolist(),
        **{name: known[..., index].tolist() for index, name in enumerate(FOUND)},
    }


def _parts(evidence: Evidence, settings: PictureSettings) -> list[dict[str, Any]]:
    """The structures of both bodies and what goes with the moving one, fewer triangles of each."""
    chosen = list(_structures(evidence, settings))
    total = sum(len(mesh.triangles) for _, _, _, mesh in chosen)
    made = {origin.structure for origin in evidence.origins if origin.origin == "synthesised"}
    parts = []
    for name, body, color, mesh in chosen:
        share = max(FEWEST_TRIANGLES, TRIANGLES * len(mesh.triangles) // total)
        smaller = mesh if len(mesh.triangles) <= share else decimate_quadric(mesh, share)
        looks = {"body": body, "color": hexadecimal(color), "bone": not name.endswith(SOFT)}
        words = f"{plain(name)} (made by the program)" if name in made else plain(name)
        parts.append({"name": words, **looks, **quantised(smaller)})
    return parts


def _structures(evidence: Evidence, settings: PictureSettings) -> Iterator[tuple[str, str, Color, TriangleMesh]]:
    """Name, body, colour and mesh of what is shown; a body whole where its structures have no meshes."""
    for body, mesh, color in (("reference", evidence.reference, BONE), ("moving", evidence.moving, MOVING)):
        names = [o.structure for o in evidence.origins if o.body == body and o.structure in evidence.meshes]
        for name in names:
            yield name, body, structure_color(name), evidence.meshes[name]
        if not names:
            yield f"{body}_body", body, color, mesh
    for name in settings.carried:
        if name in evidence.meshes:
            yield name, "moving", structure_color(name), evidence.meshes[name]


def quantised(mesh: TriangleMesh) -> dict[str, Any]:
    """A mesh as base64 of little-endian numbers: points as 16-bit steps from ``low``, corners of 16 or 32 bits."""
    low = mesh.points.min(axis=0)
    step = float(np.ptp(mesh.points, axis=0).max()) / LARGEST_STEP
    bits = 16 if len(mesh.points) <= LARGEST_STEP + 1 else 32
    return {
        "low": low.tolist(),
        "step_mm": step,
        "points": _base64(np.rint((mesh.points - low) / step).astype("<u2")),
        "corner_bits": bits,
        "corners": _base64(mesh.triangles.astype(f"<u{bits // 8}")),
    }


def _base64(numbers: NDArray[np.generic]) -> str:
    return base64.b64encode(numbers.tobytes()).decode()


def _axes(evidence: Evidence, half_mm: float) -> list[dict[str, Any]]:
    """The flexion axis, and the push that moves with the moving body; as long as in the picture of the bones."""
    reference, moving = evidence.scan_from_reference, evidence.scan_from_moving
    flexion = reference[:3, 3] + np.outer([-1.0, 1.0], AXIS_SHARE * half_mm * reference[:3, 0])
    push = moving[:3, 3] + np.outer([-1.0, 0.0], DELTA_SHARE * half_mm * moving[:3, 2])
    return [
        _axis("flexion axis", "reference", AXIS, flexion) | {"arrow": False},
        _axis("Δ push", "moving", DELTA, push) | {"arrow": True},
    ]


def _axis(words: str, body: str, color: Color, ends: Float) -> dict[str, Any]:
    """A line (2, 3); an arrow points to its second end and has its words at the first."""
    return {
        "words": words,
        "body": body,
        "color": hexadecimal(color),
        "from": ends[0].tolist(),
        "to": ends[1].tolist(),
    }
