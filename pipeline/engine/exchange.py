"""What a running stage is given and what it hands back: the engine's side of ``Inputs`` and ``Outputs``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar, cast

from pipeline.engine.artifacts import SOURCE, Artifact, Files, SourceFolder
from pipeline.engine.manifest import InputRecord, Manifest
from pipeline.engine.source import source_hash
from pipeline.engine.stage import Stage
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import fingerprint, read_file
from pipeline.engine.wiring import written_by
from pipeline.errors import EnvironmentFault

T = TypeVar("T")


@dataclass
class Shelf:
    """The results of a case that are good for this run.

    Attributes
    ----------
    root : Path
        Folder of the case's results.
    source : SourceFolder
    records : dict of str to InputRecord
        Artifact name -> its content and schema.
    manifests : dict of str to (Path, Manifest)
        Artifact name -> folder and manifest of the stage that wrote it.
    """

    root: Path
    source: SourceFolder
    records: dict[str, InputRecord] = field(init=False)
    manifests: dict[str, tuple[Path, Manifest]] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.records = {SOURCE.name: InputRecord(source_hash(self.source.files), SOURCE.schema)}

    def add(self, stage: Stage, manifest: Manifest) -> None:
        """Make the artifacts of a finished stage available."""
        for artifact in written_by(stage):
            self.records[artifact.name] = InputRecord(manifest.content_hash(artifact), artifact.schema)
            self.manifests[artifact.name] = (self.root / stage.folder, manifest)

    def load(self, artifact: Artifact[T]) -> T:
        """Decode an artifact from disk, its bytes checked against the manifest.

        Raises
        ------
        EnvironmentFault
            When a file cannot be read or was altered since this run checked it.
        """
        folder, manifest = self.manifests[artifact.name]
        return artifact.decode(
            {relative: _verified(folder, name, manifest) for name, relative in manifest.files_of(artifact).items()}
        )


@dataclass(frozen=True)
class WatchedFolder(SourceFolder):
    """A case folder that tells which file is read next, so that it can be named if that ends badly."""

    opened: Callable[[str], None]

    def read(self, name: str) -> bytes:
        """Bytes of one listed file; raises what ``SourceFolder.read`` raises."""
        self.opened(name)
        return super().read(name)


@dataclass(frozen=True)
class StageInputs:
    """``reads[ARTIFACT]`` for one stage; ``opened`` is told each file of the case folder that is read."""

    stage: Stage
    shelf: Shelf
    opened: Callable[[str], None] = lambda _: None

    def __getitem__(self, artifact: Artifact[T]) -> T:
        """The decoded value of a declared artifact.

        Raises
        ------
        KeyError
            For an artifact that the stage does not declare in ``reads``.
        EnvironmentFault
            When it cannot be read back as it was written.
        """
        if artifact.name not in {declared.name for declared in self.stage.reads}:
            raise KeyError(f"stage {self.stage.name} does not declare {artifact.name} in reads")
        if artifact.name == SOURCE.name:
            source = self.shelf.source
            return cast("T", WatchedFolder(source.case_id, source.root, source.files, self.opened))
        return self.shelf.load(artifact)


@dataclass(frozen=True)
class StageOutputs:
    """``out[ARTIFACT] = value`` for one stage; values are encoded at once and held until the stage is done."""

    stage: Stage
    jobs: int
    report: Callable[[int, int], None]
    held: dict[str, Files] = field(default_factory=dict)
    parts: dict[str, float] = field(default_factory=dict)

    def __setitem__(self, artifact: Artifact[T], value: T) -> None:
        """Encode a declared artifact.

        Raises
        ------
        KeyError
            For an artifact that the stage does not declare in ``writes``.
        """
        if artifact.name not in {declared.name for declared in self.stage.writes}:
            raise KeyError(f"stage {self.stage.name} does not declare {artifact.name} in writes")
        self.held[artifact.name] = artifact.encode(value)

    def progress(self, done: int, total: int) -> None:
        """Tell the user how far the stage is."""
        self.report(done, total)

    def took(self, part: str, seconds: float) -> None:
        """Note how long a part of the stage took; the same part again adds to it."""
        self.parts[part] = round(self.parts.get(part, 0.0) + seconds, 3)

    def complete(self) -> Mapping[str, Files]:
        """Everything the stage wrote.

        Raises
        ------
        RuntimeError
            When it did not write all it declares.
        """
        missing = [artifact.name for artifact in self.stage.writes if artifact.name not in self.held]
        if missing:
            raise RuntimeError(f"stage {self.stage.name} did not write {', '.join(missing)}")
        return self.held


def _verified(folder: Path, name: str, manifest: Manifest) -> bytes:
    shown = f"{folder.name}/{name}"
    with storage(f"Reading {shown}"):
        data = read_file(folder / name)
    if fingerprint(data).sha256 != manifest.outputs[name].sha256:
        raise EnvironmentFault(
            "E-ENV-05",
            f"{shown} was altered on disk while the case was running.",
            "Make sure that no other program writes to the results folder, then run again.",
        )
    return data
