"""``ct2lut verify``: every case against its checksums, and what is damaged set aside so that a run makes it anew.

Nothing is mended in place and nothing is guessed: a damaged stage is renamed, and the cache does the rest.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.case_id import is_case_id
from pipeline.engine.cache import altered_outputs
from pipeline.engine.inspection import verify_case
from pipeline.engine.lock import case_lock, is_running
from pipeline.engine.manifest import Unusable, load_manifest
from pipeline.engine.outcome import load_record
from pipeline.engine.stage import Stage
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import set_aside, sweep
from pipeline.engine.wiring import MANIFEST_FILE
from pipeline.errors import ConfigError, PipelineError

RUN_FILE = "run.json"


@dataclass(frozen=True)
class Verified:
    """What was found of one case.

    Attributes
    ----------
    case_id : str
    problems : tuple of str
        One sentence each; empty where every recorded file is as it was written.
    running : bool
        Whether a run was at work: its results were not compared, for they change.
    """

    case_id: str
    problems: tuple[str, ...]
    running: bool = False


def verify_all(results: Path, flow: Sequence[Stage]) -> Iterator[Verified]:
    """Compare every case of a results folder with its checksums, one after another in the order of their IDs.

    A case that cannot be read has that as its problem; the others are compared all the same.

    Raises
    ------
    ConfigError
        ``E-CLN-01`` where there is no results folder.
    EnvironmentFault
        When the results folder itself cannot be read.
    """
    for folder in case_folders(results):
        yield verify_one(folder, flow)


def verified_lines(found: Verified) -> tuple[str, ...]:
    """One case for the screen."""
    if found.running:
        return (f"{found.case_id}: is running; look again when it has ended",)
    if not found.problems:
        return (f"{found.case_id}: every recorded file is as it was written",)
    return tuple(f"{found.case_id}: {problem}" for problem in found.problems)


def repair_case(folder: Path, flow: Sequence[Stage]) -> tuple[str, ...]:
    """Set aside every damaged stage of a case, so that the next run makes it anew.

    A stage that is sound stays, also behind a damaged one: the next run takes it where it is still proven, and makes it
    again where it is not. What was set aside stays beside the stages, with ``.quarantine-`` before its name, until
    ``ct2lut clean``.

    Parameters
    ----------
    folder : Path
        ``RESULTS/<ID>``.
    flow : sequence of Stage

    Returns
    -------
    tuple of str
        What was found and done, what the next run will do, and the command to type.

    Raises
    ------
    ConfigError
        ``E-CLN-02`` for a case without results.
    EnvironmentFault
        ``E-LOCK-01`` while a run of the case is at work; other codes when the disk fails.
    """
    _refuse_absent(folder)
    with case_lock(folder) as alone:
        if alone:
            sweep(folder)  # a result that a killed run had moved away comes back, and is compared like the others
        lines = [*_repaired(folder, flow), *_record_lines(folder)]
    if not lines:
        return (f"{folder.name}: every recorded file is as it was written; nothing to repair",)
    return (*lines, f"To make it again type: ct2lut run {folder.name} (with the cases, results and protocol as before)")


def case_folders(results: Path) -> list[Path]:
    """The folders of all cases of a results folder, in the order of their IDs; links are passed over.

    Raises
    ------
    ConfigError
        ``E-CLN-01`` where there is no results folder.
    EnvironmentFault
    """
    if not results.is_dir():
        raise ConfigError("E-CLN-01", "The results folder does not exist.", "Name another one with --results.")
    with storage("Reading the results folder"), os.scandir(results) as entries:
        names = [one.name for one in entries if is_case_id(one.name) and one.is_dir(follow_symlinks=False)]
    return [results / name for name in sorted(names)]


def verify_one(folder: Path, flow: Sequence[Stage]) -> Verified:
    """Compare one case with its checksums; one that cannot be read has that as its problem.

    Raises
    ------
    ConfigError
        ``E-CLN-02`` for a case without results.
    """
    _refuse_absent(folder)
    if is_running(folder):
        return Verified(folder.name, (), running=True)
    try:
        problems = verify_case(folder, flow)
    except PipelineError as error:
        problems = (f"{error.code} {error.problem}",)
    # a run that began meanwhile replaced what was being compared
    return (
        Verified(folder.name, (), running=True) if problems and is_running(folder) else Verified(folder.name, problems)
    )


def _refuse_absent(folder: Path) -> None:
    if not folder.is_dir():
        raise ConfigError("E-CLN-02", f"{folder.name} has no results here.", "Name another folder with --results.")


def _repaired(folder: Path, flow: Sequence[Stage]) -> Iterator[str]:
    damage = {stage.folder: reason for stage in flow if (reason := _damage(folder / stage.folder))}
    for name, reason in damage.items():
        set_aside(folder / name)
        yield f"{name}: {reason}; set aside, the next run makes it again"
    for problem in verify_case(folder, flow):
        yield f"{problem}; kept, the next run makes it again"
    if damage:
        yield "Every other stage stays as it is, and is made again only if what it reads comes out different."


def _damage(stage_folder: Path) -> str:
    """Why a stage's folder is not what was written there; empty where it is, or where there is none."""
    with storage(f"Reading {stage_folder.name}"):
        if not stage_folder.exists() and not stage_folder.is_symlink():
            return ""
        manifest = load_manifest(stage_folder)
        if isinstance(manifest, Unusable):
            absent = not (stage_folder / MANIFEST_FILE).exists()
            return manifest.reason if manifest.damaged else f"without its record {MANIFEST_FILE}" if absent else ""
        if manifest.key != manifest.recipe.key:
            return "its key is not that of its recorded ingredients"
        return next(altered_outputs(stage_folder, manifest), "")


def _record_lines(folder: Path) -> Iterator[str]:
    if load_record(folder) is None:
        state = "cannot be understood" if (folder / RUN_FILE).exists() else "is missing"
        yield f"{RUN_FILE}: {state}; how the last run ended is not known, the next run writes it"
