"""``ct2lut review``: a reader's decision, saved by the report page, is held against the result and kept beside it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from datetime import date
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as checked_dataclass

from pipeline.engine.lock import case_lock
from pipeline.engine.manifest import Unusable, load_manifest
from pipeline.engine.records import canonical_json
from pipeline.engine.runlog import LOG_FILE, LogLine, RunLog, printable
from pipeline.engine.stage import Stage
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import open_regular, replace_file
from pipeline.errors import ConfigError
from pipeline.records import Side, Word
from pipeline.report.sign_off import DECIDED
from pipeline.suggestions import shown

REVIEW_FILE = "review.json"
LARGEST_BYTES = 100_000
#: What is said of a decision.
DECISION_WORDS = {"accept": "accepted", "accept_with_remark": "accepted with a remark", "reject": "rejected"}

_RUN_IT = "Run it first: ct2lut run {}."
_SAVE_IT = "Open the report, fill in the last part, press Save the review, and name the file that was saved."

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Text = Annotated[str, Field(max_length=200)]
_STRICT = ConfigDict(extra="forbid", str_strip_whitespace=True)


@checked_dataclass(frozen=True, config=_STRICT)
class ReviewSchema:
    """Name and version of the file's layout."""

    name: Literal["ct2lut-review"]
    version: Literal["1.0"]


@checked_dataclass(frozen=True, config=_STRICT)
class Review:
    """A reader's decision, as the page saves it.

    Attributes
    ----------
    case_id, joint, side, software, verdict : str
        Of the report that was read.
    result : dict of str to str
        Artifact name -> SHA-256 of its content when the report was made.
    decision : "accept", "accept_with_remark" or "reject"
    initials, remark : str
        As typed; a remark is there unless the decision is "accept".
    date : date
        As typed; the reader's, not the program's.
    """

    schema: ReviewSchema
    notice: Text
    case_id: Text
    joint: Text
    side: Side
    software: Text
    verdict: Word
    result: dict[str, Sha256]
    decision: Literal["accept", "accept_with_remark", "reject"]
    initials: Annotated[str, Field(min_length=1, max_length=10)]
    remark: Annotated[str, Field(max_length=2000)]
    date: date

    def __post_init__(self) -> None:
        """Raises ValueError where a decision lacks its remark."""
        if self.decision != "accept" and not self.remark:
            raise ValueError("a remark is missing")

    @property
    def sentence(self) -> str:
        """Such as ``accepted by AB on 2031-02-03``."""
        return f"{DECISION_WORDS[self.decision]} by {printable(self.initials)} on {self.date}"


@dataclass(frozen=True)
class ReviewedCase:
    """Where the results of a case are.

    Attributes
    ----------
    case_id : str
    folder : Path
        Its results.
    package : Stage
        The stage that makes the deliverable; its record says from what.
    """

    case_id: str
    folder: Path
    package: Stage

    @property
    def made_from(self) -> dict[str, str] | None:
        """Artifact name -> SHA-256 of what the finished package was made from; None where there is no package.

        Raises
        ------
        EnvironmentFault
            When the disk fails.
        """
        with storage("Reading the results"):
            manifest = load_manifest(self.folder / self.package.folder)
        if isinstance(manifest, Unusable):
            return None
        return {name: record.sha256 for name, record in manifest.recipe.inputs.items()}


def store_review(case: ReviewedCase, path: Path) -> Review:
    """Keep the review in a file as that of a case, in place of an earlier one.

    Raises
    ------
    ConfigError
        E-REV-01 where the case has no finished result; E-REV-02 for a file that is no review; E-REV-03 for the review
        of another case; E-REV-04 for that of another result.
    EnvironmentFault
        When a run of the case is at work, or the disk fails.
    """
    if case.made_from is None:
        raise ConfigError("E-REV-01", f"{case.case_id} has no finished result to review.", _RUN_IT.format(case.case_id))
    review = _given(path)
    if review.case_id != case.case_id:
        problem = f"This is the review of {shown(review.case_id)}, not of {case.case_id}."
        raise ConfigError("E-REV-03", problem, "Name the case whose report was read.")
    with case_lock(case.folder):
        if not _is_of(review, case):
            problem = f"The review is of another result of {case.case_id} than the one that is there now."
            action = "Read the report that is there now, and save the review from its last page."
            raise ConfigError("E-REV-04", problem, action)
        replace_file(case.folder / REVIEW_FILE, encode_review(review))
    RunLog(case.folder / LOG_FILE, case.case_id).write(LogLine("info", f"review: {review.sentence}"))
    return review


def review_line(case: ReviewedCase) -> str | None:
    """What is to say of the review that is kept with a case, if any; whether it is of the result that is there now.

    Raises
    ------
    EnvironmentFault
        When the disk fails.
    """
    try:
        review = _read(case.folder / REVIEW_FILE)
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        return "review: its file is damaged"
    ours = review.case_id == case.case_id and _is_of(review, case)
    return f"review: {review.sentence}{'' if ours else ', of an OLDER result: read the report again'}"


def decode_review(data: bytes) -> Review:
    """The review in a file's bytes.

    Raises
    ------
    ValueError
        For anything else; the message names the field.
    """
    if len(data) > LARGEST_BYTES:
        raise ValueError(f"it has more than {LARGEST_BYTES} bytes")
    try:
        return _adapter().validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ValueError(f"{where or 'the file'}: {first['msg']}") from error


def encode_review(review: Review) -> bytes:
    """A review as bytes; equal reviews give equal bytes."""
    body: dict[str, Any] = {**asdict(review), "date": review.date.isoformat()}
    return canonical_json(body)


@cache
def _adapter() -> TypeAdapter[Review]:
    return TypeAdapter(Review)


def _read(path: Path) -> Review:
    with open_regular(path) as stream:
        return decode_review(stream.read(LARGEST_BYTES + 1))


def _given(path: Path) -> Review:
    try:
        return _read(path)
    except OSError as error:
        problem = f"The file {shown(path.name)} cannot be read: {error.strerror or 'the system refused'}."
        raise ConfigError("E-REV-02", problem, _SAVE_IT) from error
    except ValueError as error:
        problem = f"The file {shown(path.name)} is not a review of this program ({error})."
        raise ConfigError("E-REV-02", problem, _SAVE_IT) from error


def _is_of(review: Review, case: ReviewedCase) -> bool:
    """Whether all that the reader decided on is what the package was made from."""
    made_from = case.made_from or {}
    return review.result == {one.name: made_from.get(one.name) for one in DECIDED}
