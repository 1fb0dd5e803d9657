"""What ``ct2lut export`` is asked for: some formats of a finished case, in a folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.commands.dicom_export import REPORT, dicom_files
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import make_folder, replace_file
from pipeline.errors import ConfigError
from pipeline.exports import FORMATS, export_files, finished_package, source_of

#: Never made unasked: its files name the patient.
DICOM = "dicom"


@dataclass(frozen=True)
class ExportRequest:
    """One export.

    Attributes
    ----------
    case_id : str
    cases, results : Path
        Folders with one folder a case; the case itself is read for DICOM only.
    formats : tuple of str
        Of :data:`~pipeline.exports.FORMATS`, and ``dicom``; none for all of FORMATS.
    out : Path
        Folder for the files.
    """

    case_id: str
    cases: Path
    results: Path
    formats: tuple[str, ...]
    out: Path


def export_case(request: ExportRequest) -> list[str]:
    """Write the files of the wanted formats; a line for each, for reading.

    Raises
    ------
    ConfigError
        E-EXP-01 where the case has no finished package, E-EXP-02 for a format or package that cannot be used, E-EXP-03
        for DICOM where the CT was none, E-EXP-06 for DICOM in a folder that may hold no name.
    CaseRejected
        E-EXP-04, E-EXP-05 of :func:`~pipeline.commands.dicom_export.dicom_files`.
    EnvironmentFault
        When the disk does not take it.
    """
    folder = finished_package(request.results, request.case_id)
    _check_place(request)
    package = {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    try:
        files = _files(request, package)
    except ValueError as error:
        raise ConfigError("E-EXP-02", f"{error}.", "Name other formats, or run the case again.") from error
    write_files(request.out, files)
    return [
        *(f"{request.out / name}  {len(data) / 1e6:.2f} MB" for name, data in files.items()),
        *_notes(request, package),
    ]


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files, each of them whole or not at all; folders are made where there are none.

    Raises
    ------
    EnvironmentFault
        When the disk does not take it.
    """
    for name, data in files.items():
        path = folder / name
        with storage("Making the folder for the files"):
            make_folder(path.parent)
        replace_file(path, data)


def _files(request: ExportRequest, package: Mapping[str, bytes]) -> dict[str, bytes]:
    plain = [name for name in request.formats if name != DICOM]
    if unknown := sorted(set(plain) - set(FORMATS)):
        raise ValueError(f"unknown format {unknown[0]!r}, expected one of {', '.join([*FORMATS, DICOM])}")
    files: dict[str, bytes] = {}
    if plain or not request.formats:
        files |= export_files(source_of(package), plain or None)
    if DICOM in request.formats:
        files |= dicom_files(request.case_id, request.cases / request.case_id, package)
    return files


def _check_place(request: ExportRequest) -> None:
    """Results hold no name of a patient (they are looked at and handed on), and cases are never written to."""
    out = request.out.resolve()
    if DICOM in request.formats and any(out.is_relative_to(one.resolve()) for one in (request.cases, request.results)):
        problem = "DICOM files name the patient, and may not be written into the folder of the cases or of the results."
        raise ConfigError("E-EXP-06", problem, "Name another folder with --out.")


def _notes(request: ExportRequest, package: Mapping[str, bytes]) -> list[str]:
    if DICOM not in request.formats:
        return []
    named = "The files in dicom/ name the patient: send them to the archive, then delete them."
    missing = f"This package holds no {REPORT}, so there are pictures alone; run the case again to have it."
    return [named] if REPORT in package else [named, missing]
