"""A folder of files as one zip archive, the same bytes for the same files."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import PurePosixPath

#: The earliest date a zip can hold: an archive tells nothing of when it was made.
_DATE = (1980, 1, 1, 0, 0, 0)
_MODE = 0o100644
_UNIX = 3
_LEVEL = 6


def encode_zip(files: Mapping[str, bytes], folder: str) -> bytes:
    """Archive of ``files`` (POSIX name -> bytes) in one top folder; sorted, deflated, fixed dates and permissions.

    Raises
    ------
    ValueError
        For a name that would unpack outside the folder.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in sorted(files):
            archive.writestr(_entry(folder, name), files[name], zipfile.ZIP_DEFLATED, _LEVEL)
    return buffer.getvalue()


def _entry(folder: str, name: str) -> zipfile.ZipInfo:
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or str(path) != name:
        raise ValueError(f"not a plain file name inside the package: {name!r}")
    entry = zipfile.ZipInfo(f"{folder}/{name}", _DATE)
    entry.create_system = _UNIX
    entry.external_attr = _MODE << 16
    return entry
