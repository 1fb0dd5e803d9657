"""Which stage writes what: the flow as a graph, checked once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from itertools import pairwise
from pathlib import PurePosixPath
from typing import Any

from pipeline.engine.artifacts import SOURCE, Artifact, Files
from pipeline.engine.stage import Findings, Stage, findings_of, settings_of

MANIFEST_FILE = "stage.json"


@cache
def findings_artifact(stage: str) -> Artifact[Findings]:
    """The findings of a stage; made once because building its codec is slow."""
    return findings_of(stage)


@cache
def settings_artifact(stage: str) -> Artifact[dict[str, Any]]:
    """The settings of a stage; made once, like the findings."""
    return settings_of(stage)


def written_by(stage: Stage) -> tuple[Artifact[Any], ...]:
    """All that a stage leaves: its artifacts, its findings and its settings."""
    return (*stage.writes, findings_artifact(stage.name), settings_artifact(stage.name))


def check_flow(flow: Sequence[Stage]) -> None:
    """Refuse a flow that cannot run.

    Raises
    ------
    ValueError
        When numbers do not increase, a name or artifact has two owners, or something is read before it is written.
    """
    if any(one.number >= two.number for one, two in pairwise(flow)):
        raise ValueError("stage numbers must increase along the flow")
    known = {SOURCE.name}
    for stage in flow:
        missing = [artifact.name for artifact in stage.reads if artifact.name not in known]
        if missing:
            raise ValueError(f"stage {stage.name} reads {', '.join(missing)}, which no earlier stage writes")
        for artifact in written_by(stage):
            if artifact.name in known:
                raise ValueError(f"{artifact.name} is written twice, the second time by stage {stage.name}")
            known.add(artifact.name)


def writers_of(flow: Sequence[Stage]) -> Mapping[str, Stage]:
    """Artifact name -> the stage that writes it."""
    return {artifact.name: stage for stage in flow for artifact in written_by(stage)}


def file_name(artifact: Artifact[Any], relative: str) -> str:
    """Name inside the stage's folder of one file of an artifact.

    Parameters
    ----------
    relative : str
        Name inside a folder artifact; empty for an artifact that is one file.

    Raises
    ------
    ValueError
        For a name that is not plain, would leave the folder or would be taken for one of the engine's own files.
    """
    name = artifact.file.removeprefix("./") + relative if artifact.is_folder else artifact.file
    path = PurePosixPath(name)
    plain = not path.is_absolute() and path.as_posix() == name and "\\" not in name
    if not plain or any(part.startswith(".") or not part.isprintable() for part in path.parts):
        raise ValueError(f"artifact {artifact.name} cannot have a file named {name!r}")
    if name == MANIFEST_FILE:
        raise ValueError(f"{MANIFEST_FILE} is the engine's own file, artifact {artifact.name} cannot use it")
    return name


def stage_files(stage: Stage, held: Mapping[str, Files]) -> dict[str, tuple[str, bytes]]:
    """Lay out what a stage wrote.

    Parameters
    ----------
    held : mapping of str to Files
        Artifact name -> its encoded files.

    Returns
    -------
    dict
        File name inside the stage's folder -> (artifact name, content).

    Raises
    ------
    ValueError
        When two artifacts use one file name.
    """
    files: dict[str, tuple[str, bytes]] = {}
    for artifact in written_by(stage):
        for relative, data in sorted(held[artifact.name].items()):
            name = file_name(artifact, relative)
            if name in files:
                raise ValueError(f"stage {stage.name} writes {name} twice")
            files[name] = (artifact.name, data)
    return files
