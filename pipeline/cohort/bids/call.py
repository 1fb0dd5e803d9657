"""The call of a BIDS-App: ``ct2lut IN OUT participant --participant-label 01 02``."""

from __future__ import annotations

import argparse
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NoReturn, get_args

from pipeline.case_declaration import parse_json
from pipeline.engine.runlog import printable
from pipeline.errors import ConfigError
from pipeline.suggestions import listed, shown

Level = Literal["participant", "group"]
Show = Literal["", "help", "version"]
LEVELS: tuple[Level, ...] = get_args(Level)

#: A label of BIDS: letters and digits; a plus joins two of them.
LABEL = re.compile(r"[A-Za-z0-9+]+", re.ASCII)
#: What ``--bids-filter-file`` may choose among.
FILTERED = ("ct", "dseg")
#: Long names of entities, as other BIDS-Apps write them in such a file.
LONG_NAMES = {
    "session": "ses",
    "acquisition": "acq",
    "ceagent": "ce",
    "reconstruction": "rec",
    "direction": "dir",
    "hemisphere": "hemi",
    "resolution": "res",
    "segmentation": "seg",
    "description": "desc",
}
#: Stands for the folder below ``derivatives/`` that a file is in; empty for the dataset itself.
PIPELINE = "pipeline"

NOT_VALIDATED = "--skip-bids-validator changes nothing: this program reads what it needs and refuses the rest in words."

#: Entity -> label that it must have, or None where a name must be without it.
Filter = Mapping[str, str | None]


@dataclass(frozen=True)
class BidsCall:
    """What was asked for in a BIDS-App call.

    Attributes
    ----------
    dataset, out : Path
        ``IN``, never written to, and ``OUT``.
    level : "participant" or "group"
    labels, sessions : tuple of str
        Without ``sub-`` and ``ses-``; empty means all.
    protocol : str
    overrides : tuple of str
        ``stage.key=value``.
    jobs : int
        Processes of one case; 0 where it was not said.
    memory_mb : int
        Of one case; 0 means no limit.
    time_limit_min : float
        Of one case; 0 means no limit.
    filters : mapping of str to mapping
        ``ct`` and ``dseg`` -> entity -> label: which of several files is meant.
    notes : tuple of str
        Sentences to be shown to the user.
    show : "", "help" or "version"
        What to show in place of doing anything.
    """

    dataset: Path
    out: Path
    level: Level
    labels: tuple[str, ...] = ()
    sessions: tuple[str, ...] = ()
    protocol: str = "clinical"
    overrides: tuple[str, ...] = ()
    jobs: int = 0
    memory_mb: int = 0
    time_limit_min: float = 0.0
    filters: Mapping[str, Filter] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    show: Show = ""


def is_bids_call(arguments: Sequence[str], commands: Collection[str] = ()) -> bool:
    """Whether a command line is the call of a BIDS-App: two folders, then a level.

    Parameters
    ----------
    arguments : sequence of str
        Without the name of the program.
    commands : collection of str
        The program's own commands: ``compare A group`` is one of them.
    """
    folders, level = arguments[:2], arguments[2:3]
    plain = not any(text.startswith("-") for text in folders)
    return bool(level) and level[0] in LEVELS and plain and folders[0] not in commands


def parse_bids_call(arguments: Sequence[str]) -> BidsCall:
    """What a command line asks for.

    Parameters
    ----------
    arguments : sequence of str
        Without the name of the program.

    Raises
    ------
    ConfigError
        E-BID-01 for an option or a label that cannot be understood, E-BID-04 for an output folder inside the dataset,
        E-BID-06 for a filter file that cannot be used.
    """
    given = _parser().parse_args(list(arguments))
    show: Show = "version" if given.version else "help" if given.help else ""
    if not show:
        _refuse_place(given.dataset, given.out)
    return BidsCall(
        dataset=given.dataset,
        out=given.out,
        level=given.level,
        labels=_labels(given.participant_label, "sub-"),
        sessions=_labels(given.session_label, "ses-"),
        protocol=given.protocol,
        overrides=tuple(given.overrides),
        jobs=given.jobs,
        memory_mb=given.memory_mb,
        time_limit_min=given.time_limit_min,
        filters={} if show or given.bids_filter_file is None else _filters(given.bids_filter_file),
        notes=(NOT_VALIDATED,) if given.skip_bids_validator else (),
        show=show,
    )


def bids_help() -> str:
    """The options of a BIDS-App call, as ``--help`` shows them."""
    return _parser().format_help()


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        problem = f"The BIDS-App call cannot be understood: {printable(message)[:200]}."
        raise ConfigError("E-BID-01", problem, "Type: ct2lut IN OUT participant --help.")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="ct2lut", add_help=False, allow_abbrev=False, description="Run as a BIDS-App. Not for diagnosis."
    )
    parser.add_argument("dataset", metavar="IN", type=Path, help="dataset in BIDS; never written to")
    parser.add_argument("out", metavar="OUT", type=Path, help="folder for the results")
    parser.add_argument("level", choices=LEVELS, help="participant: each case; group: the summary of all of them")
    for name, what in (
        ("participant", "subjects, with or without sub-"),
        ("session", "sessions, with or without ses-"),
    ):
        flags = (f"--{name}-label", f"--{name}_label")
        parser.add_argument(*flags, nargs="+", action="extend", default=[], metavar="LABEL", help=what)
    parser.add_argument("--bids-filter-file", type=Path, metavar="FILE", help="JSON: which of several files is meant")
    parser.add_argument("--protocol", default="clinical", help="name of a protocol, or a .yaml file")
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="STAGE.KEY=VALUE", help="change one setting"
    )
    parser.add_argument("--jobs", "--n-cpus", "--n_cpus", type=_count, default=0, help="processes of one case")
    parser.add_argument("--memory-mb", "--mem-mb", "--mem_mb", type=_count, default=0, help="memory of one case, MB")
    parser.add_argument("--time-limit-min", type=_minutes, default=0.0, help="time of one case, minutes")
    parser.add_argument(
        "--skip-bids-validator", "--skip_bids_validator", action="store_true", help="accepted; changes nothing"
    )
    parser.add_argument("--version", action="store_true", help="show the version and stop")
    parser.add_argument("-h", "--help", action="store_true", help="show this and stop")
    return parser


def _count(text: str) -> int:
    if not (text.isascii() and text.isdecimal()):
        raise argparse.ArgumentTypeError(f"got {shown(text)}, expected a whole number from 0")
    return int(text)


def _minutes(text: str) -> float:
    if not re.fullmatch(r"\d{1,9}(\.\d{1,9})?", text, re.ASCII):
        raise argparse.ArgumentTypeError(f"got {shown(text)}, expected minutes")
    return float(text)


def _labels(given: Sequence[str], prefix: str) -> tuple[str, ...]:
    """The labels without their prefix, each once."""
    labels = [text.removeprefix(prefix) for text in given]
    for text, label in zip(given, labels, strict=True):
        if not LABEL.fullmatch(label):
            problem = f"{shown(text)} is no BIDS label: expected letters and digits, such as {prefix}01 or 01."
            raise ConfigError("E-BID-01", problem, "Correct the label; several are separated by blanks.")
    return tuple(dict.fromkeys(labels))


def _refuse_place(dataset: Path, out: Path) -> None:
    """The dataset is read only; where derivatives of it belong, results may be written."""
    inside, place = dataset.resolve(), out.resolve()
    derivatives = inside / "derivatives"
    if place.is_relative_to(inside) and derivatives not in place.parents:
        problem = "The output folder lies inside the dataset, which is never written to."
        raise ConfigError("E-BID-04", problem, "Choose a folder outside of it, or IN/derivatives/ct2lut.")


def _filters(path: Path) -> dict[str, Filter]:
    try:
        document = parse_json(path.read_bytes())
        return {kind: _filter(kind, wanted) for kind, wanted in document.items()}
    except (OSError, ValueError, RecursionError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        problem = f"The filter file cannot be used: {reason}."
        action = 'Write it as {"dseg": {"desc": "manual"}}; kinds of files are ct and dseg.'
        raise ConfigError("E-BID-06", problem, action) from error


def _filter(kind: str, wanted: object) -> Filter:
    if kind not in FILTERED:
        raise ValueError(f"{shown(kind)} is no kind of file that is read; expected {listed(FILTERED)}")
    if not isinstance(wanted, dict) or not all(isinstance(label, str | int | None) for label in wanted.values()):
        raise ValueError(f"{kind}: expected entities with their labels")
    return {
        LONG_NAMES.get(entity, str(entity)): None if label is None else str(label) for entity, label in wanted.items()
    }
