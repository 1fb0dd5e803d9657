"""What the user asked for, checked: one case, its folders, its settings."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from pipeline.case_id import check_case_id, refuse_twin
from pipeline.config import load_settings, parse_assignment
from pipeline.engine.runner import CaseJob
from pipeline.engine.stage import Stage, StrictParams
from pipeline.errors import ConfigError
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.suggestions import did_you_mean, listed


@dataclass(frozen=True)
class Request:
    """One case to be processed.

    Attributes
    ----------
    case_id : str
        Checked when the request is made.
    cases, results : Path
        Folders with one folder a case.
    protocol : str
    overrides : tuple of str
        ``stage.key=value``.
    folder : Path, optional
        The folder that the user brought, where it is not ``cases/case_id``.

    Raises
    ------
    ConfigError
        E-ID-01 for an ID that is not plain, E-ID-02 for one that differs from another only in upper and lower case.
    """

    case_id: str
    cases: Path
    results: Path
    protocol: str
    overrides: tuple[str, ...] = ()
    folder: Path | None = None

    def __post_init__(self) -> None:
        check_case_id(self.case_id)
        for folder in (self.results,) if self.folder else (self.cases, self.results):
            refuse_twin(self.case_id, folder)

    @property
    def source(self) -> Path:
        """The folder that the user brought."""
        return self.folder or self.cases / self.case_id

    def job(self) -> CaseJob:
        """The case as the runner wants it."""
        return CaseJob(self.case_id, self.source, self.results / self.case_id)

    def settings(self, flow: Sequence[Stage]) -> dict[str, StrictParams]:
        """The validated settings of every stage of a flow."""
        return load_settings(flow, self.source, self.protocol, self.overrides)


def phantom_spec(assignments: Sequence[str]) -> PhantomSpec:
    """A phantom knee with some numbers changed.

    Parameters
    ----------
    assignments : sequence of str
        ``name=value``, names as in :class:`~pipeline.geometry.phantom_spec.PhantomSpec`.

    Raises
    ------
    ConfigError
        E-PHA-02 for a name that the phantom does not have, E-PHA-03 for a value that it cannot have.
    """
    known = [field.name for field in fields(PhantomSpec)]
    values = {".".join(keys): value for keys, value in map(parse_assignment, assignments)}
    for name in values:
        if name not in known:
            problem = f"The phantom has no number {name!r}{did_you_mean(name, known)}."
            raise ConfigError("E-PHA-02", problem, f"Its numbers are {listed(known)}.")
    try:
        return TypeAdapter(PhantomSpec).validate_json(json.dumps(values), strict=True)
    except ValidationError as error:
        detail = error.errors()[0]
        where = f"{'.'.join(map(str, detail['loc']))}: " if detail["loc"] else ""
        message = detail["msg"].removeprefix("Value error, ")
        raise ConfigError(
            "E-PHA-03", f"The phantom cannot be made: {where}{message}.", "Correct that --set."
        ) from error
