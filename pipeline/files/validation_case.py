"""The paper's two test objects as case folders, to be run like any patient."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pipeline.files.meshes import encode_ply
from pipeline.geometry.validation_objects import BallInDish, BarOnPyramids, ValidationPair

ValidationKind = Literal["ball_dish", "bar_pyramids"]


def validation_pair(kind: ValidationKind) -> ValidationPair:
    """The bodies of a test object, as its joint file describes them.

    Raises
    ------
    ValueError
        For a kind that is not known.
    """
    if kind == "ball_dish":
        return BallInDish().pair()
    if kind == "bar_pyramids":
        return BarOnPyramids().pair()
    raise ValueError(f"a test object is ball_dish or bar_pyramids, got {kind!r}")


def write_validation_case(folder: Path, kind: ValidationKind) -> None:
    """Write the case folder of a test object: ``meshes/<structure>.ply`` and ``case.yaml``; equal bytes every time.

    Parameters
    ----------
    folder : Path
        The case folder; made where it does not exist.
    kind : "ball_dish" or "bar_pyramids"
        Also the name of the joint file that says what the structures are.
    """
    pair = validation_pair(kind)
    meshes = folder / "meshes"
    meshes.mkdir(parents=True, exist_ok=True)
    for structure, mesh in {**pair.reference, **pair.moving}.items():
        (meshes / f"{structure}.ply").write_bytes(encode_ply(mesh))
    (folder / "case.yaml").write_text(f"side: right\njoint: {kind}\n", encoding="utf-8")
