"""A list of checksums that came with the files of a case, as ``sha256sum`` writes it: what was sent has arrived.

Some damage shows in no header: a first slice that never came, a bit that turned in a voxel. Where whoever exports a
case adds such a list, both are found.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from pathlib import PurePosixPath

from pipeline.engine.stage import Finding, Findings, Severity
from pipeline.errors import CaseRejected

#: A list of more files than this is none.
MAX_LINES = 100_000
_LINE = re.compile(r"\\?([0-9a-fA-F]{64}) [ *](?:\./)?(.+)")
_COPY_AGAIN = "Copy or export the case again, together with its list of checksums."


def is_checksum_list(name: str) -> bool:
    """Whether a file is such a list by its name: ``SHA256SUMS``, or one that ends in ``.sha256``."""
    base = PurePosixPath(name).name.lower()
    return base in ("sha256sums", "sha256sums.txt", "sha256sum.txt") or base.endswith(".sha256")


def check_checksums(files: Mapping[str, str], lists: Mapping[str, bytes]) -> Findings:
    """Hold the files of a case against the lists of checksums among them.

    Parameters
    ----------
    files : mapping of str to str
        Name relative to the case folder -> SHA-256 of every file.
    lists : mapping of str to bytes
        Name -> content of each list; names in it are relative to its own folder.

    Returns
    -------
    Findings
        That all are as listed, and which files of the same folder are not listed.

    Raises
    ------
    CaseRejected
        E-IO-31 for a file that is missing or differs, E-IO-32 for a list that cannot be read.
    """
    return tuple(finding for name, data in lists.items() for finding in _check(files, name, _listed(name, data)))


def _check(files: Mapping[str, str], name: str, listed: Mapping[str, str]) -> Findings:
    if absent := [file for file in listed if file not in files]:
        problem = f"{_some(absent)} of {len(listed)} files listed in {name} are missing."
        raise CaseRejected("E-IO-31", problem, _COPY_AGAIN)
    if other := [file for file, checksum in listed.items() if files[file] != checksum]:
        problem = f"{_some(other)} of {len(listed)} files are not as listed in {name}: their content differs."
        raise CaseRejected("E-IO-31", problem, _COPY_AGAIN)
    folder = str(PurePosixPath(name).parent)
    beside = [file for file in files if str(PurePosixPath(file).parent) == folder and not is_checksum_list(file)]
    unlisted = [file for file in beside if file not in listed and not (folder == "." and file == "case.yaml")]
    more = f" Not listed: {_some(unlisted)}." if unlisted else ""
    return (Finding("N-IO-01", Severity.NOTE, f"{len(listed)} files are as listed in {name}.{more}"),)


def _listed(name: str, data: bytes) -> dict[str, str]:
    """File name relative to the case -> checksum.

    Raises
    ------
    CaseRejected
        E-IO-32.
    """
    lines = [line for line in data.decode("utf-8", "replace").splitlines() if line.strip()]
    folder = PurePosixPath(name).parent
    found: dict[str, str] = {}
    for number, line in enumerate(lines[: MAX_LINES + 1], 1):
        match = _LINE.fullmatch(line)
        if match is None or number > MAX_LINES or ".." in PurePosixPath(match[2]).parts:
            raise CaseRejected(
                "E-IO-32",
                f"Line {number} of {name} is no checksum and file name as sha256sum writes them.",
                f"Write the list again (sha256sum * > {PurePosixPath(name).name}), or take it out of the case folder.",
            )
        found[str(folder / match[2])] = match[1].lower()
    return found


def _some(names: Collection[str]) -> str:
    """How many, with the first of them by name."""
    return f"{len(names)} ({sorted(names)[0]})"
