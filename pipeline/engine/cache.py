"""When is a result on disk the result of this run, and if not, why not: in plain words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.engine.artifacts import SOURCE
from pipeline.engine.code_digest import Code, code_of, package_versions
from pipeline.engine.manifest import InputRecord, Manifest, Recipe, Unusable, load_manifest
from pipeline.engine.records import canonical_json
from pipeline.engine.stage import Stage, StrictParams
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import Fingerprint, fingerprint_on_disk
from pipeline.engine.wiring import written_by

UP_TO_DATE = "up to date"


@dataclass(frozen=True)
class Lookup:
    """What a run would make, and what was found in the stage's folder.

    Attributes
    ----------
    recipe : Recipe
        All that decides the result now.
    sources : dict of str to str
        Hashes of the source files behind the recipe's code.
    manifest : Manifest or None
        Of a result proven to be the one this run would make.
    reason : str
        Why it must be made (the first reason), or ``up to date``.
    damaged : bool
        Whether what is there is not what was once written there.
    """

    recipe: Recipe
    sources: dict[str, str]
    manifest: Manifest | None
    reason: str
    damaged: bool = False


def look_up(folder: Path, stage: Stage, params: StrictParams, inputs: Mapping[str, InputRecord]) -> Lookup:
    """Compare a stage's folder with what a run would make; reads every recorded output.

    Parameters
    ----------
    folder : Path
    stage : Stage
    params : StrictParams
    inputs : mapping of str to InputRecord
        Artifact name -> its content now. For a read artifact that is not there (it is not known yet) the one that
        the result on disk was made from is assumed.

    Raises
    ------
    EnvironmentFault
        When the folder cannot be read.
    """
    with storage(f"Reading {folder.name}"):
        found = load_manifest(folder)
    code = code_of(stage, None if isinstance(found, Unusable) else Code(found.recipe.code, found.sources))
    recipe = _recipe(stage, params, {**_assumed(stage, found), **inputs}, code)
    if isinstance(found, Unusable):
        return Lookup(recipe, code.sources, None, found.reason, found.damaged)
    difference = _difference(found, recipe)
    if difference is not None:
        return Lookup(recipe, code.sources, None, difference)
    with storage(f"Reading {folder.name}"):
        altered = next(altered_outputs(folder, found), None)
    if altered is not None:
        return Lookup(recipe, code.sources, None, altered, damaged=True)
    return Lookup(recipe, code.sources, found, UP_TO_DATE)


def altered_outputs(folder: Path, manifest: Manifest) -> Iterator[str]:
    """One sentence for each recorded output that is not on disk as it was written.

    Raises
    ------
    OSError
        When a file is there and cannot be read.
    """
    for name, record in sorted(manifest.outputs.items()):
        found = fingerprint_on_disk(folder / name)
        if found is None:
            yield f"output {name} missing on disk"
        elif found != Fingerprint(record.sha256, record.size):
            yield f"output {name} altered on disk"


def _assumed(stage: Stage, found: Manifest | Unusable) -> dict[str, InputRecord]:
    recorded = {} if isinstance(found, Unusable) else found.recipe.inputs
    hashes = {name: record.sha256 for name, record in recorded.items()}
    return {one.name: InputRecord(hashes.get(one.name, ""), one.schema) for one in stage.reads}


def _recipe(stage: Stage, params: StrictParams, inputs: Mapping[str, InputRecord], code: Code) -> Recipe:
    return Recipe(
        stage=stage.name,
        settings=params.model_dump(mode="json"),
        inputs={artifact.name: inputs[artifact.name] for artifact in stage.reads},
        code=code.meaning,
        schemas={artifact.name: artifact.schema for artifact in written_by(stage)},
        versions=package_versions(),
    )


def _difference(found: Manifest, recipe: Recipe) -> str | None:
    unexplained = None if found.key == recipe.key else "result of an older format"
    return next(_differences(found.recipe, recipe), unexplained)


def _differences(old: Recipe, new: Recipe) -> Iterator[str]:
    if old.stage != new.stage:
        yield f"result of another stage, {old.stage}"
    if old.schemas != new.schemas or _other_schema(old.inputs, new.inputs):
        yield "result of an older format"
    yield from (f"input {_plain(name)} changed" for name in _changed(old.inputs, new.inputs))
    yield from _changed_settings(old.settings, new.settings)
    yield from (f"code changed ({name})" for name in _changed(old.code, new.code))
    for name in _changed(old.versions, new.versions):
        kind = "" if name == "Python" else "package "
        yield f"{kind}{name} {old.versions.get(name, 'absent')} -> {new.versions.get(name, 'absent')}"


def _other_schema(old: Mapping[str, InputRecord], new: Mapping[str, InputRecord]) -> bool:
    return any(old[name].schema != new[name].schema for name in {*old} & {*new})


def _plain(artifact: str) -> str:
    return "case folder" if artifact == SOURCE.name else artifact


def _changed(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    return sorted(name for name in {*old, *new} if old.get(name) != new.get(name))


def _changed_settings(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    before, after = dict(_leaves(old)), dict(_leaves(new))
    for name in _changed(before, after):
        yield f"setting {name} {before.get(name, 'absent')} -> {after.get(name, 'absent')}"


def _leaves(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for name, value in settings.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", _one_line(value)


def _one_line(value: Any) -> str:
    return " ".join(canonical_json(value).decode().split())
