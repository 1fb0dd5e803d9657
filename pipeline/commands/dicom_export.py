"""A finished case as DICOM objects for the archive (PACS), in the study that its CT came from.

A result holds no name of a patient. Whose CT it was is read from the case at the moment of the export, after it is
certain that these are still the files that the result was made from.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from pipeline.engine.source import list_source
from pipeline.errors import CaseRejected, ConfigError
from pipeline.files.case_files import CT_FOLDER, choose_files, read_file

if TYPE_CHECKING:
    from pipeline.files.dicom_study import SourceStudy

REPORT = "report.pdf"
_PICTURES, _ENDING = "images/", ".png"


def dicom_files(case_id: str, case: Path, package: Mapping[str, bytes]) -> dict[str, bytes]:
    """The report and each of its pictures; equal cases and packages give equal bytes.

    Parameters
    ----------
    case_id : str
    case : Path
        The case folder; read, never written.
    package : mapping of str to bytes
        Files of the package by name. Without ``report.pdf`` there are pictures alone.

    Returns
    -------
    dict of str to bytes
        ``dicom/report.dcm`` and ``dicom/PICTURE.dcm``.

    Raises
    ------
    ValueError
        For a package that is not complete or not as it was written.
    ConfigError
        E-EXP-03 where the case brought no DICOM series.
    CaseRejected
        E-EXP-04 for a case with other files than the result was made from, E-EXP-05 for a patient or study that cannot
        be repeated; E-IO-* for a case folder that cannot be read.
    """
    from pipeline.files.dicom_report import ArchivedResult, encode_pictures, encode_report  # noqa: PLC0415 - pydicom

    try:
        manifest = json.loads(package["manifest.json"])
        result = ArchivedResult(case_id, manifest["joint"], manifest["side"], manifest["verdict"]["word"])
        shown = {name: data for name, data in package.items() if name == REPORT or _is_picture(name)}
        _check_unchanged(shown, manifest["files"])
        used_sha256 = manifest["sources_sha256"]
    except (KeyError, TypeError) as error:
        raise ValueError(f"the package is not complete: {error}") from error
    study = _study(case_id, case, used_sha256)
    pictures = {PurePosixPath(name).stem: data for name, data in shown.items() if _is_picture(name)}
    encoded = encode_pictures(study, result, pictures)
    if REPORT in shown:
        encoded = {"report": encode_report(study, result, shown[REPORT]), **encoded}
    return {f"dicom/{name}.dcm": data for name, data in encoded.items()}


def _is_picture(name: str) -> bool:
    return name.startswith(_PICTURES) and name.endswith(_ENDING)


def _check_unchanged(files: Mapping[str, bytes], listed: Mapping[str, Any]) -> None:
    """What goes into an archive stays there."""
    for name, data in files.items():
        if hashlib.sha256(data).hexdigest() != listed[name]["sha256"]:
            raise ValueError(f"{name} of the package is not as it was written")


def _study(case_id: str, case: Path, used_sha256: list[str]) -> SourceStudy:
    from pipeline.files.dicom_study import read_study  # noqa: PLC0415 - pydicom

    source = list_source(case_id, case)
    files = choose_files(source.files)
    if not files.ct or not files.ct[0].startswith(CT_FOLDER):
        problem = f"{case_id} came without a DICOM series, so there is no study to file its report with."
        raise ConfigError("E-EXP-03", problem, "Export other formats, or file report.pdf of the package by hand.")
    # equal hashes: intake has read these very bytes in its sealed process, and accepted them
    if sorted(source.files[name] for name in files.names) != used_sha256:
        problem = f"The files of {case_id} are not those that its result was made from."
        raise CaseRejected(
            "E-EXP-04", problem, f"Run it again (ct2lut run {case_id}), look at the report, then export."
        )
    return read_study(files.ct, partial(read_file, source))
