"""What a stage leaves on disk: name, file, encoder, decoder, schema version.

An artifact is declared once and is the only maker of its path. Encoders return bytes, never write: the store writes
every file through one atomic function.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, NoReturn, TypeVar

T = TypeVar("T")

#: Contents of one artifact: file name relative to the artifact (empty for a single-file artifact) -> bytes.
Files = Mapping[str, bytes]


@dataclass(frozen=True)
class Artifact(Generic[T]):
    """One thing a stage writes and others read.

    Attributes
    ----------
    name : str
        Unique in the pipeline, such as ``raw_table``.
    file : str
        File name inside the folder of the stage that writes it; a name that ends in ``/`` is a folder of files.
    encode : callable
        ``value -> Files``; equal values give equal bytes.
    decode : callable
        ``Files -> value``; raises ValueError for bytes it does not understand.
    schema : int
        Raised whenever the meaning of the bytes changes, so that older results are recomputed.
    """

    name: str
    file: str
    encode: Callable[[T], Files]
    decode: Callable[[Files], T]
    schema: int = 1

    @property
    def is_folder(self) -> bool:
        """Whether the artifact is a folder of files."""
        return self.file.endswith("/")


@dataclass(frozen=True)
class SourceFolder:
    """The case as its user brought it; read, never written.

    Attributes
    ----------
    case_id : str
    root : Path
    files : mapping of str to str
        POSIX name relative to ``root`` -> SHA-256 of the content when the run began.
    """

    case_id: str
    root: Path
    files: Mapping[str, str]

    def read(self, name: str) -> bytes:
        """Bytes of one listed file.

        Raises
        ------
        KeyError
            When the name is not listed.
        ValueError
            When the file is no longer what was listed (still being copied, or replaced).
        """
        expected = self.files[name]
        data = (self.root / name).read_bytes()
        if hashlib.sha256(data).hexdigest() != expected:
            raise ValueError(f"{name} changed while it was being read")
        return data


def _never(_: object) -> NoReturn:
    raise TypeError("the source folder is given by the runner; it is neither encoded nor decoded")


#: What the first stage reads: the case folder itself.
SOURCE: Artifact[SourceFolder] = Artifact("source", "", _never, _never)


def single(
    name: str, file: str, encode: Callable[[T], bytes], decode: Callable[[bytes], T], schema: int = 1
) -> Artifact[T]:
    """An artifact that is one file."""
    return Artifact(name, file, lambda value: {"": encode(value)}, lambda files: decode(files[""]), schema)


def folder(name: str, file: str, schema: int = 1) -> Artifact[Files]:
    """An artifact that is a folder of files whose names are only known when they are made."""
    if not file.endswith("/"):
        raise ValueError(f"the file name of a folder artifact ends in '/', got {file!r}")
    return Artifact(name, file, lambda files: files, lambda files: files, schema)
