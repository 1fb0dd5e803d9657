"""What is known of a finished stage: ``stage.json``, the last file of its folder."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from pipeline.engine.artifacts import Artifact
from pipeline.engine.records import canonical_json
from pipeline.engine.stage import Findings
from pipeline.engine.store import NOT_A_FILE, read_file
from pipeline.engine.wiring import MANIFEST_FILE

#: Raised whenever the layout of stage.json or of a results folder changes; other layouts are recomputed.
FORMAT = 1


@dataclass(frozen=True)
class InputRecord:
    """An artifact as it was read: hash of its content, and its schema."""

    sha256: str
    schema: int


@dataclass(frozen=True)
class OutputRecord:
    """A file as it was written, and the artifact it belongs to."""

    artifact: str
    sha256: str
    size: int


@dataclass(frozen=True)
class Recipe:
    """All that decides the bytes of a stage's result.

    Attributes
    ----------
    stage : str
    settings : dict
        The stage's own settings, JSON.
    inputs : dict of str to InputRecord
        Artifact name -> what was read.
    code : dict of str to str
        Module or resource -> digest of its meaning.
    schemas : dict of str to int
        Artifact it writes -> schema.
    versions : dict of str to str
        Numeric package -> version.
    """

    stage: str
    settings: dict[str, Any]
    inputs: dict[str, InputRecord]
    code: dict[str, str]
    schemas: dict[str, int]
    versions: dict[str, str]

    @property
    def key(self) -> str:
        """SHA-256 over all of it."""
        return sha256_of_json(_recipe_adapter().dump_python(self, mode="json"))


@dataclass(frozen=True)
class Manifest:
    """The record of a finished stage.

    Attributes
    ----------
    key : str
        Key of the recipe.
    recipe : Recipe
    outputs : dict of str to OutputRecord
        File name inside the stage's folder -> what was written; stage.json itself is not listed.
    findings : tuple of Finding
    seconds : float
        Wall time of the stage.
    parts : dict of str to float
        What of it the stage told by itself, in words -> seconds.
    sources : dict of str to str
        Module or resource -> SHA-256 of its bytes; decides nothing, saves parsing them again.
    """

    key: str
    recipe: Recipe
    outputs: dict[str, OutputRecord]
    findings: Findings
    seconds: float
    sources: dict[str, str]
    parts: dict[str, float] = field(default_factory=dict)

    def files_of(self, artifact: Artifact[Any]) -> dict[str, str]:
        """File name inside the stage's folder -> name relative to the artifact, in sorted order."""
        names = sorted(name for name, record in self.outputs.items() if record.artifact == artifact.name)
        prefix = artifact.file.removeprefix("./") if artifact.is_folder else artifact.file
        return {name: name.removeprefix(prefix) for name in names}

    def content_hash(self, artifact: Artifact[Any]) -> str:
        """SHA-256 of a single-file artifact, or of the list of names and hashes of a folder."""
        hashes = {relative: self.outputs[name].sha256 for name, relative in self.files_of(artifact).items()}
        return hash_of_files(hashes) if artifact.is_folder else hashes[""]


@dataclass(frozen=True)
class Unusable:
    """Why there is no manifest to rely on; ``damaged`` when there is one that is not as it was written."""

    reason: str
    damaged: bool = False


_DAMAGED = Unusable(f"record {MANIFEST_FILE} altered on disk", damaged=True)


@cache
def _recipe_adapter() -> TypeAdapter[Recipe]:
    return TypeAdapter(Recipe)


@cache
def _manifest_adapter() -> TypeAdapter[Manifest]:
    return TypeAdapter(Manifest)


def sha256_of_json(value: Any) -> str:
    """SHA-256 of the canonical JSON of a value."""
    return hashlib.sha256(canonical_json(value)).hexdigest()


def hash_of_files(hashes: Mapping[str, str]) -> str:
    """SHA-256 of a set of files given as name -> SHA-256."""
    return sha256_of_json(sorted(hashes.items()))


def encode_manifest(manifest: Manifest) -> bytes:
    """Canonical JSON that carries its own hash."""
    body = {"format": FORMAT, **_manifest_adapter().dump_python(manifest, mode="json")}
    return canonical_json({**body, "sha256": sha256_of_json(body)})


def decode_manifest(data: bytes) -> Manifest | Unusable:
    """The manifest, or why it cannot be used."""
    try:
        body = json.loads(data)
        recorded = body.pop("sha256")
        if recorded != sha256_of_json(body):
            return _DAMAGED
        layout = body.pop("format")
        if layout != FORMAT:
            return Unusable(f"result of {'an older' if layout < FORMAT else 'a newer'} format")
        return _manifest_adapter().validate_python(body)
    except (ValidationError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return _DAMAGED


def load_manifest(folder: Path) -> Manifest | Unusable:
    """Read the manifest of a stage's folder.

    Raises
    ------
    OSError
        When it is there and cannot be read.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        return Unusable(f"{folder.name} is not a folder", damaged=True)
    try:
        return decode_manifest(read_file(folder / MANIFEST_FILE))
    except FileNotFoundError:
        return Unusable("no result yet")
    except OSError as error:
        if error.errno in NOT_A_FILE:
            return _DAMAGED
        raise
