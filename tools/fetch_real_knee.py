"""Bring a real knee into a case folder: the label map that the source distribution of the package mskt carries.

    python tools/fetch_real_knee.py FOLDER

The archive is only unpacked, never built: ``pip download`` would run its build to learn its dependencies. So pip's own
finder, with whatever index, proxy and certificates pip is configured for, says where the archive is. What arrives is
checked against a recorded SHA-256.
"""

from __future__ import annotations

import hashlib
import io
import sys
import tarfile
from pathlib import Path

from pip._internal.commands import create_command
from pip._internal.commands.download import DownloadCommand

PROJECT = "mskt"
VERSION = "0.1.22"
MEMBER = f"{PROJECT}-{VERSION}/data/SAG_3D_DESS_RIGHT_bones_cart_men_fib-label.nrrd"
MEMBER_SHA256 = "d6307205761bd0197545b6f3d265a71fb410948f9c96f8a72e1fc1e14b7ba246"

CASE_YAML = "side: right\njoint: knee\nlabels: mskt\n"


def source_archive() -> bytes:
    """The source distribution as bytes."""
    command = create_command("download")
    assert isinstance(command, DownloadCommand)
    options, _ = command.parse_args(["--quiet", "--disable-pip-version-check"])
    with command.main_context():
        session = command.get_default_session(options)
        candidates = command._build_package_finder(options, session).find_all_candidates(PROJECT)
        links = [found.link for found in candidates if str(found.version) == VERSION and not found.link.is_wheel]
        if not links:
            raise LookupError(f"the package index offers no source archive of {PROJECT} {VERSION}")
        answer = session.get(links[0].url_without_fragment)
        answer.raise_for_status()
        return bytes(answer.content)


def label_map(archive: bytes) -> bytes:
    """The label map inside the archive.

    Raises
    ------
    ValueError
        When it is not the file that this program was written for.
    """
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        stream = tar.extractfile(MEMBER)
        data = b"" if stream is None else stream.read()
    found = hashlib.sha256(data).hexdigest()
    if found != MEMBER_SHA256:
        raise ValueError(f"{MEMBER} has SHA-256 {found}; expected {MEMBER_SHA256}")
    return data


def write_case(folder: Path, labels: bytes) -> None:
    """The case folder, complete or absent."""
    partial = folder.with_name(f".{folder.name}.partial")
    partial.mkdir(parents=True, exist_ok=True)
    (partial / "labels.nrrd").write_bytes(labels)
    (partial / "case.yaml").write_text(CASE_YAML)
    partial.rename(folder)


def main() -> int:
    """Fetch unless the folder is there already."""
    folder = Path(sys.argv[1])
    if folder.exists():
        return 0
    sys.stdout.write(f"fetching a real knee ({PROJECT} {VERSION}, MIT licence)\n")
    try:
        write_case(folder, label_map(source_archive()))
    except (OSError, LookupError, ValueError, tarfile.TarError) as error:
        sys.stderr.write(f"The knee could not be fetched: {error}.\nCheck the network and type make demo-real again.\n")
        return 30
    return 0


if __name__ == "__main__":
    sys.exit(main())
